"""Single labels that are wrong are strays; a camera whose labels are all off alike has moved."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import PipelineOptions
from imgcal.geometry import RigidTransform
from imgcal.online.label_checks import check_labels
from scripts.benchmarks.rig_streams import Bump, Conditions, Stream


def scene(**given):
    """Labelled blobs of a rig that is known, and the pose."""
    made = Stream(
        imgcal.load_rig("U7"), imgcal.load_object("asymmetric8"), 1, Conditions(clutter=0.0, labelled=True), **given
    )
    rig = made.rig
    blobs = made.snapshot(0)
    return rig, made.obj, blobs, made.pose_at(0.0)


def test_everything_fits_a_rig_that_is_right_wherever_the_pose_is_begun() -> None:
    rig, obj, blobs, pose = scene()
    begun = RigidTransform(pose.rotation, pose.translation + 60.0)
    checked = check_labels(blobs, rig, obj, begun, PipelineOptions())
    np.testing.assert_array_equal(checked.blobs.fiducial, blobs.fiducial)
    assert not checked.off.any()
    assert checked.usual < 0.2
    assert checked.labels == len(blobs)
    torch.testing.assert_close(checked.rig_from_object.translation, pose.translation, rtol=0, atol=0.5)


@pytest.mark.parametrize("kind", ["rotation", "position", "focal_length", "principal_point"])
def test_a_camera_that_moved_keeps_its_labels_and_is_named(kind: str) -> None:
    size = {"rotation": math.radians(0.5), "position": 10.0, "focal_length": 25.0, "principal_point": 15.0}[kind]
    rig, obj, blobs, pose = scene(bumps=[Bump(0, 2, kind, size)])
    wrong = np.flatnonzero(blobs.camera == 4)[:2]
    uv = blobs.uv.copy()
    uv[wrong] += [[9.0, -7.0], [-12.0, 3.0]]
    checked = check_labels(replace(blobs, uv=uv), rig, obj, pose, PipelineOptions())
    assert np.flatnonzero(checked.off).tolist() == [2]
    gone = np.flatnonzero(checked.blobs.fiducial != blobs.fiducial)
    assert gone.tolist() == sorted(wrong.tolist())


def test_labels_of_a_camera_that_do_not_agree_are_all_dropped() -> None:
    rig, obj, blobs, pose = scene()
    fiducial = blobs.fiducial.copy()
    rows = np.flatnonzero(blobs.camera == 1)
    fiducial[rows] = np.roll(fiducial[rows], 1)
    checked = check_labels(replace(blobs, fiducial=fiducial), rig, obj, pose, PipelineOptions())
    assert not (checked.blobs.fiducial[rows] >= 0).any()
    assert not checked.off.any()

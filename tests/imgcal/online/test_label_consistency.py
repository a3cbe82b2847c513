"""Single labels that are wrong are strays; a camera whose labels are all off alike has moved."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import PipelineOptions
from imgcal.geometry import RigidTransform
from imgcal.online.label_consistency import check_labels
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


@pytest.mark.parametrize(("radius", "apart"), [(2.0, 5.0), (math.nan, 5.0), (2.0, 9.0)])
def test_a_blob_that_may_be_two_fiducials_has_no_label(radius: float, apart: float) -> None:
    rig, obj, blobs, pose = scene()
    camera, first, second = 3, 0, 1
    # The object is such that this camera sees two fiducials near each other, and one blob for both.
    there = pose.apply(obj.points)[0]
    seen = rig.project(there)
    way = rig.positions[camera] - there[first]
    beside = torch.linalg.cross(way, rig.cam_from_rig.rotation[camera, 1])
    step = apart * float(seen.depth[camera, first]) / float(rig.focal_length[camera, 0])
    near = there[first] + 20 * way / way.norm() + step * beside / beside.norm()
    points = obj.points.clone()
    points[second] = pose.inverse().apply(near[None])[0]
    obj = replace(obj, points=points)
    exact = rig.project(pose.apply(points)[0]).uv.numpy()
    fiducial, uv = blobs.fiducial, exact[blobs.camera, blobs.fiducial]
    merged = (blobs.camera == camera) & (fiducial == first)
    assert merged.sum() == 1
    assert np.linalg.norm(exact[camera, first] - exact[camera, second]) < 1.3 * apart
    uv[merged] = exact[camera, [first, second]].mean(0) if apart < 8 else uv[merged]
    kept = ~((blobs.camera == camera) & (fiducial == second))
    blobs = replace(blobs, uv=uv, radius=np.full(len(blobs), radius)).select(kept)
    checked = check_labels(blobs, rig, obj, pose, PipelineOptions())
    gone = np.flatnonzero(checked.blobs.fiducial != blobs.fiducial)
    assert gone.tolist() == (np.flatnonzero(merged[kept]).tolist() if apart < 8 else [])

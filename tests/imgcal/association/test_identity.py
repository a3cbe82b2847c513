"""Only given information decides the orientation of a symmetric object."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import PipelineOptions, Tracker, associate
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object
from imgcal.pipeline import calibrate
from imgcal.synthesis import PhysicalDrift, Truth, true_detections
from imgcal.types import Detections

CENTRE = torch.tensor([0.0, 0.0, 800.0], dtype=torch.float64)  # mm, what the ring of cameras looks at


@pytest.fixture(scope="module")
def cube():
    return load_object("cube8")


def turned(*vector, at=CENTRE):
    return RigidTransform(rotation_from_vector(torch.tensor(vector, dtype=torch.float64)), at)


def seen(rig, obj, poses):
    """Labelled and unlabelled detections of an object at given poses, without noise."""
    uv = torch.stack([rig.project(pose.apply(obj.points)).uv for pose in poses])
    truth = true_detections(Truth(rig, RigidTransform.stack(poses), uv))
    return truth, replace(truth, fiducial=np.full(len(truth), -1))


def at_the_origin(rig):
    """The same rig, its frame moved to where the object stands."""
    to_centre = RigidTransform(torch.eye(3, dtype=torch.float64), CENTRE)
    return replace(rig, cam_from_rig=rig.cam_from_rig @ to_centre)


def test_a_cube_is_as_ambiguous_at_the_origin_as_anywhere(o10, cube):
    for rig, at in ((o10, CENTRE), (at_the_origin(o10), torch.zeros(3, dtype=torch.float64))):
        _, blobs = seen(rig, cube, [turned(0.02, -0.01, 0.0, at=at)])
        labelled = associate(blobs, rig, cube)
        assert labelled.identity == "ambiguous"
        assert labelled.snapshots[0].alternatives == 24


def test_what_follows_an_ambiguous_snapshot_is_as_ambiguous(o10, cube):
    _, blobs = seen(o10, cube, [turned(0.2, -0.1, 0.3 + 0.004 * s) for s in range(4)])
    labelled = associate(blobs, o10, cube)
    assert [s.status for s in labelled.snapshots] == ["ambiguous"] * 4
    assert [s.alternatives for s in labelled.snapshots] == [24] * 4


def test_an_asymmetric_object_is_unique_and_followed(o10, asymmetric8):
    _, blobs = seen(o10, asymmetric8, [turned(0.2, -0.1, 0.3 + 0.004 * s) for s in range(3)])
    labelled = associate(blobs, o10, asymmetric8)
    assert [(s.status, s.alternatives) for s in labelled.snapshots] == [("unique", 1)] + [("by_tracking", 1)] * 2
    assert labelled.identity == "unique"


@pytest.mark.parametrize("off", [0.0, 0.02, 0.5])  # rad: from as good as tracking needs to only just the right side
def test_a_given_pose_decides_which_way_round(off, o10, cube):
    poses = [turned(0.2, -0.1, 0.3 + 0.004 * s) for s in range(3)]
    truth, blobs = seen(o10, cube, poses)
    for motion in cube.symmetries[:6]:
        way = torch.from_numpy(motion.rotation)
        start = RigidTransform(poses[0].rotation @ way @ turned(0.0, off, 0.0).rotation, CENTRE + 400 * off)
        labelled = associate(blobs, o10, cube, PipelineOptions(start_pose=start))
        assert labelled.identity == "by_prior"
        assert [s.status for s in labelled.snapshots] == ["by_prior", "by_tracking", "by_tracking"]
        assert max(s.alternatives for s in labelled.snapshots) == 1
        expected = np.linalg.inv(motion.rotation)
        back = next(m.permutation for m in cube.symmetries if np.allclose(m.rotation, expected, atol=1e-6))
        np.testing.assert_array_equal(labelled.detections.fiducial, back[truth.fiducial])
        found = labelled.snapshots[0].rig_from_object
        assert torch.allclose(found.rotation, poses[0].rotation @ way, atol=1e-3)


def test_a_given_pose_between_two_ways_round_decides_nothing(o10, cube):
    pose = turned(0.2, -0.1, 0.3)
    _, blobs = seen(o10, cube, [pose])
    start = RigidTransform(pose.rotation @ turned(0.0, 0.0, np.pi / 4).rotation, CENTRE)
    labelled = associate(blobs, o10, cube, PipelineOptions(start_pose=start))
    assert (labelled.identity, labelled.snapshots[0].alternatives) == ("ambiguous", 24)


def test_the_whole_is_ambiguous_where_one_part_is(o10, cube):
    # The second pose is far from the first: what was given says nothing of it.
    poses = [turned(0.2, -0.1, 0.3), turned(-0.4, 0.5, 1.1)]
    _, blobs = seen(o10, cube, poses)
    labelled = associate(blobs, o10, cube, PipelineOptions(start_pose=poses[0]))
    assert [s.status for s in labelled.snapshots] == ["by_prior", "ambiguous"]
    assert labelled.identity == "ambiguous"


def test_a_calibration_says_that_the_given_pose_decided(o10, cube):
    rig = PhysicalDrift().apply(o10, torch.Generator().manual_seed(0))
    pose = turned(0.2, -0.1, 0.3)
    _, blobs = seen(rig, cube, [pose])
    result = calibrate(blobs, o10, cube, PipelineOptions(start_pose=pose))
    assert result.identity == "by_prior"
    assert torch.allclose(result.rig_from_object.rotation[0], pose.rotation, atol=0.02)
    assert calibrate(blobs, o10, cube).identity == "ambiguous"


@pytest.mark.parametrize(
    "pose",
    [
        RigidTransform(torch.zeros(3, 3), torch.zeros(3)),
        RigidTransform(torch.eye(3), torch.full((3,), torch.nan)),
        RigidTransform(torch.eye(3)[None], torch.zeros(1, 3)),
    ],
)
def test_a_start_pose_that_is_none_is_explained(pose, o10, cube):
    with pytest.raises(InputError, match=r"start pose: .*expected"):
        Tracker(o10, cube, PipelineOptions(start_pose=pose))


def test_a_start_pose_in_single_precision_is_accepted(o10, cube):
    pose = turned(0.2, -0.1, 0.3)
    _, blobs = seen(o10, cube, [pose])
    assert isinstance(blobs, Detections)
    options = PipelineOptions(start_pose=pose.to(torch.float32))
    assert associate(blobs, o10, cube, options).identity == "by_prior"


def test_options_out_of_range_are_input_errors() -> None:
    for name, value in (("identity_error", math.nan), ("outlier", -1.0)):
        with pytest.raises(InputError, match=name):
            PipelineOptions(**{name: value})

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from imgcal.estimation.relative_poses import Pair, as_transforms, relate, rigid_motion, tree
from imgcal.geometry import RigidTransform
from imgcal.synthesis import look_at

POINTS = np.array([[-100.0, 0, 0], [150, 0, 0], [0, 300, 0], [0, 0, 50]])


def poses(cameras, snapshots, seed=0):
    """Cameras in a ring, an object anywhere in the middle: cam_from_rig, and cam_from_object (S, C)."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(cameras) / cameras
    positions = torch.from_numpy(
        np.stack((3000 * np.cos(angle), 3000 * np.sin(angle), np.full(cameras, 800.0)), axis=1)
    )
    cam_from_rig = look_at(positions, torch.zeros(3, dtype=torch.float64))
    rotation = torch.from_numpy(Rotation.random(snapshots, rng=rng).as_matrix())
    rig_from_object = RigidTransform(rotation, torch.from_numpy(rng.uniform(-800, 800, (snapshots, 3))))
    return cam_from_rig, cam_from_rig[None] @ rig_from_object[:, None]


@pytest.mark.parametrize("snapshots", [1, 2, 40])
def test_cameras_are_found_although_some_poses_are_wrong(snapshots):
    cam_from_rig, cam_from_object = poses(4, snapshots)
    rng = np.random.default_rng(1)
    if snapshots > 3:  # a fifth of the images has a pose turned the wrong way round, and far away
        wrong = torch.from_numpy(rng.random((snapshots, 4)) < 0.2)
        cam_from_object.translation[wrong] *= 1.5
        cam_from_object.rotation[wrong] = cam_from_object.rotation[wrong].mT
    known = np.ones((snapshots, 4), dtype=bool)
    pairs = relate(cam_from_object, known, POINTS, rng)
    groups, chained = tree(pairs, 4)
    assert [sorted(group) for group in groups] == [[0, 1, 2, 3]]
    found = as_transforms(chained)
    true = cam_from_rig @ cam_from_rig[:1].inverse()
    found = found @ found[:1].inverse()
    torch.testing.assert_close(found.translation, true.translation, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.rotation, true.rotation, atol=1e-6, rtol=0)


def test_cameras_without_common_snapshots_are_groups_of_their_own():
    _, cam_from_object = poses(4, 20)
    known = np.zeros((20, 4), dtype=bool)
    known[:10, [0, 2]], known[10:, [1, 2]] = True, True
    groups, _ = tree(relate(cam_from_object, known, POINTS, np.random.default_rng(0)), 4)
    assert [sorted(group) for group in groups] == [[0, 1, 2], [3]]


def test_poses_that_contradict_relate_nothing():
    _, cam_from_object = poses(2, 30)
    rng = np.random.default_rng(5)
    cam_from_object.translation[:] = torch.from_numpy(rng.uniform(1000, 3000, (30, 2, 3)))
    pairs = relate(cam_from_object, np.ones((30, 2), dtype=bool), POINTS, rng)
    assert all(pair.spread > 0.05 for pair in pairs)


def test_the_surer_way_is_taken():
    eye, far, near = np.eye(3), np.array([9.0, 0, 0]), np.array([1.0, 0, 0])
    pairs = [Pair(0, 2, (eye, far), 10, 0.5), Pair(0, 1, (eye, near), 10, 0.01), Pair(1, 2, (eye, near), 10, 0.01)]
    _, chained = tree(pairs, 3)
    np.testing.assert_allclose(np.linalg.norm(chained[2][1] - chained[0][1]), 2.0)


def test_a_mirror_image_is_no_motion():
    rotation, _ = rigid_motion(POINTS, POINTS * [1, 1, -1])
    assert np.linalg.det(rotation) > 0

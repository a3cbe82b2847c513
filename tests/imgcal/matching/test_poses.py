import numpy as np
import pytest
import torch

from imgcal.geometry import RigidTransform, geodesic_angle, rotation_from_vector
from imgcal.io import load_object
from imgcal.matching.maps import surprise_maps
from imgcal.matching.poses import (
    NEAR,
    STEP,
    Matcher,
    Scene,
    all_turns,
    distinct_turns,
    search_one_camera,
    turn_object,
    turns_around,
)

from .scenes import dim_frames


@pytest.fixture(scope="module")
def given():
    rig, obj, truth, (frames,) = dim_frames()
    maps, _ = surprise_maps([frames[name] for name in rig.camera_names], 4, False, [None] * 4)
    return Scene(rig, obj, rig.prior.std(rig), 850.0), maps, truth.rig_from_object[0]


def angle(first, second):
    return np.degrees(geodesic_angle(first.rotation, second.rotation).numpy())


def test_turns_are_about_the_centre_and_leave_no_gap(asymmetric8):
    rotation = rotation_from_vector(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    pose = RigidTransform(rotation, torch.tensor([10.0, 20.0, 900.0], dtype=torch.float64))
    near = turns_around(pose, asymmetric8)
    centre = asymmetric8.points.mean(0, keepdim=True)
    assert torch.allclose(near.apply(centre), pose.apply(centre)[None])
    assert angle(near, pose).max() == pytest.approx(np.degrees(NEAR), rel=0.2)
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    vectors *= 0.8 * NEAR / np.linalg.norm(vectors, axis=1, keepdims=True)
    other = turn_object(pose, torch.from_numpy(vectors), asymmetric8)
    gaps = geodesic_angle(other.rotation[:, None], near.rotation[None]).min(1).values
    assert gaps.max() < STEP


def test_all_rotations_are_near_one_that_is_tried():
    turns = torch.from_numpy(all_turns(4608))
    assert torch.allclose(turns @ turns.mT, torch.eye(3, dtype=turns.dtype).expand_as(turns), atol=1e-9)
    some = torch.from_numpy(all_turns(97))[:40]
    gaps = np.degrees(geodesic_angle(some[:, None], turns[None]).min(1).values.numpy())
    assert gaps.max() < 13


def test_of_a_cube_a_twenty_fourth_is_tried():
    assert 150 < len(distinct_turns(load_object("cube8"), 4608)) < 240


def test_a_pose_that_is_twelve_degrees_off_is_found(given):
    scene, maps, true = given
    axis = torch.tensor([1.0, -1.0, 0.5], dtype=torch.float64)
    start = turn_object(true, np.radians(12) * axis / axis.norm(), scene.obj)
    matcher = Matcher.on(scene, maps, 4 * scene.drift + 10)
    found = matcher.climb(matcher.rank(turns_around(start, scene.obj)).best(4)).best(1)
    assert angle(found.poses, true)[0] < 3
    assert found.scores.total[0] > matcher.rank(start[None]).scores.total[0] + 20


def test_a_pose_of_which_nothing_is_known_is_among_those_found_in_one_camera(given):
    scene, maps, true = given
    turns = distinct_turns(scene.obj, 4608)
    near = turns[np.argsort(angle(RigidTransform(torch.from_numpy(turns), torch.zeros(len(turns), 3)), true))]
    some = np.concatenate((near[:20], turns[:400]))  # a part of the search: its time grows with the number
    found = search_one_camera(Matcher.on(scene, maps.pool(8), 4 * scene.drift), 0, some, 30)
    assert angle(found, true).min() < 15

import numpy as np
import pytest
import torch

from imgcal.association import lattice_shifts, near_symmetries
from imgcal.association.ambiguities import conflicts, differ, partial_turns, relabel
from imgcal.geometry import RigidTransform, geodesic_angle, rotation_from_vector
from imgcal.io import data_path, load_object
from imgcal.types import CalibrationObject


def lattice(columns: int, rows: int) -> CalibrationObject:
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), [0.0]), axis=-1).reshape(-1, 3) * 10.0
    return CalibrationObject(torch.from_numpy(grid), torch.ones(len(grid), 3))


def test_steps_of_a_lattice_are_found() -> None:
    obj = lattice(6, 5)
    shifts = lattice_shifts(obj)
    assert {tuple(motion.translation.round(6)) for motion in shifts[:4]} == {
        (10, 0, 0),
        (-10, 0, 0),
        (0, 10, 0),
        (0, -10, 0),
    }
    points = obj.points.numpy()
    for motion in shifts:
        falls = motion.permutation >= 0
        np.testing.assert_allclose(points[falls] + motion.translation, points[motion.permutation[falls]], atol=1e-9)


def test_steps_of_a_measured_lattice_are_found_in_any_frame_and_order() -> None:
    random, exact = np.random.default_rng(0), lattice(5, 4)
    points = exact.points.numpy() + 0.07 * random.standard_normal((20, 3))
    turn = rotation_from_vector(torch.from_numpy(random.standard_normal(3))).numpy()
    expected = np.array([motion.translation for motion in lattice_shifts(exact)])
    for order, rotation in ((np.arange(20), np.eye(3)), (random.permutation(20), turn)):
        measured = CalibrationObject(torch.from_numpy(points[order] @ rotation.T), torch.ones(20, 3))
        shifts = lattice_shifts(measured)
        found = np.array([motion.translation @ rotation for motion in shifts])
        assert len(found) == len(expected)
        np.testing.assert_allclose(found[np.lexsort(found.round().T)], expected[np.lexsort(expected.T)], atol=0.1)
        assert all((motion.permutation >= 0).sum() >= 12 for motion in shifts)


def test_steps_of_a_large_lattice_are_the_smallest() -> None:
    plain, cube = lattice(23, 19), CalibrationObject(torch.cartesian_prod(*[torch.arange(5.0)] * 3), torch.ones(125, 3))
    assert [round(float(np.linalg.norm(motion.translation))) for motion in lattice_shifts(plain)] == 4 * [10] + 4 * [14]
    lengths = [float(np.linalg.norm(motion.translation)) for motion in lattice_shifts(cube)]
    np.testing.assert_allclose(lengths, 6 * [1.0] + 12 * [np.sqrt(2)])  # all of them, not those that rounding prefers


def test_an_asymmetric_object_has_no_motion() -> None:
    obj = load_object(data_path("objects", "asymmetric8.csv"))
    assert lattice_shifts(obj) == []
    assert near_symmetries(obj, 1.0) == []


def test_turns_that_take_most_fiducials_near_others_are_found() -> None:
    sphere = load_object(data_path("objects", "sphere64.csv"))  # its neighbours differ by the golden angle
    turns = partial_turns(sphere)
    angles = [float(geodesic_angle(torch.from_numpy(turn.rotation), torch.eye(3).double())) for turn in turns]
    np.testing.assert_allclose(np.degrees(sorted(angles)), [137.5, 137.5, 180, 180], atol=0.5)
    points = sphere.points.numpy()
    for turn in turns:
        moved = points @ turn.rotation.T + turn.translation
        away = np.linalg.norm(moved - points[turn.permutation], axis=1)
        assert sorted(turn.permutation) == list(range(64))
        assert (away < 0.05 * sphere.size).mean() > 0.6


@pytest.mark.parametrize("name", ["asymmetric8", "cube8", "cube27"])
def test_objects_without_partial_turns(name: str) -> None:
    assert partial_turns(load_object(data_path("objects", f"{name}.csv"))) == []


def test_moved_labels_and_pose_explain_the_same_blobs() -> None:
    obj = lattice(6, 5)
    pose = RigidTransform(torch.eye(3, dtype=torch.float64), torch.tensor([1.0, 2, 500], dtype=torch.float64))
    labels = np.arange(30)[None]
    motion = lattice_shifts(obj)[0]
    poses, changed = relabel(pose, labels, [motion])
    before = pose.apply(obj.points).numpy()
    after = obj.points.numpy() @ poses.rotation[0].T + poses.translation[0]
    named = changed[0, 0] >= 0
    np.testing.assert_allclose(after[named], before[changed[0, 0][named]], atol=1e-9)


def test_labellings_differ_up_to_symmetry_only() -> None:
    cube = load_object(data_path("objects", "cube8.csv"))
    labels = np.tile(np.arange(8), (3, 1))
    turned = np.empty_like(labels)
    turned[:, cube.symmetries[5].permutation] = labels
    assert conflicts(cube, labels, turned) == 0
    assert not differ(cube, labels, turned)
    mixed = np.concatenate((labels[:2], turned[2:]))  # one camera follows another symmetry element
    assert differ(cube, labels, mixed)

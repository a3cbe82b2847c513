"""`CalibrationObject`: symmetry groups of known bodies, near symmetries, bad input."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

import imgcal
from imgcal.errors import InputError
from imgcal.io import load_object
from imgcal.pipeline import calibrate_from_scratch
from imgcal.types import MOST_LIGHTS, CalibrationObject, Symmetry, check_object


def body(points: Tensor, radius: Tensor | None = None) -> CalibrationObject:
    return CalibrationObject(points.double(), torch.ones(len(points), 3), radius)


def grid(rows: int, columns: int) -> Tensor:
    return torch.tensor([(10.0 * i, 10.0 * j, 0.0) for i, j in product(range(rows), range(columns))])


TETRAHEDRON = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 50
PRISM = torch.tensor([(np.cos(a), np.sin(a), z) for a in np.arange(6) * np.pi / 3 for z in (-1.3, 1.3)]) * 40


@pytest.mark.parametrize(("name", "order"), [("cube8", 24), ("cube27", 24), ("asymmetric8", 1), ("sphere64", 2)])
def test_symmetries_of_the_shipped_objects(name: str, order: int) -> None:
    assert len(load_object(name).symmetries) == order


@pytest.mark.parametrize(
    ("points", "order"),
    [(grid(10, 10), 8), (grid(3, 5), 4), (TETRAHEDRON, 12), (PRISM, 12), (TETRAHEDRON + 300, 12)],
)
def test_symmetries_of_known_bodies(points: Tensor, order: int) -> None:
    assert len(body(points).symmetries) == order


@pytest.mark.parametrize("seed", [0, 1])
def test_symmetries_do_not_depend_on_where_the_body_is(seed: int) -> None:
    turn = torch.from_numpy(Rotation.random(rng=seed).as_matrix())
    points = load_object("cube8").points @ turn.T + torch.tensor([500.0, -20.0, 3.0], dtype=torch.float64)
    shuffled = points[torch.randperm(8, generator=torch.Generator().manual_seed(seed))]
    assert len(body(shuffled).symmetries) == 24


def check(obj: CalibrationObject, motion: Symmetry, tolerance: float) -> None:
    points = obj.points.numpy()
    np.testing.assert_allclose(motion.rotation @ motion.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(motion.rotation) == pytest.approx(1)
    assert sorted(motion.permutation) == list(range(len(points)))
    gaps = np.linalg.norm(points @ motion.rotation.T + motion.translation - points[motion.permutation], axis=1)
    assert gaps.max() <= tolerance
    assert motion.residual == pytest.approx(np.sqrt(np.mean(gaps**2)), abs=1e-9)


def test_self_motions_map_the_object_onto_itself() -> None:
    obj = load_object("cube8")
    first, *_ = obj.symmetries
    assert first.permutation.tolist() == list(range(8))
    for motion in obj.symmetries:
        check(obj, motion, 1e-9)
    permutations = {tuple(motion.permutation) for motion in obj.symmetries}
    assert len(permutations) == 24
    composed = {tuple(np.array(p)[list(q)]) for p in permutations for q in permutations}
    assert composed == permutations  # a group


def test_radius_breaks_symmetry() -> None:
    points = load_object("cube8").points
    radius = torch.full((8,), 5.0, dtype=torch.float64)
    assert len(body(points, radius).symmetries) == 24
    radius[3] = 7.0
    assert len(body(points, radius).symmetries) == 3  # the rotations about the diagonal through the larger fiducial


def test_near_symmetries_appear_with_the_tolerance() -> None:
    generator = torch.Generator().manual_seed(0)
    points = load_object("cube8").points
    obj = body(points + torch.randn(8, 3, generator=generator, dtype=torch.float64))
    assert len(obj.symmetries) == 1
    near = obj.near_symmetries(tolerance=8.0)
    assert len(near) == 24
    residuals = [motion.residual for motion in near]
    assert residuals[0] == 0
    assert residuals == sorted(residuals)
    for motion in near:
        check(obj, motion, 8.0)


def test_moved_fiducial_breaks_the_grid() -> None:
    points = grid(4, 4)
    points[0] += torch.tensor([2.0, 0, 0])
    assert len(body(points).symmetries) == 1
    assert len(body(points).near_symmetries(tolerance=3.0)) == 8


def test_planarity_and_size() -> None:
    assert body(grid(3, 3)).planar
    assert not body(TETRAHEDRON).planar
    assert body(TETRAHEDRON).size == pytest.approx(50 * np.sqrt(3))


def test_unusable_objects_say_why() -> None:
    with pytest.raises(InputError, match="expected \\(N >= 1, 3\\)"):
        body(TETRAHEDRON[:0])


def test_a_stick_has_two_ends_and_a_light_has_no_symmetry() -> None:
    light, pair = body(torch.tensor([[5.0, 6, 7]])), body(torch.tensor([[0.0, 0, 0], [30, 40, 0]]))
    uneven = body(torch.tensor([[0.0, 0, 0], [30, 0, 0], [100, 0, 0]]))
    assert (light.pose_rank, pair.pose_rank, uneven.pose_rank, body(TETRAHEDRON).pose_rank) == (3, 5, 5, 6)
    assert [len(x.symmetries) for x in (light, pair, uneven)] == [1, 2, 1]
    turned = pair.symmetries[1]
    assert turned.permutation.tolist() == [1, 0]
    moved = pair.points.double().numpy() @ turned.rotation.T + turned.translation
    np.testing.assert_allclose(moved, pair.points.double().numpy()[::-1], atol=1e-9)


def test_what_is_no_single_body_is_refused_where_one_is_needed():
    points = torch.tensor([[0.0, 0, 0], [500, 0, 0]], dtype=torch.float64)
    stick = CalibrationObject(points, torch.ones(2, 3).double(), name="it")
    with pytest.raises(InputError, match=r"object it: found 2 fiducials on one line.* to harvest crops"):
        stick.require_rigid("to harvest crops")
    both = CalibrationObject.of_several([stick, load_object("wand4")])
    with pytest.raises(InputError, match="found 2, expected a single one to calibrate without a factory calibration"):
        calibrate_from_scratch({}, imgcal.load_rig("T4"), both)


def test_all_but_a_single_body_is_taken_for_unknown_markers():
    body, lights = load_object("wand4"), load_object("lights")
    points = torch.tensor([[0.0, 0, 0], [500, 0, 0]], dtype=torch.float64)
    stick = CalibrationObject(points, torch.ones(2, 3).double(), radius=torch.full((2,), 7.0), name="it")
    light = CalibrationObject(points[:1], torch.ones(1, 3).double(), name="lamp")
    assert body.as_unknown() is body
    both = CalibrationObject.of_several([body, stick])
    for obj, known in ((stick, [2]), (light, []), (lights, []), (both, [4, 2])):
        found = obj.as_unknown()
        check_object(found)
        assert found.unknown_markers and found.exact and found.pose_rank == 3
        assert found.num_fiducials == MOST_LIGHTS + sum(known)
        assert found.name == obj.name and found.as_unknown() is found
        assert [first for first, _ in found.known_parts] == [0, 4][: len(known)]
        for (_, points), part in zip(found.known_parts, obj.each, strict=False):
            np.testing.assert_allclose(points, part.points.double().numpy())
    assert stick.as_unknown().radius.tolist() == [7.0] * (MOST_LIGHTS + 2)
    crowd = CalibrationObject.of_several([body] * 5).as_unknown()
    assert crowd.parts[-1].num_fiducials == 20  # as many lights as the objects have markers


def test_unknown_markers_come_last_among_several() -> None:
    body, lights = load_object("wand4"), load_object("lights")
    both = CalibrationObject.of_several([lights, body])
    assert [part.name for part in both.parts] == ["wand4", "lights"]
    assert both.has_lights and not both.unknown_markers and not CalibrationObject.of_several([body, body]).has_lights
    with pytest.raises(InputError, match="single or unknown markers twice"):
        CalibrationObject.of_several([body, lights, lights])


def test_several_objects_keep_their_shapes_and_get_different_names() -> None:
    wand, cube = load_object("wand4"), load_object("cube8")
    both = CalibrationObject.of_several([wand, cube, cube])
    assert [part.name for part in both.parts] == ["wand4", "cube8", "cube8-2"]
    assert both.part_of.tolist() == [0] * 4 + [1] * 8 + [2] * 8
    assert both.pose_rank == 6
    assert len(both.symmetries) == 1
    for part, own in zip(both.parts, (wand, cube, cube), strict=True):
        assert part.origin is not None
        torch.testing.assert_close(part.points + part.origin, own.points)
        torch.testing.assert_close(part.points.mean(0), torch.zeros(3, dtype=torch.float64))
    assert both.rows[4] == ("cube8", 0)
    assert CalibrationObject.of_several([wand]) is wand


@pytest.mark.parametrize("other", ["charuco", "scale"])
def test_what_cannot_be_among_several_is_named(other: str) -> None:
    wand = load_object("wand4")
    wrong = replace(wand, scale_tolerance=0.01) if other == "scale" else load_object(other)
    with pytest.raises(InputError, match="among several objects"):
        CalibrationObject.of_several([wand, wrong])
    with pytest.raises(InputError, match="found 2, expected a single one for a running rig"):
        CalibrationObject.of_several([wand, wand]).require_rigid("for a running rig")

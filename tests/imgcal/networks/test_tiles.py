"""Tiles: today's objects in one crop, as they were; many small markers in several, each counted once."""

from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.networks import Expectation, Tiles
from imgcal.networks.tiles import LEAST_RADIUS
from imgcal.types import CalibrationObject
from tests.imgcal.plates import plate, telephoto

POSES = RigidTransform(torch.eye(3).double().expand(2, 3, 3), torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]]).double())


@pytest.mark.parametrize("name", ["asymmetric8", "cube8", "cube27", "sphere64", "wand4"])
@pytest.mark.parametrize("rig", ["T4", "U7", "O10"])
def test_shipped_objects_are_looked_at_in_one_crop_a_camera_as_they_are(name: str, rig: str) -> None:
    factory, obj = imgcal.load_rig(rig), imgcal.load_object(name)
    expected = Expectation.of(factory, obj, POSES)
    tiles = Tiles.of_object(factory, obj, POSES, 96)
    whole = expected.placement(factory, 96)
    assert not tiles.divided
    assert tiles.usual is None
    assert torch.equal(tiles.placement.corner, whole.corner)
    assert torch.equal(tiles.placement.scale, whole.scale)
    # The very tensors, since others of the same values are summed in another order.
    assert tiles.arrange_expected(expected) is expected
    assert tiles.join(expected.uv[0], factory.num_cameras, obj.num_fiducials).data_ptr() == expected.uv.data_ptr()
    assert torch.equal(tiles.sum_by_camera(expected.uv[0], factory.num_cameras), expected.uv[0].sum(1))


@pytest.mark.parametrize("radius", [None, 0.5])
def test_many_small_markers_are_divided_among_tiles_that_show_them_as_in_training(radius: float | None) -> None:
    rig, obj = telephoto(), plate(radius=radius)
    expected = Expectation.of(rig, obj, POSES[:1], 0.6)
    whole = expected.placement(rig, 96)
    assert float((expected.radius[0] / whole.scale[:, None]).max()) < LEAST_RADIUS
    tiles = Tiles.of_object(rig, obj, POSES, 96)
    assert tiles.divided
    seen = tiles.arrange_expected(Expectation.of(rig, obj, POSES[:1], tiles.usual))
    shown = seen.queries(tiles.placement).radius[tiles.there]
    assert 1.2 < float(shown.min()) <= float(shown.max()) < 2.4
    assert 5 < float(tiles.there.sum(1).double().mean()) < 30
    # Each counts once in each camera, well inside of its tile.
    assert torch.equal(tiles.join(torch.ones_like(tiles.fiducial), 2, 90), torch.ones(2, 90, dtype=torch.long))
    assert int(tiles.counts.sum()) == 180
    assert not bool((tiles.counts & ~tiles.there).any())
    place = tiles.placement.to_crop(seen.uv[0])[tiles.counts]
    assert float(place.min()) > 12
    assert float(place.max()) < 84
    # There and back: what is arranged by tile is what was expected of each camera.
    assert torch.equal(tiles.join(seen.uv[0], 2, 90), expected.uv[0])
    assert torch.equal(tiles.sum_by_camera(torch.ones_like(tiles.there).double(), 2), torch.full((2,), 90.0).double())


def test_what_is_not_in_view_is_in_no_tile() -> None:
    rig, obj = telephoto(), plate()
    aside = RigidTransform(torch.eye(3).double()[None], torch.tensor([[60.0, 0.0, 0.0]]).double())
    expected = Expectation.of(rig, obj, aside, 0.6)
    assert 0 < int(expected.visible.sum()) < 180
    tiles = Tiles.from_neighbours(expected, 96)
    assert torch.equal(tiles.join(tiles.there, 2, 90), expected.visible[0])
    beyond = replace(expected, visible=expected.visible & (torch.arange(2) == 1)[:, None])
    assert tiles.camera.unique().tolist() == [0, 1]
    assert Tiles.from_neighbours(beyond, 96).camera.unique().tolist() == [1]
    assert not bool(tiles.select_cameras(torch.tensor([True, False])).there[tiles.camera == 1].any())


def test_a_few_small_markers_far_apart_are_no_neighbours() -> None:
    points = torch.tensor([[x, y, 0.0] for x in (-35.0, 0.0, 35.0) for y in (-30.0, 30.0)]).double()
    few = CalibrationObject(points, torch.zeros_like(points), torch.full((6,), 0.3).double())
    assert not Tiles.of_object(telephoto(), few, POSES, 96).divided


def test_an_object_that_no_camera_sees_is_not_divided() -> None:
    behind = RigidTransform(torch.eye(3).double()[None], torch.tensor([[0.0, 0.0, -900.0]]).double())
    assert not Tiles.of_object(telephoto(), plate(), behind, 96).divided

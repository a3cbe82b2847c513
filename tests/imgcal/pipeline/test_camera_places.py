"""Blobs that no place of a camera explains are no sign that it moved; the object in another place is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import associate
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate
from imgcal.pipeline.camera_places import CameraView
from imgcal.synthesis import PhysicalDrift, simulate_volume
from imgcal.types import CalibrationObject, MovedError
from scripts.benchmarks import camera_faults as damage
from tests.imgcal.association.stick_scenes import PAIR, TRIPLE

CAMERA, COUNT, FIRST = 3, 24, 12


def stick_in_a_room(points):
    rig, points = read_rig("room10"), torch.tensor(points, dtype=torch.float64)
    obj = CalibrationObject(points, torch.ones(len(points), 3))
    return rig, obj, simulate_volume(rig, obj, COUNT, torch.Generator().manual_seed(1), PhysicalDrift())


def with_reflection(table, first=0):
    """Add a reflection that drifts slowly in one camera's image, from a snapshot on."""
    snapshot = np.arange(first, COUNT)
    count = len(snapshot)
    reflection = replace(
        table,
        uv=np.column_stack((600 - 0.7 * snapshot, 500 + 0.1 * snapshot)),
        sigma=np.full(count, 0.1),
        camera=np.full(count, CAMERA),
        snapshot=snapshot,
        fiducial=np.full(count, -1),
        radius=np.full(count, np.nan),
        flags=np.zeros(count, dtype=np.uint8),
    )
    return damage.joined(table, reflection)


def hidden_from(table, first):
    """Leave out the object's blobs in one camera from a snapshot on."""
    gone = (table.camera == CAMERA) & (table.snapshot >= first)
    return table.select(~gone)


@pytest.mark.parametrize("since", [0, FIRST])
@pytest.mark.parametrize("points", [PAIR, TRIPLE])
def test_a_reflection_beside_a_hidden_stick_is_no_motion(points, since):
    rig, obj, truth = stick_in_a_room(points)
    table = with_reflection(hidden_from(damage.blobs(truth, 1, clutter=0.0), FIRST), since)
    result = calibrate(table, rig, obj)
    assert result.moved == () and result.tally.kept[:FIRST, CAMERA].sum() > FIRST
    if since == 0:  # it was there beside the whole stick, too
        assert result.tally.unexplained[:, CAMERA].sum() == 0


@pytest.mark.parametrize("reflection", [False, True])
@pytest.mark.parametrize("points", [PAIR, TRIPLE])
def test_a_camera_that_turns_beyond_its_prior_is_named_by_a_stick(points, reflection):
    rig, obj, truth = stick_in_a_room(points)
    moved = damage.changed_from(truth, obj, CAMERA, FIRST, lambda r: damage.turned(r, CAMERA, 8.0))
    table = damage.blobs(moved, 1, clutter=0.0)
    with pytest.raises(MovedError, match=rf"camera cam04 moved before snapshot {FIRST:05d}"):
        calibrate(with_reflection(table) if reflection else table, rig, obj)


def view_of(table, labelled, rig, obj):
    """The camera's blobs of one table, and the object where another, labelled one shows it."""
    found = associate(labelled, rig, obj)
    assert found.used == list(range(COUNT))
    poses = [snapshot.rig_from_object for snapshot in found.snapshots]
    poses = type(poses[0]).stack(poses)
    bare = replace(table, fiducial=np.full(len(table), -1))
    return CameraView.of(replace(found, detections=bare), poses, rig, obj, CAMERA)


def test_what_explains_the_blobs_of_a_camera():
    rig, obj = read_rig("room10"), load_object("wand4")
    truth = simulate_volume(rig, obj, COUNT, torch.Generator().manual_seed(1), PhysicalDrift())
    table = damage.blobs(truth, 1)
    before, after = np.arange(FIRST), np.arange(FIRST, COUNT)

    steady = view_of(with_reflection(table), table, rig, obj)
    assert steady.one_place_explains(before, after) and steady.some_turn_explains(after)

    bumped = damage.changed_from(truth, obj, CAMERA, FIRST, lambda r: damage.turned(r, CAMERA, 8.0))
    moved = view_of(with_reflection(damage.blobs(bumped, 1)), table, rig, obj)
    assert not moved.one_place_explains(before, after) and moved.some_turn_explains(after)
    assert moved.one_place_explains(before)

    mirrored = damage.mirrored(table, rig, CAMERA, "u")
    mirrored = damage.joined(table.select(table.snapshot < FIRST), mirrored.select(mirrored.snapshot >= FIRST))
    turned = view_of(mirrored, table, rig, obj)
    assert not turned.one_place_explains(before, after) and turned.some_turn_explains(after)

    hidden = view_of(with_reflection(hidden_from(table, FIRST)), table, rig, obj)
    assert not hidden.one_place_explains(before, after) and not hidden.some_turn_explains(after)
    nothing = view_of(hidden_from(table, FIRST), table, rig, obj)
    assert not nothing.one_place_explains(before, after) and not nothing.some_turn_explains(after)

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, read_rig
from imgcal.pipeline import score
from imgcal.synthesis import (
    HandHeld,
    PhysicalDrift,
    find_seen_volume,
    look_at,
    sample_path,
    sample_volume,
    simulate_volume,
    true_detections,
)
from imgcal.types import ConvexVolume

CORNER = ConvexVolume(((0, 0, 0), (900, 0, 0), (0, 900, 0), (0, 0, 900)))


def test_a_wand_in_a_room_is_seen_by_some_cameras_at_a_time():
    rig, obj = read_rig("room10"), load_object("wand4")
    truth = simulate_volume(rig, obj, 40, torch.Generator().manual_seed(0), PhysicalDrift())
    table = true_detections(truth)
    assert len(table) == int(truth.visible.sum()) < truth.visible.numel()
    assert 5 < truth.visible.any(-1).sum(1).float().mean() < 10
    width, height = rig.image_size[0].tolist()
    assert ((table.uv > -0.5) & (table.uv < [width - 0.5, height - 0.5])).all()
    error = score(table, truth.rig, obj).distances
    assert error.max() < 1e-6


def test_places_are_even_in_the_volume():
    places = sample_volume(CORNER, 4000, torch.Generator().manual_seed(0)).numpy()
    assert CORNER.contains(places).all()
    np.testing.assert_allclose(places.mean(0), 225, atol=12)  # the centroid of a tetrahedron


@pytest.mark.parametrize("volume", [CORNER, ConvexVolume.box((-500, -500, 0), (500, 500, 2000))])
def test_a_hand_is_as_fast_as_said_smooth_and_stays_inside(volume):
    hand = HandHeld(speed=600.0, turning=90.0, rate=100.0)
    poses, motion = sample_path(hand, volume, 6000, torch.Generator().manual_seed(3))
    places = poses.translation.numpy()
    assert volume.contains(places).all()
    step = np.linalg.norm(np.diff(places, axis=0), axis=1) * hand.rate
    assert abs(step.mean() / 600 - 1) < 0.15
    # Motion says what differences say, and nothing shakes: of the path's power next to nothing is above 3 Hz.
    velocity = ((motion.after.translation - motion.before.translation) / motion.seconds).norm(dim=-1).numpy()
    np.testing.assert_allclose(velocity[:-1], step, rtol=0.2, atol=60)
    power = np.abs(np.fft.rfft((places - places.mean(0)) * np.hanning(6000)[:, None], axis=0)) ** 2
    assert power[np.fft.rfftfreq(6000, 0.01) > 3].sum() < 1e-4 * power.sum()
    turn = poses.rotation[1:] @ poses.rotation[:-1].mT
    angle = np.degrees(np.arccos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).numpy()))
    assert abs(angle.mean() * hand.rate / 90 - 1) < 0.2


def test_the_same_seed_is_the_same_way():
    rig, obj = read_rig("room10"), load_object("wand4")
    a, b, c = (
        simulate_volume(rig, obj, 5, torch.Generator().manual_seed(seed), None, hand=HandHeld()).uv
        for seed in (1, 1, 2)
    )
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_a_volume_is_found_where_cameras_look_together():
    rig = read_rig("room10")
    box = find_seen_volume(replace(rig, volume=None))
    middle = torch.tensor([box.low, box.high]).mean(0).double()
    assert rig.project(middle[None]).visible.sum() >= 8
    with pytest.raises(InputError, match="volume"):
        find_seen_volume(rig.select([0]))
    outward = look_at(rig.positions[[0, 5]], 2 * rig.positions[[0, 5]])
    away = replace(rig.select([0, 5]), cam_from_rig=outward)
    with pytest.raises(InputError, match="no two cameras"):
        find_seen_volume(away)

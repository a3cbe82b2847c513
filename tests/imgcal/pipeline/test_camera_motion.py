"""Motion is that of the cameras that moved, whichever they are."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import Gauge
from imgcal.pipeline import calibrate, motion_since_factory
from imgcal.synthesis import simulate_truth, true_detections


def bumped(rig, obj, cameras, seed=0):
    """A calibration of a rig of which some cameras were bumped."""
    step = torch.zeros(rig.num_cameras, 15, dtype=torch.float64)
    step[list(cameras), 1], step[list(cameras), 3] = 0.008, 6.0
    truth = simulate_truth(rig.retract(step), obj, 8, torch.Generator().manual_seed(seed), None)
    table = true_detections(truth)
    noise = 0.05 * np.random.default_rng(seed).standard_normal(table.uv.shape)
    return calibrate(replace(table, uv=table.uv + noise, sigma=np.full(len(table), 0.05)), rig, obj)


@pytest.mark.parametrize("camera", [0, 7])
def test_the_bumped_camera_is_named_even_if_it_is_the_first(camera, o10, asymmetric8):
    result = bumped(o10, asymmetric8, [camera])
    motion = motion_since_factory(result)
    name = o10.camera_names[camera]
    assert motion.moved == (camera,)
    assert motion.position_mm[camera] == pytest.approx(6, abs=1)
    assert motion.rotation_deg[camera] == pytest.approx(np.degrees(0.008), abs=0.1)
    others = [i for i in range(10) if i != camera]
    assert motion.position_mm[others].max() < 2
    assert f"1 of 10 cameras moved since the factory calibration: {name} (0.4" in motion.sentence
    (move,) = motion.moves
    assert (move.camera, move.snapshot, move.kind, move.unit) == (name, None, "position", "mm")  # the surer of both
    assert move.size == pytest.approx(float(motion.position_mm[camera])) and 0 < move.sigma < 0.1 * move.size
    # A reference camera has moved all others when it is itself that was bumped.
    relative = motion_since_factory(result, Gauge.from_camera(camera, 10))
    assert len(relative.moved) == 9 and camera not in relative.moved


def test_a_steady_rig_has_not_moved(o10, asymmetric8):
    motion = motion_since_factory(bumped(o10, asymmetric8, []))
    assert motion.moved == motion.moves == () and "no camera has moved" in motion.sentence


def test_one_camera_moves_relative_to_nothing(o10, asymmetric8):
    motion = motion_since_factory(bumped(o10.select([0]), asymmetric8, []))
    assert motion.moved == () and motion.sentence == ""

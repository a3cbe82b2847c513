"""Boards that are simulated and seen give the rig back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.pipeline import calibrate
from imgcal.synthesis import PhysicalDrift, render_board, simulate_board, true_detections
from imgcal.types import Board, CalibrationObject


def labelled(truth, noise, seed=0):
    seen = true_detections(truth)
    shift = noise * np.random.default_rng(seed).standard_normal(seen.uv.shape)
    return replace(seen, uv=seen.uv + shift, sigma=np.full(len(seen), noise))


@pytest.mark.parametrize("kind", ["charuco", "checkerboard"])
def test_images_of_a_board_give_the_rig(kind):
    rig = imgcal.load_rig("T4").select([0, 1]).resized(torch.tensor([1024, 544]))
    obj, generator = imgcal.load_object(kind), torch.Generator().manual_seed(3)
    truth = simulate_board(rig, obj, 6, generator, PhysicalDrift())
    shots = [render_board(obj.board, truth.rig, truth.rig_from_object[k], generator) for k in range(6)]
    found = calibrate({name: [shot[name] for shot in shots] for name in rig.camera_names}, rig, obj)
    assert found.identity == "coded"
    assert float(found.rms) < 0.3 < float(found.before.rms)


def test_a_print_of_another_size_is_named():
    rig, generator = imgcal.load_rig("room10"), torch.Generator().manual_seed(7)
    big = CalibrationObject.of_board(Board("charuco", 5, 7, 120.0, 90.0, "DICT_4X4_50"))
    small = CalibrationObject.of_board(Board("charuco", 5, 7, 110.0, 82.0, "DICT_4X4_50"))
    truth = simulate_board(rig, big, 30, generator, None)
    with pytest.raises(RefusedError, match=r"as if it were .* % larger than its file says"):
        calibrate(labelled(truth, 0.1), rig, small)

"""The bend of a printed board is estimated with the rig, and as well as it says."""

from dataclasses import replace

import numpy as np
import torch

import imgcal
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import Board, CalibrationObject

BEND = (0.4, -0.3)  # mm
BOARD = Board("charuco", columns=6, rows=8, pitch=12.0, marker=9.0, dictionary="DICT_4X4_50")


def test_the_bend_of_a_board_is_found_with_its_sigma() -> None:
    factory = imgcal.load_rig("T4")
    bent = CalibrationObject.of_board(replace(BOARD, bend=BEND))
    generator, noise = torch.Generator().manual_seed(3), np.random.default_rng(3)
    seen = true_detections(simulate_truth(factory, bent, 12, generator, PhysicalDrift()))
    seen = replace(seen, uv=seen.uv + 0.1 * noise.standard_normal(seen.uv.shape), sigma=np.full(len(seen.sigma), 0.1))
    assumed = CalibrationObject.of_board(replace(BOARD, warp=0.5))
    result = imgcal.calibrate(seen, factory, assumed)
    modes = result.estimate.modes
    assert modes is not None and modes.at_rest
    found, sigma = 0.5 * modes.offset, 0.5 * np.sqrt(modes.covariance.diagonal())
    assert sigma.max() < 0.05
    assert (np.abs(found - BEND) < 4 * sigma).all()
    flat = imgcal.calibrate(seen, factory, CalibrationObject.of_board(replace(BOARD, warp=0.0)))
    assert flat.estimate.modes is None

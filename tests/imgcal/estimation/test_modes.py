"""The bend of a board: found, and part of the uncertainty."""

from dataclasses import replace

import numpy as np
import torch

import imgcal
from imgcal.pipeline import calibrate
from imgcal.synthesis import PhysicalDrift, simulate_board, true_detections
from imgcal.types import CalibrationObject


def labelled(truth, noise, seed=0):
    seen = true_detections(truth)
    shift = noise * np.random.default_rng(seed).standard_normal(seen.uv.shape)
    return replace(seen, uv=seen.uv + shift, sigma=np.full(len(seen), noise))


def test_a_bent_board_is_taken_as_it_is_bent():
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(5)
    flat = imgcal.load_object("checkerboard")
    bent = CalibrationObject.of_board(replace(flat.board, bend=(0.4, -0.25)))
    truth = simulate_board(rig, bent, 15, generator, PhysicalDrift())
    found = calibrate(labelled(truth, 0.05), rig, flat)
    assert found.bend is not None and found.bend.is_certain
    assert abs(found.bend.x - 0.4) < 4 * found.bend.x_sigma < 0.2
    assert abs(found.bend.y + 0.25) < 4 * found.bend.y_sigma < 0.2
    stiff = calibrate(labelled(truth, 0.05), rig, CalibrationObject.of_board(replace(flat.board, warp=0.0)))
    assert found.shape == () and stiff.shape != ()  # not fiducial by fiducial


def test_the_bend_is_part_of_the_uncertainty_of_the_rig():
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(6)
    obj = imgcal.load_object("checkerboard")
    seen = labelled(simulate_board(rig, obj, 10, generator, None), 0.05)
    free = calibrate(seen, rig, obj)
    stiff = calibrate(seen, rig, CalibrationObject.of_board(replace(obj.board, warp=0.0)))
    wider = free.estimate.covariance().diagonal() / stiff.estimate.covariance().diagonal().clamp_min(1e-300)
    assert stiff.bend is None
    assert float(wider[wider > 0].max()) > 1.05

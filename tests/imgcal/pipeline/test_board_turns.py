"""Images that do not say which way round a board is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.pipeline import calibrate, calibrate_from_scratch
from imgcal.pipeline.board_turns import settle_turns
from imgcal.synthesis import simulate_board, true_detections
from imgcal.types import Board, CalibrationObject


def test_images_that_do_not_say_the_turn_of_a_board_agree_about_it():
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(8)
    obj = CalibrationObject.of_board(Board("checkerboard", 7, 7, 30.0))
    truth = simulate_board(rig, obj, 4, generator, None)
    seen = true_detections(truth)
    turned = seen.fiducial.copy()
    for image, (s, c) in enumerate(np.unique(np.stack((seen.snapshot, seen.camera), 1), axis=0)):
        rows = (seen.snapshot == s) & (seen.camera == c)
        turned[rows] = obj.board.turns[image % 4][1][turned[rows]]
    there = seen.snapshot != 1  # no camera sees the board there
    found = settle_turns(replace(seen, fiducial=turned).select(there), rig, obj)
    assert float(calibrate(found, rig, obj).rms) < 0.01
    with pytest.raises(RefusedError, match="looks the same when turned"):
        calibrate_from_scratch(found, rig, obj)

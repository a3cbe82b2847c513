"""Images that do not say which way round a board is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.pipeline import calibrate, calibrate_from_scratch, score
from imgcal.pipeline.board_turns import find_exchanged, settle_turns
from imgcal.synthesis import PhysicalDrift, simulate_board, true_detections
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


def bend_at_random(board, snapshots, drift=PhysicalDrift(), noise=0.1):
    """The factory rig, and a bent board's points: as labelled in truth, and with each snapshot turned at random."""
    rig, random = imgcal.load_rig("T4"), np.random.default_rng(1)
    truth = simulate_board(rig, CalibrationObject.of_board(board), snapshots, torch.Generator().manual_seed(1), drift)
    seen = true_detections(truth)
    shift = noise * random.standard_normal(seen.uv.shape)
    seen = replace(seen, uv=seen.uv + shift, sigma=np.full(len(seen), noise))
    turn = random.integers(len(board.turns), size=snapshots)
    place = np.stack([place for _, place in board.turns])[turn]
    return rig, seen, replace(seen, fiducial=place[seen.snapshot, seen.fiducial])


@pytest.mark.parametrize("board", [Board("circles", 7, 7, 20.0), Board("checkerboard", 7, 7, 20.0)])
def test_snapshots_agree_on_how_a_square_board_bends(board):
    rig, seen, turned = bend_at_random(replace(board, bend=(1.0, -0.5)), 12)
    assert (turned.fiducial != seen.fiducial).any()
    obj = CalibrationObject.of_board(board)
    expected, found = calibrate(seen, rig, obj), calibrate(turned, rig, obj)
    assert (expected.bend.x, expected.bend.y) == pytest.approx((1.0, -0.5), abs=0.05)
    bend, sigma = (found.bend.x, found.bend.y), (found.bend.x_sigma, found.bend.y_sigma)
    assert sorted(bend) == pytest.approx([expected.bend.y, expected.bend.x], abs=1e-3)
    assert sorted(sigma) == pytest.approx(sorted((expected.bend.x_sigma, expected.bend.y_sigma)), rel=0.01)
    apart = (found.rig.local(expected.rig) / expected.estimate.problem.prior_std[0]).abs()
    assert float(apart.max()) < 1e-3
    assert found.predicted_error.median_mm == pytest.approx(expected.predicted_error.median_mm, rel=0.01)


@pytest.mark.parametrize("warp", [0.0, 0.01])
def test_a_known_bend_decides_the_turn_of_every_snapshot(warp):
    board = Board("circles", 7, 7, 20.0, bend=(1.0, -0.5), warp=warp)
    rig, seen, turned = bend_at_random(board, 12)
    obj = CalibrationObject.of_board(board)
    expected, found = calibrate(seen, rig, obj), calibrate(turned, rig, obj)
    assert float(found.rms) == pytest.approx(float(expected.rms), rel=1e-3)
    torch.testing.assert_close(found.rig.focal_length, expected.rig.focal_length, rtol=1e-5, atol=0)


def test_a_score_takes_a_known_bend_the_right_way_round():
    board = Board("circles", 7, 7, 20.0, bend=(1.0, -0.5))
    rig, seen, turned = bend_at_random(board, 6, drift=None)
    obj = CalibrationObject.of_board(board)
    expected, found = score(seen, rig, obj), score(turned, rig, obj)
    assert float(found.distances.max()) == pytest.approx(float(expected.distances.max()), rel=1e-3)


def test_snapshots_that_do_not_show_a_bend_keep_their_labels():
    board = Board("circles", 7, 7, 20.0)
    rig, _, turned = bend_at_random(board, 12)
    found = calibrate(turned, rig, CalibrationObject.of_board(board))
    np.testing.assert_array_equal(found.labelled.detections.fiducial, turned.fiducial)


def test_the_fewer_snapshots_are_those_that_are_exchanged():
    shown = np.array([[-0.5, 1.0], [1.0, -0.5], [-0.6, 1.1], [0.2, 0.3]])
    information = np.tile(400 * np.eye(2), (4, 1, 1))
    information[3] = 0.0  # this one shows nothing
    pull = (information @ shown[..., None])[..., 0]
    given = information, pull
    assert find_exchanged(*given, np.zeros(2), 1.0).tolist() == [False, True, False, False]
    assert find_exchanged(*given, np.array([1.0, -0.5]), 0.1).tolist() == [True, False, True, False]
    assert find_exchanged(*given, np.array([1.0, -0.5]), 0.0).tolist() == [True, False, True, False]
    assert not find_exchanged(*given, np.array([0.3, 0.3]), 0.0).any()


def test_bends_that_differ_from_snapshot_to_snapshot_exchange_none():
    scattered = np.random.default_rng(0).standard_normal((30, 2))
    information = np.tile(400 * np.eye(2), (30, 1, 1))  # as if each were known to 0.05 mm
    assert not find_exchanged(information, 400 * scattered, np.zeros(2), 1.0).any()


def test_the_smallest_board_cannot_bend():
    board = Board("checkerboard", 3, 3, 60.0)
    rig, _, turned = bend_at_random(board, 12)
    np.testing.assert_array_equal(
        calibrate(turned, rig, CalibrationObject.of_board(board)).labelled.detections.fiducial, turned.fiducial
    )

"""Boards that OpenCV draws, seen through a lens: all points are found where they are, with their numbers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import imgcal
from imgcal.detection import DetectionOptions, detect_snapshot
from imgcal.detection.boards import UNKNOWN_SIGMA, corner_sigma, find_board
from imgcal.errors import InputError
from imgcal.synthesis import render_board, simulate_board
from imgcal.synthesis.boards import is_white
from imgcal.types import Board, CalibrationObject

FINER = 4  # places of a pixel, across and down
KINDS = ("charuco", "aprilgrid", "checkerboard", "circles")


def rig_of(cameras=1):
    rig = imgcal.load_rig("T4").select(range(cameras))
    return rig.resized(torch.tensor([1024, 544]))


def seen(obj, rig, seed=1, printed=None):
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_board(rig, obj, 1, generator, None)
    return truth, render_board(printed or obj.board, rig, truth.rig_from_object[0], generator)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("inverted", [False, True])
def test_finds_every_point_of_a_board_where_it_is(kind, inverted):
    obj = imgcal.load_object(kind)
    obj = CalibrationObject.of_board(replace(obj.board, inverted=inverted))
    rig = rig_of()
    truth, frames = seen(obj, rig)
    found = detect_snapshot(frames, DetectionOptions(), board=obj.board)
    assert len(found.fiducial) > 0.8 * obj.num_fiducials
    error = found.uv - truth.uv[0, 0].numpy()[found.fiducial]
    assert np.median(np.linalg.norm(error, axis=1)) < 0.3
    assert np.abs(np.median(error, axis=0)).max() < 0.15  # no shift by half a pixel


@pytest.mark.parametrize("seed", [2, 4, 10])
def test_corners_between_markers_are_as_good_as_their_sigma(seed):
    obj, rig = imgcal.load_object("charuco"), imgcal.load_rig("T4").select([0])
    truth, frames = seen(obj, rig, seed)
    found = detect_snapshot(frames, DetectionOptions(), board=obj.board)
    error = found.uv - truth.uv[0, 0].numpy()[found.fiducial]
    assert len(error) == obj.num_fiducials and np.abs(error).max() < 0.12
    assert (np.linalg.norm(error, axis=1) < 5 * found.sigma).all()


@pytest.mark.parametrize("blur", [0.7, 1.5])
@pytest.mark.parametrize("width", [1024, 2048])
def test_blur_does_not_move_the_corners_of_tags(width, blur, monkeypatch):
    monkeypatch.setattr("imgcal.synthesis.boards.BLUR", blur)
    obj, rig = imgcal.load_object("aprilgrid"), imgcal.load_rig("T4").select([0])
    rig = rig.resized(torch.tensor([width, width * 17 // 32]))
    truth, frames = seen(obj, rig, 2)
    found = detect_snapshot(frames, DetectionOptions(), board=obj.board)
    error = (found.uv - truth.uv[0, 0].numpy()[found.fiducial]).reshape(-1, 4, 2)
    assert len(error) > 6 and np.sqrt(np.square(error).mean()) < 0.05
    assert np.abs(error.mean((0, 1))).max() < 0.02  # no shift by half a pixel
    corners = found.uv.reshape(-1, 4, 2)
    outward = corners - corners.mean(1, keepdims=True)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    assert abs((error * outward).sum(-1).mean()) < 0.02
    assert np.median(found.sigma) < 0.06


def test_sides_of_tags_that_a_lens_bends_do_not_move_their_corners():
    board = replace(imgcal.load_object("aprilgrid").board, columns=2, rows=2, pitch=200.0, marker=155.0)
    obj, rig = CalibrationObject.of_board(board), imgcal.load_rig("T4").select([0])
    rig = replace(rig, distortion=torch.tensor([[-0.3, 0.1, 0.0, 0.0, 0.0]], dtype=torch.float64))
    truth, frames = seen(obj, rig, 1)
    found = detect_snapshot(frames, DetectionOptions(), board=obj.board)
    error = found.uv - truth.uv[0, 0].numpy()[found.fiducial]
    assert len(error) >= 8 and np.abs(error).max() < 0.12


def test_sigma_is_the_scatter_of_the_corners():
    random = np.random.default_rng(0)
    xy = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), -1).reshape(-1, 2)
    depth = 1 + xy @ [0.02, 0.01]
    uv = 100 * (xy @ [[0.9, 0.2], [-0.1, 0.8]]) / depth[:, None]
    found = [np.median(corner_sigma(xy, uv + 0.3 * random.standard_normal(uv.shape))) for _ in range(20)]
    assert np.mean(found) == pytest.approx(0.3, rel=0.15)


@pytest.mark.parametrize("wrong", [0, 3, 27])  # at a corner of the board, at its edge, inside
def test_a_corner_off_its_neighbours_is_less_certain_than_they_are(wrong):
    random = np.random.default_rng(wrong)
    xy = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), -1).reshape(-1, 2)
    uv = 40 * xy @ [[0.9, 0.2], [-0.1, 0.8]] + 0.04 * random.standard_normal(xy.shape)
    uv[wrong] += [0.6, -0.5]
    sigma = corner_sigma(xy, uv)
    assert sigma[wrong] > 0.1 and sigma.argmax() == wrong
    assert np.median(sigma) == pytest.approx(0.04, rel=0.5)


@pytest.mark.parametrize("count", [6, 9, 14])
@pytest.mark.parametrize("beside", [0, 1])
def test_corners_on_one_line_do_not_tell_their_sigma(count, beside):
    random = np.random.default_rng(count)
    xy = 40.0 * np.concatenate((np.column_stack((np.zeros(count), np.arange(count))), np.ones((beside, 2))))
    for noise in (0.0, 0.2):
        uv = 100 + xy @ [[0.9, 0.2], [-0.1, 0.8]] + noise * random.standard_normal(xy.shape)
        assert (corner_sigma(xy, uv) == UNKNOWN_SIGMA).all()


def test_a_long_line_of_corners_beside_a_grid_does_not_change_its_sigma():
    random = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), -1).reshape(-1, 2)
    xy = np.concatenate((grid, np.column_stack((np.zeros(30), 3.0 + np.arange(30)))))
    uv = 30 * xy @ [[0.9, 0.2], [-0.1, 0.8]]
    found = [np.median(corner_sigma(xy, uv + 0.1 * random.standard_normal(uv.shape))) for _ in range(20)]
    assert np.mean(found) == pytest.approx(0.1, rel=0.2)


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("charuco", {"dictionary": "DICT_5X5_50"}, "its markers are from DICT_4X4"),
        ("charuco", {"columns": 7, "rows": 5}, "but not in the layout of this board"),
        ("charuco", {"inverted": True}, "expected inverted: false"),
        ("aprilgrid", {"columns": 3, "rows": 3}, "expected 0 to 8"),
        ("checkerboard", {"columns": 7, "rows": 6}, "a board of (8x7|7x8) squares is visible, expected 7x6"),
        (
            "circles",
            {"columns": 3},
            "grid of 4x11 circles is visible, expected an asymmetric grid of 3x11",
        ),
        ("circles", {"asymmetric": False}, "an asymmetric grid of 4x11 circles is visible, expected a grid of 4x11"),
        ("circles", {"inverted": True}, "expected inverted: false"),
    ],
)
def test_says_why_a_board_is_not_found(kind, change, words):
    printed = imgcal.load_object(kind)
    rig = rig_of()
    _, frames = seen(printed, rig)
    with pytest.raises(InputError, match=words):
        imgcal.detect(frames, board=replace(printed.board, **change))


def turned_grid(board, turn, ends=(0, 0), size=(480, 640)):
    """Draw circles of a board that is turned about its normal, in front of a camera: frame, and pixels (N, 2)."""
    xy = board.points[:, :2] - (board.points[:, :2].max(0) + board.points[:, :2].min(0)) / 2
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    uv = (xy @ matrix.T) + np.array(size[::-1]) / 2 + ends
    frame = np.full((FINER * size[0], FINER * size[1]), 205.0)
    fine = np.rint((FINER * (uv + 0.5) - 0.5) * 256).astype(int)
    for place in fine:
        cv2.circle(frame, place.tolist(), round(0.3 * board.pitch * FINER * 256), 35.0, -1, shift=8)
    frame = frame.reshape(size[0], FINER, size[1], FINER).mean((1, 3))
    noise = np.random.default_rng(0).normal(0, 2, size)
    return np.clip(frame + noise, 0, 255).astype(np.uint8), uv


@pytest.mark.parametrize(("columns", "rows", "asymmetric"), [(4, 10, True), (4, 8, True), (4, 11, True), (7, 6, False)])
def test_circles_have_the_numbers_of_the_layout_however_the_grid_is_turned(columns, rows, asymmetric):
    board = Board("circles", columns, rows, 20.0 if asymmetric else 40.0, asymmetric=asymmetric)
    for turn in np.radians(range(0, 360, 30)):
        frame, uv = turned_grid(board, turn)
        found = find_board(frame, board)
        assert any(np.abs(found.uv - uv[order]).max() < 0.1 for _, order in board.turns)
        assert found.sigma.max() < 0.1


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("checkerboard", "camera camera: found two boards at once"),
        ("charuco", "visible twice"),
        ("aprilgrid", "visible twice"),
    ],
)
def test_two_boards_of_one_kind_at_once_are_named(kind, words):
    obj = imgcal.load_object(kind)
    size = np.array([obj.board.columns, obj.board.rows]) + 1.4
    place = np.stack(np.meshgrid(*(np.arange(0.5, 40 * length) / 40 - 0.7 for length in size)), -1)
    white = is_white(obj.board, place.reshape(-1, 2) * obj.board.pitch).reshape(place.shape[:2])
    board = cv2.GaussianBlur(np.where(white, 205.0, 35.0), (0, 0), 0.7)
    frame = np.full((board.shape[0] + 80, 2 * board.shape[1] + 160), 70.0)
    for left in (40, board.shape[1] + 120):
        frame[40 : 40 + board.shape[0], left : left + board.shape[1]] = board
        seen = frame.astype(np.uint8)
        if left == 40:
            assert len(imgcal.detect({"camera": seen}, board=obj.board).uv) == obj.num_fiducials
    with pytest.raises(InputError, match=words):
        imgcal.detect({"camera": seen}, board=obj.board)


def test_circles_that_the_image_cuts_off_leave_no_grid():
    board = Board("circles", 7, 6, 40.0)
    frame, uv = turned_grid(board, 0.0, ends=(200 - 6, 0))
    assert 628 < uv[:, 0].max() < 640
    assert not len(find_board(frame, board).uv)
    with pytest.raises(InputError, match="cut off by the edge of the image"):
        imgcal.detect({"camera": frame}, board=board)


def test_two_boards_at_once_are_named():
    board = Board("circles", 5, 4, 40.0)
    left, _ = turned_grid(board, 0.2, ends=(-150, 0))
    right, _ = turned_grid(board, 1.0, ends=(150, 0))
    frame = np.minimum(left, right)
    assert not len(find_board(frame, board).uv)
    with pytest.raises(InputError, match="2 of them are visible at once, expected one"):
        imgcal.detect({"camera": frame}, board=board)


@pytest.mark.parametrize(("dark", "light"), [(60, 160), (0, 255)])
def test_clutter_behind_a_board_is_no_further_row_of_squares(dark, light):
    obj = imgcal.load_object("checkerboard")
    columns, rows, size = obj.board.columns, obj.board.rows, 32
    random = np.random.default_rng(3)
    frame = np.kron(random.integers(30, 220, (4 * (rows + 6), 4 * (columns + 6))), np.ones((size // 4,) * 2))
    for column in range(columns):  # light and dark in turn, where the next row of squares would be
        at = 3 * size + column * size
        frame[2 * size + 8 : 2 * size + 24, at + 8 : at + 24] = light if column % 2 else dark
    margin = slice(3 * size - 12, (3 + rows) * size + 12), slice(3 * size - 12, (3 + columns) * size + 12)
    frame[margin] = 255
    squares = np.kron(np.add.outer(np.arange(rows), np.arange(columns)) % 2, np.ones((size, size)))
    frame[3 * size : (3 + rows) * size, 3 * size : (3 + columns) * size] = 20 + 220 * squares
    found = imgcal.detect({"camera": frame.astype(np.uint8)}, board=obj.board)
    assert len(found.fiducial) == obj.num_fiducials

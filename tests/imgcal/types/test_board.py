"""`Board`: where the fiducials of printed patterns are, how prints bend, and which turns look alike."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.types import Board
from imgcal.types.board import WARP

CHARUCO = Board("charuco", columns=5, rows=7, pitch=30.0, marker=22.0, dictionary="DICT_4X4_50")
APRILGRID = Board("aprilgrid", columns=3, rows=2, pitch=40.0, marker=30.0, dictionary="DICT_APRILTAG_36h11")
BOARDS = {
    "charuco": CHARUCO,
    "aprilgrid": APRILGRID,
    "odd chessboard": Board("checkerboard", columns=5, rows=4, pitch=20.0),
    "even chessboard": Board("checkerboard", columns=6, rows=4, pitch=20.0),
    "square chessboard": Board("checkerboard", columns=5, rows=5, pitch=20.0),
    "circles": Board("circles", columns=4, rows=3, pitch=25.0),
    "asymmetric circles": Board("circles", columns=4, rows=5, pitch=25.0, asymmetric=True),
}


@pytest.mark.parametrize(
    ("name", "count", "alike"),
    [
        ("charuco", 24, 1), ("aprilgrid", 24, 1), ("odd chessboard", 12, 1), ("even chessboard", 15, 2),
        ("square chessboard", 16, 4), ("circles", 12, 2), ("asymmetric circles", 20, 1),
    ],
)  # fmt: skip
def test_turns_put_fiducials_onto_each_other(name: str, count: int, alike: int) -> None:
    board = BOARDS[name]
    flat = board.points[:, :2] - board.points[:, :2].mean(0)
    assert len(flat) == count
    assert len(board.turns) == alike
    for angle, place in board.turns:
        turned = flat @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        assert np.allclose(turned, flat[place], atol=1e-9)


def test_tags_have_four_corners_each_clockwise_from_the_top_left() -> None:
    first = APRILGRID.points[:4, :2]
    assert first.tolist() == [[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [0.0, 30.0]]
    upwards = Board("aprilgrid", 3, 2, 40.0, marker=30.0, dictionary="DICT_APRILTAG_36h11", from_bottom=True)
    assert upwards.points[0].tolist() == [0.0, 40.0, 0.0]


def test_a_bend_is_a_paraboloid_with_its_deflection_in_the_middle() -> None:
    bent = Board("circles", columns=5, rows=3, pitch=20.0, bend=(2.0, -1.0))
    depth = bent.points[:, 2].reshape(3, 5)
    assert depth[1].tolist() == pytest.approx([-1.0, 0.5, 1.0, 0.5, -1.0])  # along x, in the middle row
    assert depth[0].tolist() == pytest.approx([0.0, 1.5, 2.0, 1.5, 0.0])
    modes = bent.modes
    assert modes.shape == (2, 15, 3)
    assert modes[0, 7, 2] == pytest.approx(WARP * 80.0)  # of the longer side
    assert Board("circles", 5, 3, 20.0, warp=0.0).modes.shape == (0, 15, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"columns": 2}, "found 2 columns and 7 rows, expected at least 3"),
        ({"marker": 30.0}, "found markers of 30 mm, expected more than 0 and less than 30 mm"),
    ],
)
def test_impossible_boards_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(CHARUCO, **change)

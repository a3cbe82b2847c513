"""Files of printed boards: round trips, and one-line errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.io import load_object
from imgcal.io.board_yaml import board_from_yaml, board_text
from imgcal.types import Board, CalibrationObject

WHERE = Path("board.yaml")
BOARDS = [
    Board("charuco", 5, 7, 30.0, marker=22.0, dictionary="DICT_4X4_50", first_id=3, legacy=True),
    Board("aprilgrid", 3, 2, 40.0, marker=30.0, dictionary="DICT_APRILTAG_36h11", border=2, from_bottom=True),
    Board("checkerboard", 5, 4, 20.0, inverted=True, warp=0.5),
    Board("circles", 4, 5, 25.0, asymmetric=True, bend=(0.3, -0.2)),
]


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_boards_come_back_as_they_were_written(board: Board) -> None:
    text = board_text(CalibrationObject.of_board(board, "mine"))
    found = board_from_yaml(text.encode(), WHERE)
    assert found.name == "mine"
    assert found.board is not None
    assert replace(found.board) == replace(board)
    assert np.allclose(found.points.numpy(), board.points)


def test_a_file_is_read_where_an_object_is_expected(tmp_path: Path) -> None:
    path = tmp_path / "print.yaml"
    path.write_text("format: imgcal-board/1\ntype: checkerboard\ncolumns: 6\nrows: 5\nsquare: 20\n")
    obj = load_object(path)
    assert (obj.num_fiducials, obj.name) == (20, "print")
    assert obj.modes is not None and len(obj.modes) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("type: charuco\n", "board.yaml: format: found 'None', expected 'imgcal-board/1'"),
        ("format: imgcal-board/1\ntype: chessboard\n", "board.yaml: type: found 'chessboard', expected one of charuco"),
        ("format: imgcal-board/1\ntype: circles\ncolumns: 4\nrows: 3\n", "board.yaml: .*spacing"),
        ("format: imgcal-board/1\ntype: circles\ncolumns: 4\nrows: -3\nspacing: 5\n", "board.yaml: .*rows"),
        ("format: imgcal-board/1\ntype: checkerboard\ncolumns: 2\nrows: 9\nsquare: 5\n", "board.yaml: .*2 columns"),
    ],
)
def test_what_is_wrong_is_one_line(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as refusal:
        board_from_yaml(text.encode(), WHERE)
    assert "\n" not in str(refusal.value)

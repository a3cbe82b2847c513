"""Turns and bends of printed boards."""

import numpy as np
import pytest

from imgcal.types import Board


@pytest.mark.parametrize(
    ("board", "count"),
    [
        (Board("checkerboard", 8, 7, 30.0), 1),
        (Board("checkerboard", 5, 7, 30.0), 2),
        (Board("checkerboard", 6, 6, 30.0), 2),
        (Board("checkerboard", 7, 7, 30.0), 4),
        (Board("circles", 4, 11, 20.0, asymmetric=True), 1),
        (Board("circles", 4, 10, 20.0, asymmetric=True), 2),
        (Board("circles", 5, 5, 20.0), 4),
        (Board("charuco", 5, 5, 20.0, 15.0, "DICT_4X4_50"), 1),
    ],
)
def test_turns_bring_the_points_onto_each_other(board, count):
    centred = board.points - board.points.mean(0)
    assert len(board.turns) == count
    for angle, motion in board.turns:
        cosine, sine = np.cos(angle), np.sin(angle)
        turned = centred @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        assert np.allclose(turned, centred[motion], atol=1e-9)


def test_the_middle_of_a_bent_board_is_off_by_its_deflections():
    board = Board("circles", 5, 3, 10.0, bend=(1.0, -0.4))
    z = board.points[:, 2].reshape(3, 5)
    assert z[1, 2] == pytest.approx(0.6)
    assert z[0, 2] == pytest.approx(1.0) and z[1, 0] == pytest.approx(-0.4)
    assert np.allclose(board.deflection_at(board.points[:, :2]), board.points[:, 2])

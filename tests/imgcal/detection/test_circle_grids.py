"""Circles of grids, seen obliquely and in any order, get the numbers of the layout; other grids are named."""

import numpy as np
import pytest

from imgcal.detection.circle_grids import find_lattices, name_grid, number_circles
from imgcal.types import Board

LAYOUTS = [
    *((4, 11, True), (4, 10, True), (4, 8, True), (3, 6, True), (3, 4, True)),
    *((7, 6, False), (5, 5, False), (2, 5, False), (6, 4, False)),
]


def grid(columns, rows, asymmetric):
    return Board("circles", columns, rows, 1.0, asymmetric=asymmetric)


def image_of(xy, seed, tilt=1.0):
    """Project points (N, 2) of a plane that is turned about its normal and tilted: (N, 2) pixels."""
    random = np.random.default_rng(seed)
    turn, about = random.uniform(0, 2 * np.pi, 2)
    normal = np.array([np.cos(about), np.sin(about)])
    rotated = (xy - xy.mean(0)) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    along = rotated @ normal
    squeezed = rotated - (1 - np.cos(tilt)) * along[:, None] * normal
    return 400 + 1000 * squeezed / (4 * np.ptp(xy) + np.sin(tilt) * along[:, None])


def numbered(board, uv, radius=None):
    found = find_lattices(uv, np.full(len(uv), 4.0) if radius is None else radius)
    return [rows for lattice in found if (rows := number_circles(lattice, board, uv)) is not None]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.0])
def test_circles_are_numbered_by_the_layout(layout, tilt):
    board = grid(*layout)
    for seed in range(12):
        random = np.random.default_rng(seed)
        uv = image_of(board.points[:, :2], seed, tilt)
        shuffled = random.permutation(len(uv))
        beyond = uv[[0, -1]] + (uv[[0, -1]] - uv[[1, -2]]) if min(layout[:2]) > 4 else uv[:0]  # where circles might be
        count = 20 if len(uv) > 6 else 0  # a few of many specks form the smallest grids by chance
        specks = uv.min(0) + random.uniform(-0.3, 1.3, (count, 2)) * np.ptp(uv, axis=0)
        clutter, radius = np.concatenate((beyond, specks)), np.repeat([4.0, 1.0], [len(uv) + len(beyond), count])
        seen = np.concatenate((uv[shuffled] + 0.05 * random.standard_normal(uv.shape), clutter))
        (rows,) = numbered(board, seen, radius)
        assert any((shuffled[rows] == turn).all() for _, turn in board.turns)
        step = seen[rows[board.columns - 1]] - seen[rows[0]]
        turned = [seen[rows[turn[board.columns - 1]]] - seen[rows[turn[0]]] for _, turn in board.turns]
        assert all(step[0] / np.hypot(*step) >= other[0] / np.hypot(*other) - 1e-9 for other in turned)


@pytest.mark.parametrize(
    ("printed", "expected"),
    [
        ((7, 6, False), (5, 6, False)),
        ((7, 6, False), (6, 6, False)),
        ((4, 11, True), (4, 9, True)),
        ((4, 11, True), (3, 11, True)),
        ((4, 11, True), (4, 11, False)),
        ((6, 4, False), (4, 5, False)),
    ],
)
def test_a_grid_of_another_size_is_not_numbered_but_named(printed, expected):
    printed, expected = grid(*printed), grid(*expected)
    uv = image_of(printed.points[:, :2], 3, 0.5)
    (lattice,) = find_lattices(uv, np.full(len(uv), 4.0))
    assert number_circles(lattice, expected, uv) is None
    names = {str(printed), str(grid(printed.rows, printed.columns, printed.asymmetric))}
    assert name_grid(lattice, expected, uv) in names


def test_a_hidden_circle_leaves_no_grid():
    board = grid(4, 11, True)
    uv = image_of(board.points[:, :2], 1, 0.5)
    assert len(numbered(board, uv)) == 1
    for hidden in range(len(uv)):
        assert not numbered(board, np.delete(uv, hidden, axis=0))


def test_two_grids_are_both_found_beside_a_third_of_other_circles():
    board = grid(5, 4, False)
    uv = image_of(board.points[:, :2], 1, 0.3)
    both = np.concatenate((uv, uv + np.array([2.4 * np.ptp(uv[:, 0]), 7])))
    assert [sorted(rows) for rows in numbered(board, both)] == [list(range(20)), list(range(20, 40))]
    between = uv + (uv[6] - uv[0]) / 2
    all_of_them, radius = np.concatenate((both, between)), np.repeat([4.0, 1.0], [40, 20])
    assert [len(found.rows) for found in find_lattices(all_of_them, radius)] == [20, 20, 20]


def test_few_blobs_form_no_lattice():
    assert find_lattices(np.zeros((0, 2)), np.zeros(0)) == []
    assert find_lattices(np.array([[0.0, 0.0], [1, 0], [2, 0], [3, 0]]), np.ones(4)) == []

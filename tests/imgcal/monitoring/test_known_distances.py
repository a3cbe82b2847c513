"""What is known of a shape: as many numbers as its points have, but for those of a pose."""

import numpy as np
import pytest

from imgcal.monitoring.known_distances import known_distances, shape_rows

RANDOM = np.random.default_rng(3)
SHAPES = {
    "pair": (np.array([[0.0, 0, 0], [30, 40, 0]]), 5),
    "line": (RANDOM.normal(size=(4, 1)) * np.array([[30.0, 40.0, 5.0]]), 5),
    "plane": (RANDOM.normal(size=(5, 2)) @ RANDOM.normal(size=(2, 3)) * 100, 6),
    "body": (RANDOM.normal(size=(7, 3)) * 100, 6),
}


def derivative(points: np.ndarray) -> np.ndarray:
    """What small steps (3 n,) of the points change in the rows' sums or lengths."""
    rows = []
    for row in shape_rows(points, 1.0):
        which, by, length = row.column, row.coefficient, row.length
        total = by @ points[which]
        assert np.linalg.norm(total) == pytest.approx(length, abs=1e-9)
        full = np.zeros((3, len(points), 3))
        full[:, which] = np.eye(3)[:, None] * by[:, None]
        by_step = full.reshape(3, -1)
        rows.append(total[None] / length @ by_step if length else by_step)
    return np.concatenate(rows)


@pytest.mark.parametrize("name", SHAPES)
def test_rows_leave_only_the_motions_of_a_rigid_body(name: str) -> None:
    points, rank = SHAPES[name]
    rows = derivative(points)
    assert len(rows) == np.linalg.matrix_rank(rows) == 3 * len(points) - rank
    turn = np.stack([np.cross(axis, points).ravel() for axis in np.eye(3)])
    shift = np.tile(np.eye(3), (1, len(points)))
    np.testing.assert_allclose(rows @ np.concatenate((turn, shift)).T, 0, atol=1e-9)


@pytest.mark.parametrize("shape", ["line", "plane"])
def test_the_offset_of_a_marker_slightly_off_a_line_or_plane_is_an_error(shape: str) -> None:
    flat, rank = SHAPES[shape]
    points, away = flat.copy(), 0.2
    points[-1] += away * np.linalg.svd(flat - flat.mean(0))[2][-1]
    exact, near = shape_rows(flat, 1e-3), shape_rows(points, 1e-3)
    assert sum(row.numbers for row in exact) == sum(row.numbers for row in near) == 3 * len(points) - rank
    total, numbers = 0.0, 0
    for row in near:
        size = float(np.linalg.norm(row.coefficient @ points[row.column]))
        if row.length:
            assert size == pytest.approx(row.length)
        elif size > 1e-6:
            total, numbers = total + size**2, numbers + row.numbers
    assert total == pytest.approx(numbers)  # as much as an error of one standard deviation in each direction
    assert numbers > 0


def test_rows_name_the_columns_of_lights_in_view() -> None:
    stick, body = SHAPES["pair"][0], SHAPES["body"][0]
    number = np.array([[1, 3, 0, 7, 12], [0, 2, 3, 4, 5]])
    used = np.array([[True] * 5, [False, True, True, True, False]])
    found = known_distances([(0, stick), (2, body)], number, used)
    assert found.length.shape == (2, 3)
    first = set(found.column[0, found.length[0] > 0].ravel().tolist())
    assert first == {0, 1, 2, 3}  # the stick in columns 0 and 2, two of the body in 1 and 3; 12 is another light
    assert (found.length[0] > 0).sum() == 2
    assert found.numbers == 2 + 3  # and three of the body in the second snapshot
    shared = (found.coefficient != 0).sum(-1)
    assert shared.tolist() == [[2, 2, 0], [2, 2, 2]]


def test_unknown_lights_have_no_known_distance() -> None:
    assert known_distances([], np.arange(4)[None], np.ones((1, 4), dtype=bool)).length.shape == (1, 0)

"""Compiled loops against the obvious way in tensors."""

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import error_between
from imgcal.monitoring import camera_change_errors
from imgcal.monitoring.recent_screening import add_error, add_row, put, screen
from imgcal.monitoring.rig_arrays import RigArrays

SNAPSHOTS, CAMERAS, OWN = 5, 3, 2


def test_the_error_between_rigs_is_that_of_tensors() -> None:
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(1)
    scale = torch.tensor([0.02] * 3 + [5.0] * 3 + [9.0] * 4 + [0.01] * 5, dtype=torch.float64)
    for size in (1.0, 1e-6, 0.0):
        other = rig.retract(size * scale * torch.randn(4, 15, generator=generator, dtype=torch.float64))
        error = np.ones((4, 15))
        parts = [RigArrays.of(one).parts for one in (other, rig)]
        add_error(*parts, scale.expand(4, -1).contiguous().numpy(), error)
        expected = (error_between(other, rig) / scale).numpy()
        np.testing.assert_allclose(error - 1, expected, rtol=1e-7, atol=1e-9 * max(size, 1e-3))


@pytest.fixture(params=[6, 12])
def ring(request) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...], np.ndarray]:
    """A ring of three snapshots, into which five have been put; totals; and each snapshot's information (5, D, D).

    Each takes as many numbers of poses out as it has: of twelve, some have fewer.
    """
    generator = np.random.default_rng(3)
    wide = 15 * CAMERAS
    size = wide + OWN
    rows = (np.zeros((3, request.param, size)), np.zeros((3, OWN, size)), np.zeros((3, size)))
    totals = (np.zeros((4, CAMERAS, 15, 15)), np.zeros((4, CAMERAS, 15, 15)))
    full = np.zeros((SNAPSHOTS, size, size))
    for number in range(SNAPSHOTS):
        root, carried = (
            generator.normal(size=(CAMERAS, 15, 40)),
            generator.normal(size=(6 + number % (request.param - 5), size)),
        )
        camera, border = root @ root.swapaxes(-1, -2), generator.normal(size=(OWN, size))
        border[:, wide:] += border[:, wide:].T.copy()
        full[number] = -carried.T @ carried
        for c in range(CAMERAS):
            full[number, 15 * c : 15 * c + 15, 15 * c : 15 * c + 15] += camera[c]
        full[number, wide:] += border
        full[number, :wide, wide:] += border[:, :wide].T
        pull, at = generator.normal(size=size) * 9, generator.normal(size=size)
        put(rows, totals, number, (camera, carried, border, pull), at)
        np.testing.assert_allclose(rows[2][number % 3], pull + full[number] @ at, rtol=1e-9, atol=1e-9)
    return rows, totals, full


def test_quick_scores_are_squares_in_units_of_the_information(ring) -> None:
    rows, totals, full = ring
    rig = imgcal.load_rig("T4").select([0, 1, 2])
    change = camera_change_errors(rig, torch.ones(3, 15, dtype=torch.float64)).numpy()
    parts, ages, at = np.array([(0, 3), (8, 10)]), np.array((2, 3, 9)), np.random.default_rng(4).normal(size=47)
    scores = np.empty((3, CAMERAS))
    screen(rows, totals, SNAPSHOTS, 3, at, change, parts, ages, scores)
    for row, age in enumerate((2, 3)):
        latest = range(SNAPSHOTS - age, SNAPSHOTS)
        for c in range(CAMERAS):
            mine = slice(15 * c, 15 * c + 15)
            pull = sum(rows[2][s % 3] - full[s] @ at for s in latest)[mine]
            block = sum(full[s] for s in latest)[mine, mine]
            expected = 0.0
            for first, last in parts:
                turn = change[c][:, first:last]
                value = turn.T @ pull
                expected = max(expected, value @ np.linalg.solve(turn.T @ block @ turn, value))
            np.testing.assert_allclose(scores[row, c], expected, rtol=3e-3)
    assert not scores[2].any()


def test_a_row_is_added_to_sums(ring) -> None:
    rows, totals, full = ring
    information, weighted = np.ones((47, 47)), np.ones(47)
    add_row(rows, totals, 4, information, weighted)
    np.testing.assert_allclose(information - 1, full[4], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(weighted - 1, rows[2][1], rtol=1e-9, atol=1e-9)

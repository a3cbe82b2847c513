"""Compiled loops against the obvious way in tensors."""

import numpy as np
import torch

import imgcal
from imgcal.estimation import change_of_errors, error_between
from imgcal.estimation.recent_screening import add_error, screen


def test_the_error_between_rigs_is_that_of_tensors() -> None:
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(1)
    scale = torch.tensor([0.02] * 3 + [5.0] * 3 + [9.0] * 4 + [0.01] * 5, dtype=torch.float64)
    for size in (1.0, 1e-6, 0.0):
        other = rig.retract(size * scale * torch.randn(4, 15, generator=generator, dtype=torch.float64))
        arrays = []
        for one in (other, rig):
            lens = torch.cat((one.focal_length, one.principal_point, one.distortion), -1)
            arrays += [
                one.cam_from_rig.rotation.numpy(),
                one.cam_from_rig.translation.contiguous().numpy(),
                lens.numpy(),
            ]
        error = np.ones((4, 15))
        add_error(*arrays, scale.expand(4, -1).contiguous().numpy(), error)
        expected = (error_between(other, rig) / scale).numpy()
        np.testing.assert_allclose(error - 1, expected, rtol=1e-7, atol=1e-9 * max(size, 1e-3))


def test_quick_scores_are_squares_in_units_of_the_information() -> None:
    snapshots, cameras, own, generator = 5, 3, 2, np.random.default_rng(3)
    wide = 15 * cameras
    size = wide + own
    root = generator.normal(size=(snapshots, cameras, 15, 40))
    camera = root @ root.swapaxes(-1, -2)
    carried, border = generator.normal(size=(snapshots, 6, size)), generator.normal(size=(snapshots, own, size))
    weighted, at = generator.normal(size=(snapshots, size)) * 9, generator.normal(size=size)
    taken = carried[:, :, :wide].reshape(snapshots, 6, cameras, 15)
    reduced = camera - np.einsum("sqci,sqcj->scij", taken, taken)
    rig = imgcal.load_rig("T4").select([0, 1, 2])
    change = change_of_errors(rig, torch.ones(3, 15, dtype=torch.float64)).numpy()
    parts, ages = np.array([(0, 3), (8, 10)]), np.array((2, 3, 9))
    order, scores = np.array([4, 1, 2]), np.empty((3, cameras))
    screen(camera, reduced, carried, border, weighted, order, at, change, parts, ages, scores)
    for row, rows in enumerate((order[:2], order[:3])):
        for c in range(cameras):
            mine = slice(15 * c, 15 * c + 15)
            pull, block = np.zeros(15), np.zeros((15, 15))
            for s in rows:
                full = -carried[s].T @ carried[s]
                full[mine, mine] += camera[s, c]
                full[:wide, wide:] += border[s][:, :wide].T
                pull += weighted[s, mine] - full[mine] @ at
                block += reduced[s, c]
            expected = 0.0
            for first, last in parts:
                turn = change[c][:, first:last]
                value = turn.T @ pull
                expected = max(expected, value @ np.linalg.solve(turn.T @ block @ turn, value))
            np.testing.assert_allclose(scores[row, c], expected, rtol=3e-3)
    assert not scores[2].any()

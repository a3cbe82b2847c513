"""Errors of a rig in compiled loops, against the same in tensors."""

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import displace, error_between, step_by_error
from imgcal.monitoring.rig_arrays import RigArrays
from imgcal.monitoring.rig_error_cpu import times_basis, write_basis, write_error
from imgcal.types import CameraRig

UNITS = torch.tensor((0.02,) * 3 + (10.0,) * 3 + (20.0,) * 4 + (0.02,) * 5, dtype=torch.float64).expand(4, 15)


def drifted(size: float) -> CameraRig:
    error = UNITS * torch.randn(4, 15, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return displace(imgcal.load_rig("T4"), size * error)


@pytest.mark.parametrize("size", [0.0, 1.0, 80.0])  # the last: turns by more than a right angle
def test_the_error_is_that_of_tensors(size: float) -> None:
    rig, other, unit = drifted(size), imgcal.load_rig("T4"), UNITS.contiguous().numpy()
    found = np.empty(60)
    write_error(*RigArrays.of(rig).parts, RigArrays.of(other).parts, unit, found)
    np.testing.assert_allclose(found.reshape(4, 15), (error_between(rig, other) / UNITS).numpy(), rtol=1e-9, atol=1e-9)


def test_rows_are_multiplied_by_the_steps_by_errors() -> None:
    rig = drifted(1.0)
    arrays, rows = RigArrays.of(rig), np.random.default_rng(1).standard_normal((4, 15))
    steps = step_by_error(rig) * UNITS[:, None, :] / UNITS[:, :, None]
    expected = np.einsum("ci,cij->cj", rows, steps.numpy())
    for camera in range(4):
        basis = np.empty((6, 3))
        write_basis(arrays.rotation[camera], arrays.position[camera], UNITS[camera].contiguous().numpy(), basis)
        times_basis(rows[camera], basis)
    np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-9)

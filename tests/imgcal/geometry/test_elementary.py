"""Elementary functions of tensors and of compiled numbers."""

import math

import pytest
import torch

from imgcal.geometry.elementary import arctan, minimum, sqrt, tan
from renderers.compiling import njit


@njit(cache=False)
def _compiled(x: float) -> tuple[float, float, float, float]:
    return sqrt(x), arctan(x), tan(x), minimum(x, 0.5)  # type: ignore[arg-type, return-value]


@pytest.mark.parametrize("x", [0.0, 0.3, 1.2])
def test_both_worlds_agree(x: float) -> None:
    expected = (math.sqrt(x), math.atan(x), math.tan(x), min(x, 0.5))
    assert _compiled(x) == pytest.approx(expected, rel=1e-15)
    value = torch.tensor(x, dtype=torch.float64)
    assert [float(f(value)) for f in (sqrt, arctan, tan)] == pytest.approx(expected[:3], rel=1e-15)
    assert float(minimum(value, 0.5)) == expected[3]

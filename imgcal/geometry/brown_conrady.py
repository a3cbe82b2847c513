"""Brown-Conrady, the lens model of most cameras: a radial polynomial of three coefficients, and decentering.

Source: Brown 1966, "Decentering Distortion of Lenses"; coefficients and their order as in OpenCV.
"""

# The same functions work on tensors and, once compiled, on scalars.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from imgcal.geometry.kornia_distortion import opencv_distortion
from imgcal.geometry.lens_model import LensModel


def radial(one, s, k):
    """Distorted radius divided by the radius."""
    return one + s * (k[0] + s * (k[1] + s * k[4]))


def growth(one, s, k):
    """Twice the derivative of `radial` with respect to the squared radius."""
    two = one + one
    return two * (k[0] + s * (two * k[1] + (two + one) * s * k[4]))


def by_coefficients(one, s, k):
    """Derivatives of `radial` with respect to k1, k2, p1, p2, k3."""
    return s, s * s, s, s, s * s * s


def is_before_fold(rr: Tensor, k: tuple[Tensor, ...]) -> Tensor:
    """Tell where 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3, the derivative of the distorted radius, is positive for all s <= rr.

    The smallest value of a cubic on an interval is at an endpoint or at its only local minimum.
    """
    a, b, c = 3 * k[0], 5 * k[1], 7 * k[4]

    def slope(s: Tensor) -> Tensor:
        return 1 + s * (a + s * (b + s * c))

    # The local minimum, (root - b) / (3 c), in forms that stay accurate as c goes to zero; nan or infinite without one.
    root = (b * b - 3 * a * c).sqrt()
    lowest = torch.where(b > 0, -a / (b + root), (root - b) / (3 * c))
    # Beyond the radius where the slope falls below zero a camera is blind, even if the slope recovers farther out.
    blind = torch.where((lowest > 0) & (slope(lowest) <= 0), lowest, torch.inf)
    return torch.minimum(slope(rr), blind - rr) > 0


def blind_from(k):
    """Squared radius of a local minimum of the slope that is not positive; infinite if none. See `is_before_fold`."""
    a, b, c = 3 * k[0], 5 * k[1], 7 * k[4]
    root = np.sqrt(b * b - 3 * a * c)
    lowest = -a / (b + root) if b > 0 else (root - b) / (3 * c)
    if lowest > 0 and 1 + lowest * (a + lowest * (b + lowest * c)) <= 0:
        return lowest
    return np.inf


BROWN_CONRADY = LensModel(
    name="brown_conrady",
    coefficients=("k1", "k2", "p1", "p2", "k3"),
    radial=radial,
    growth=growth,
    by_coefficients=by_coefficients,
    kornia=opencv_distortion,
    is_before_fold=is_before_fold,
    blind_from=blind_from,
)

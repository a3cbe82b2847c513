"""The rational lens model, for wide angles short of a fisheye: a quotient of two radial polynomials, and decentering.

Source: Claus and Fitzgibbon 2005, "A Rational Function Lens Distortion Model for General Cameras"; coefficients and
their order as in OpenCV's CALIB_RATIONAL_MODEL.
"""

# The same functions work on tensors and, once compiled, on scalars.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs

from __future__ import annotations

from imgcal.geometry.kornia_distortion import opencv_distortion
from imgcal.geometry.lens_model import LensModel


def radial(one, s, k):
    """Distorted radius divided by the radius."""
    return (one + s * (k[0] + s * (k[1] + s * k[4]))) / (one + s * (k[5] + s * (k[6] + s * k[7])))


def growth(one, s, k):
    """Twice the derivative of `radial` with respect to the squared radius."""
    two = one + one
    three = two + one
    above, below = one + s * (k[0] + s * (k[1] + s * k[4])), one + s * (k[5] + s * (k[6] + s * k[7]))
    rise = k[0] + s * (two * k[1] + three * s * k[4])
    fall = k[5] + s * (two * k[6] + three * s * k[7])
    return two * (rise * below - above * fall) / (below * below)


def by_coefficients(one, s, k):
    """Derivatives of `radial` with respect to k1, k2, p1, p2, k3, k4, k5, k6."""
    above, below = one + s * (k[0] + s * (k[1] + s * k[4])), one + s * (k[5] + s * (k[6] + s * k[7]))
    up = s / below
    down = -up * above / below
    return up, up * s, up, up, up * s * s, down, down * s, down * s * s


RATIONAL = LensModel(
    name="rational",
    coefficients=("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    radial=radial,
    growth=growth,
    by_coefficients=by_coefficients,
    kornia=opencv_distortion,
)

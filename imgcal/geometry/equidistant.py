"""The fisheye lens: a point at angle t from the optical axis has the image radius t (1 + k1 t^2 + ... + k4 t^8).

A camera sees points of the z = 1 plane only: angles below 90 degrees.

Source: Kannala and Brandt 2006, "A Generic Camera Model and Calibration Method for Conventional, Wide-Angle, and
Fish-Eye Lenses"; coefficients and their order as in OpenCV's `fisheye`.
"""

# The same functions work on tensors and, once compiled, on scalars.
# ruff: noqa: ANN001, ANN201
# mypy: allow-untyped-defs

from __future__ import annotations

from imgcal.geometry.elementary import arctan, minimum, sqrt, tan
from imgcal.geometry.kornia_distortion import kannala_brandt_distortion
from imgcal.geometry.lens_model import LensModel

TINY = 1e-30  # added to squared radii, so that the axis is not a special case
WIDEST = 1.57  # rad, largest angle of the inverse


def radial(one, s, k):
    """Distorted radius divided by the radius."""
    r = sqrt(s + one * TINY)
    t = arctan(r)
    u = t * t
    return t / r * (one + u * (k[0] + u * (k[1] + u * (k[2] + u * k[3]))))


def growth(one, s, k):
    """Twice the derivative of `radial` with respect to the squared radius."""
    two = one + one
    three, four = two + one, two + two
    s = s + one * TINY
    r = sqrt(s)
    t = arctan(r)
    u = t * t
    factor = one + u * (k[0] + u * (k[1] + u * (k[2] + u * k[3])))
    rise = u * (k[0] + u * (two * k[1] + u * (three * k[2] + u * four * k[3])))
    # With q = t / r, 2 dq/ds = (1 / (1 + s) - q) / s; d factor / dt = 2 rise / t.
    inner = one / (one + s)
    return ((inner - t / r) * factor + two * inner * rise) / s


def by_coefficients(one, s, k):
    """Derivatives of `radial` with respect to k1, k2, k3, k4."""
    r = sqrt(s + one * TINY)
    t = arctan(r)
    u = t * t
    first = t / r * u
    return first, first * u, first * u * u, first * u * u * u


def inverse(one, s, k):
    """Radius divided by the distorted radius, by Newton's method for the angle."""
    two = one + one
    three = two + one
    five, seven, nine = three + two, three + two + two, three * three
    wanted = sqrt(s + one * TINY)
    t = minimum(wanted, WIDEST)
    for _ in range(12):
        u = t * t
        value = t * (one + u * (k[0] + u * (k[1] + u * (k[2] + u * k[3]))))
        slope = one + u * (three * k[0] + u * (five * k[1] + u * (seven * k[2] + u * nine * k[3])))
        t = minimum(t - (value - wanted) / slope, WIDEST)
    return tan(t) / wanted


EQUIDISTANT = LensModel(
    name="equidistant",
    coefficients=("k1", "k2", "k3", "k4"),
    radial=radial,
    growth=growth,
    by_coefficients=by_coefficients,
    kornia=kannala_brandt_distortion,
    inverse=inverse,
)

"""Lens distortion and its derivatives for compiled loops; `lenses.py` does the same for tensors, model by model.

A camera's model is given by its index in `LENS_MODELS`: see `lens_codes`. The functions that select by this index are
built from the models' formulas. If all lenses are of the default model, None replaces the indices. Numba treats None as
another type, so the code compiled for it handles only the default lens and loses no time on the choice.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN002, ANN201, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numba.np.unsafe.ndarray import to_fixed_tuple

from imgcal.geometry.kernels import FAST
from imgcal.geometry.lens_model import Formula, LensModel
from imgcal.geometry.lenses import DEFAULT, FOLD_RADII, FOLD_SHARES, LENS_MODELS
from renderers.compiling import njit

LEAST_RADIAL = 0.2  # lower bound in `undistort`: beyond the fold of the image there is no solution
FOLD_SQUARES, FOLD_PARTS = FOLD_RADII.square().numpy(), FOLD_SHARES.numpy()


def as_tuple(k, size):
    """The first coefficients as a tuple, of which compiled code makes variables; `size` is a constant."""
    return tuple(k[:size])


@overload(as_tuple, prefer_literal=True)
def _as_tuple(k, size):
    return lambda k, size: to_fixed_tuple(k, size)


class CompiledLens(NamedTuple):
    """The compiled functions of one model; `one` and the coefficients k are as in `LensModel`."""

    name: str
    distort: Formula  # (one, x, y, k) -> distorted x, y; Jacobian xx, xy, yy; x^2 + y^2; slope of the distorted radius
    by_coefficients: Formula  # (x, y, x^2 + y^2, k, fx, fy, at, rows (2, R)): puts fx, fy times derivatives into rows
    undistort: Formula  # (distorted x, y, k) -> x, y to far less than a pixel
    start: Formula  # like `undistort`, but only an initial guess for an exact iteration
    blind_from: Formula  # (k) -> squared radius beyond which every point is past the fold, whatever its slope


def compile_as(name: str, **options: Any) -> Callable[[Formula], Formula]:
    """Apply `njit` to one of several functions of the same name in the source, without a cache of its own.

    Cached code refers to the functions it calls by name and a counter. Functions of the same name that were compiled
    in different processes would be confused.
    """

    def decorate(function: Formula) -> Formula:
        function.__qualname__ += f".{name}"
        return njit(cache=False, **options)(function)

    return decorate


def _inline(function: Formula) -> Formula:
    return njit(cache=False, fastmath=FAST, inline="always", error_model="numpy")(function)


def _compile(model: LensModel) -> CompiledLens:
    radial, growth, radial_by_coefficients = map(_inline, (model.radial, model.growth, model.by_coefficients))
    size, (first, second) = len(model.coefficients), model.decentering or (0, 0)
    decentred = model.decentering is not None

    @_inline
    def distort(one, x, y, k):
        two = one + one
        xx, yy, xy2 = x * x, y * y, two * x * y
        rr = xx + yy
        factor, grown = radial(one, rr, k), growth(one, rr, k)
        xd, yd = x * factor, y * factor
        jxx, jxy, jyy = factor + grown * xx, grown * (x * y), factor + grown * yy
        if decentred:
            p1, p2, six = k[first], k[second], two * (two + one)
            xd, yd = xd + p1 * xy2 + p2 * (rr + two * xx), yd + p1 * (rr + two * yy) + p2 * xy2
            jxx, jyy = jxx + two * p1 * y + six * p2 * x, jyy + six * p1 * y + two * p2 * x
            jxy = jxy + two * (p1 * x + p2 * y)
        return xd, yd, jxx, jxy, jyy, rr, factor + rr * grown

    @_inline
    def by_coefficients(x, y, rr, k, along, down, at, rows):
        slopes = radial_by_coefficients(1.0, rr, k)
        for i in range(size):
            rows[0, at + i], rows[1, at + i] = along * x * slopes[i], down * y * slopes[i]
        if decentred:
            rows[0, at + first], rows[1, at + first] = along * 2 * x * y, down * (rr + 2 * y * y)
            rows[0, at + second], rows[1, at + second] = along * (rr + 2 * x * x), down * 2 * x * y

    if model.inverse is not None:
        inverse = _inline(model.inverse)

        @_inline
        def undistort(xd, yd, k):
            factor = inverse(1.0, xd * xd + yd * yd, k)
            return xd * factor, yd * factor

        start = undistort
    else:

        @_inline
        def undistort(xd, yd, k):
            x, y = xd, yd
            for _ in range(10):
                rr = x * x + y * y
                factor = max(radial(1.0, rr, k), LEAST_RADIAL)
                along, down = 0.0, 0.0
                if decentred:
                    p1, p2 = k[first], k[second]
                    along, down = 2 * p1 * x * y + p2 * (rr + 2 * x * x), p1 * (rr + 2 * y * y) + 2 * p2 * x * y
                x, y = (xd - along) / factor, (yd - down) / factor
            return x, y

        @_inline
        def start(xd, yd, k):
            return xd, yd

    @compile_as(model.name, error_model="numpy")
    def sampled(k):
        """Squared radius where the slope, or the factor before a pole, falls to zero."""
        low, high, found = 0.0, np.inf, False
        for high in FOLD_SQUARES:
            factor = radial(1.0, high, k)
            if min(factor, factor + high * growth(1.0, high, k)) <= 0:
                found = True
                break
            low = high
        if not found:
            return np.inf
        least, wide = low, high - low
        for share in FOLD_PARTS:
            at = least + wide * share
            factor = radial(1.0, at, k)
            if min(factor, factor + at * growth(1.0, at, k)) <= 0:
                break
            low = at
        return low

    blind_from = sampled if model.blind_from is None else _inline(model.blind_from)
    return CompiledLens(model.name, distort, by_coefficients, undistort, start, blind_from)


COMPILED_LENSES = tuple(_compile(model) for model in LENS_MODELS.values())
USUAL = list(LENS_MODELS).index(DEFAULT)
USUAL_WIDTH = len(LENS_MODELS[DEFAULT].coefficients)


def compile_each_lens(make: Formula) -> tuple[Formula, ...]:
    """Compile a function for each model; `make` takes a `CompiledLens` and the number of its coefficients."""
    sizes = (len(model.coefficients) for model in LENS_MODELS.values())
    return tuple(make(lens, size) for lens, size in zip(COMPILED_LENSES, sizes, strict=True))


def _chosen(kind: str, functions: tuple[Formula, ...], number: int = 0) -> Formula:
    """Combine the models' functions into one, whose first argument is the index of the model to use."""
    here = functions[number]
    if number == len(functions) - 1:

        @compile_as(f"{kind}{number}", fastmath=FAST, error_model="numpy")
        def choose(model, *arguments):
            return here(*arguments)

    else:
        others = _chosen(kind, functions, number + 1)

        @compile_as(f"{kind}{number}", fastmath=FAST, error_model="numpy")
        def choose(model, *arguments):
            if model == number:
                return here(*arguments)
            return others(model, *arguments)

    return choose


def chain_models(kind: str, functions: tuple[Formula, ...], number: int = 0) -> Formula:
    """Combine the models' functions into one that calls them in turn, each with its model's index as first argument.

    Each function handles the cameras of its own model. If the models are None, the default one handles all cameras.
    """
    here = functions[number]
    if number == len(functions) - 1:

        @compile_as(f"{kind}{number}")
        def last(models, *arguments):
            if models is not None:
                here(number, models, *arguments)

        return last
    others, usual = chain_models(kind, functions, number + 1), functions[USUAL]

    @compile_as(f"{kind}{number}")
    def call(models, *arguments):
        if models is None:
            usual(number, models, *arguments)
        else:
            here(number, models, *arguments)
            others(models, *arguments)

    return call


def _image(lens: CompiledLens, size: int) -> Formula:
    distort = lens.distort

    @compile_as(lens.name, fastmath=FAST)
    def image(px, py, depth, radius_squared, k):
        squared = depth * depth
        inverse = 1 / (depth * (squared - radius_squared))
        per_depth, log_slope = squared * inverse, -(squared + radius_squared) * inverse
        x, y = px * per_depth, py * per_depth
        xd, yd, jxx, jxy, jyy, rr, _ = distort(1.0, x, y, as_tuple(k, size))
        return per_depth, log_slope, x, y, rr, xd, yd, jxx, jxy, jyy

    return image


def _coefficients(lens: CompiledLens, size: int) -> Formula:
    by_coefficients = lens.by_coefficients

    @compile_as(lens.name, fastmath=FAST)
    def fill(x, y, rr, k, along, down, at, rows):
        by_coefficients(x, y, rr, as_tuple(k, size), along, down, at, rows)
        for i in range(at + size, at + len(k)):
            rows[0, i], rows[1, i] = 0.0, 0.0

    return fill


def _inverse(lens: CompiledLens, size: int) -> Formula:
    inverse = lens.undistort

    @compile_as(lens.name)
    def undo(xd, yd, k):
        return inverse(xd, yd, as_tuple(k, size))

    return undo


_IMAGES, _COEFFICIENTS, _INVERSES = (compile_each_lens(make) for make in (_image, _coefficients, _inverse))
_any_image, _any_coefficients = _chosen("image", _IMAGES), _chosen("coefficients", _COEFFICIENTS)
_any_inverse = _chosen("inverse", _INVERSES)
_usual_image, _usual_coefficients, _usual_inverse = _IMAGES[USUAL], _COEFFICIENTS[USUAL], _INVERSES[USUAL]


def image_of(models, camera, px, py, depth, radius_squared, k):
    """Image of a point (mm, camera frame) or of a sphere around it, and its derivatives, like `linearization._lens`.

    `models` comes from `lens_codes`.

    Returns:
        x / px; the derivative of log x with respect to depth; x, y, x^2 + y^2, the distorted x and y, and the symmetric
        Jacobian of the distortion: xx, xy, yy.
    """
    if models is None:
        return _usual_image(px, py, depth, radius_squared, k)
    return _any_image(models[camera], px, py, depth, radius_squared, k)


@overload(image_of, jit_options={"fastmath": FAST})
def _image_of(models, camera, px, py, depth, radius_squared, k):
    if isinstance(models, types.NoneType):
        return lambda models, camera, px, py, depth, radius_squared, k: _usual_image(px, py, depth, radius_squared, k)
    return lambda models, camera, px, py, depth, radius_squared, k: _any_image(
        models[camera], px, py, depth, radius_squared, k
    )


def by_coefficients(models, camera, x, y, rr, k, along, down, at, rows):
    """Fill the columns of rows (2, R), starting at `at`, with derivatives with respect to the coefficients.

    The first row is for distorted x, times `along`; the second for distorted y, times `down`. Coefficients that the
    lens does not have get zero. Like `lenses.distort_by_coefficients`.
    """
    if models is None:
        _usual_coefficients(x, y, rr, k, along, down, at, rows)
    else:
        _any_coefficients(models[camera], x, y, rr, k, along, down, at, rows)


@overload(by_coefficients, jit_options={"fastmath": FAST})
def _by_coefficients(models, camera, x, y, rr, k, along, down, at, rows):
    if isinstance(models, types.NoneType):
        return lambda models, camera, x, y, rr, k, along, down, at, rows: _usual_coefficients(
            x, y, rr, k, along, down, at, rows
        )
    return lambda models, camera, x, y, rr, k, along, down, at, rows: _any_coefficients(
        models[camera], x, y, rr, k, along, down, at, rows
    )


def width_of(models, k):
    """Number of coefficients, D, of an array (C, D): a constant for default lenses, so that loops are unrolled."""
    return USUAL_WIDTH if models is None else k.shape[1]


@overload(width_of)
def _width_of(models, k):
    if isinstance(models, types.NoneType):
        return lambda models, k: USUAL_WIDTH
    return lambda models, k: k.shape[1]


def undistort(models, camera, xd, yd, k):
    """Undistorted x, y on the z = 1 plane, accurate to far less than a pixel; `lenses.undistort` is exact."""
    if models is None:
        return _usual_inverse(xd, yd, k)
    return _any_inverse(models[camera], xd, yd, k)


@overload(undistort)
def _undistort(models, camera, xd, yd, k):
    if isinstance(models, types.NoneType):
        return lambda models, camera, xd, yd, k: _usual_inverse(xd, yd, k)
    return lambda models, camera, xd, yd, k: _any_inverse(models[camera], xd, yd, k)

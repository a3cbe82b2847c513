"""The available lens models, and functions based on their formulas: distortion, derivatives, fold, inverse.

Coordinates are (*B, C, N) for C cameras. Coefficients are (*B, C, D), padded with zeros for lenses with fewer than D.
Models are one name for all cameras, or a name for each. `lens_kernels.py` is the compiled version.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry.brown_conrady import BROWN_CONRADY
from imgcal.geometry.equidistant import EQUIDISTANT
from imgcal.geometry.lens_model import LensModel
from imgcal.geometry.rational import RATIONAL

LENS_MODELS = {model.name: model for model in (BROWN_CONRADY, RATIONAL, EQUIDISTANT)}
"""By their names in rig files. To add a model, write a file like `rational.py` and list it here."""

ModelNames: TypeAlias = str | tuple[str, ...]
"""One name for all cameras, or a name for each."""

DEFAULT = BROWN_CONRADY.name
FOLD_RADII = 0.003 * 1.05 ** torch.arange(214, dtype=torch.float64)
"""Radii on the z = 1 plane, 0.2 to 89.4 degrees, at which to look for the fold of a lens that has no formula for it."""

FOLD_SHARES = torch.arange(65, dtype=torch.float64) / 64
"""Fractions of the interval between two of these radii, squared, at which the search is refined."""

Components: TypeAlias = tuple[Tensor, ...]


def lens_names(models: ModelNames, cameras: int) -> tuple[str, ...]:
    """Name the lens of each camera."""
    return (models,) * cameras if isinstance(models, str) else models


def lens_label(names: Sequence[str]) -> ModelNames:
    """Reduce the names to one if all cameras have the same lens, which is fastest."""
    return names[0] if len(set(names)) == 1 else tuple(names)


def lens_width(models: ModelNames) -> int:
    """Width D of the coefficients for these models: at least five, as most rigs have."""
    names = {models} if isinstance(models, str) else set(models)
    return max(len(BROWN_CONRADY.coefficients), *(len(LENS_MODELS[name].coefficients) for name in names))


@cache
def lens_codes(models: ModelNames, cameras: int, width: int) -> NDArray[np.int64] | None:
    """Index of each camera's model in `LENS_MODELS`, for compiled functions: (C,), not to be modified.

    None if all are of the default model, and their coefficients (C, D) no wider than it needs.

    Raises:
        InputError: an unknown model, models of another number of cameras, or fewer coefficients than a model has.
    """
    names = lens_names(models, cameras)
    require_lenses("lenses", names, cameras, width)
    if {*names} <= {DEFAULT} and width == len(LENS_MODELS[DEFAULT].coefficients):
        return None
    order = list(LENS_MODELS)
    return np.array([order.index(name) for name in names], dtype=np.int64)


def require_lenses(where: str, names: Sequence[str], cameras: int, width: int) -> None:
    """Check the names of the cameras' lens models, and the width D of their coefficients.

    Args:
        where: what they belong to, for the message.
        names: of each camera's lens model.
        cameras: C.
        width: D.

    Raises:
        InputError: an unknown model, models of another number of cameras, or fewer coefficients than a model has.
    """
    unknown = [name for name in names if name not in LENS_MODELS]
    if unknown or len(names) != cameras:
        found = f"the lens model {unknown[0]}" if unknown else f"{len(names)} lens models for {cameras} cameras"
        raise InputError(f"{where}: found {found}, expected {', '.join(LENS_MODELS)} for all cameras or each")
    for name in dict.fromkeys(names):
        if width < (needed := len(LENS_MODELS[name].coefficients)):
            raise InputError(f"{where}: found distortion of width {width}, expected {needed} for {name}")


def distort(x: Tensor, y: Tensor, distortion: Tensor, models: ModelNames = DEFAULT) -> Components:
    """Distorted x and y, and the squared radius.

    Args:
        x: (*B, C, N) on the z = 1 plane.
        y: (*B, C, N).
        distortion: (*B, C, D).
        models: of the cameras.
    """
    return _by_model(_distort, models, (x, y), distortion)


def distort_with_jacobian(x: Tensor, y: Tensor, distortion: Tensor, models: ModelNames = DEFAULT) -> Components:
    """Distorted x, y, their symmetric Jacobian (xx, xy, yy), squared radius: (*B, C, N) each; see `distort`."""
    return _by_model(_distort_with_jacobian, models, (x, y), distortion)


def distort_by_coefficients(x: Tensor, y: Tensor, distortion: Tensor, models: ModelNames = DEFAULT) -> Components:
    """Derivatives of distorted x and y by the coefficients: (*B, C, N, D) each, zero where a lens has fewer."""
    width = distortion.shape[-1]
    found = _by_model(_distort_by_coefficients, models, (x, y), distortion)
    return torch.stack(found[:width], dim=-1), torch.stack(found[width:], dim=-1)


def is_before_fold(rr: Tensor, distortion: Tensor, models: ModelNames = DEFAULT) -> Tensor:
    """Tell which points lie before the radius at which the distorted radius stops growing (the image folds over).

    Args:
        rr: (*B, C, N) squared radius on the z = 1 plane.
        distortion: (*B, C, D).
        models: of the cameras.

    Returns:
        (*B, C, N) bool.
    """
    return _by_model(_is_before_fold, models, (rr.detach(),), distortion.detach())[0]


def undistort(
    xy_distorted: Tensor, distortion: Tensor, models: ModelNames = DEFAULT, iterations: int = 8
) -> tuple[Tensor, Tensor]:
    """Invert the distortion by Newton's method with a two-by-two Jacobian.

    Args:
        xy_distorted: (*B, C, N, 2) distorted coordinates on the z = 1 plane.
        distortion: (*B, C, D).
        models: of the cameras.
        iterations: Newton steps; 8 reach machine precision for the lenses of infrared rigs.

    Returns:
        (*B, C, N, 2) undistorted coordinates and (*B, C, N) bool: converged, and before the fold. Where false, the
        coordinates are the distorted ones.

    Examples:
        >>> xy, converged = undistort(torch.tensor([[[0.1, 0.2]]]), torch.tensor([[0.1, 0.0, 0.0, 0.0, 0.0]]))
        >>> xy.round(decimals=4), bool(converged.all())
        (tensor([[[0.0995, 0.1990]]]), True)
    """
    xd, yd = xy_distorted.unbind(-1)
    x, y = _by_model(_start, models, (xd, yd), distortion)
    for _ in range(iterations):
        ex, ey, jxx, jxy, jyy, _ = distort_with_jacobian(x, y, distortion, models)
        ex, ey = ex - xd, ey - yd
        determinant = jxx * jyy - jxy * jxy
        x, y = x - (jyy * ex - jxy * ey) / determinant, y - (jxx * ey - jxy * ex) / determinant
    ex, ey, rr = distort(x, y, distortion, models)
    error = torch.maximum((ex - xd).abs(), (ey - yd).abs())
    good = (error < 64 * torch.finfo(xd.dtype).eps) & is_before_fold(rr, distortion, models)
    return torch.where(good[..., None], torch.stack((x, y), dim=-1), xy_distorted), good


def distort_kornia(xy: Tensor, distortion: Tensor, models: ModelNames = DEFAULT) -> Tensor:
    """Distort points (*B, C, N, 2) like `distort`, through kornia's functions; (*B, C, D) has all batch axes."""
    x, y = xy.unbind(-1)
    return torch.stack(_by_model(_distort_kornia, models, (x, y), distortion), dim=-1)


def _by_model(
    function: Callable[[LensModel, Components, Tensor], Components],
    models: ModelNames,
    points: Components,
    distortion: Tensor,
) -> Components:
    """Call a function for the cameras of each model; all inputs and outputs but the distortion are (*B, C, N)."""
    if isinstance(models, str):
        return function(LENS_MODELS[models], points, distortion)
    order: list[int] = []
    parts = []
    for name in dict.fromkeys(models):
        chosen = [camera for camera, other in enumerate(models) if other == name]
        index = torch.tensor(chosen, device=distortion.device)
        some = tuple(part.index_select(-2, index) for part in points)
        parts.append(function(LENS_MODELS[name], some, distortion.index_select(-2, index)))
        order += chosen
    back = torch.tensor(order, device=distortion.device).argsort()
    return tuple(torch.cat(column, dim=-2).index_select(-2, back) for column in zip(*parts, strict=True))


def _own(model: LensModel, distortion: Tensor) -> Components:
    """The model's own coefficients, (*B, C, 1) each."""
    return distortion.unsqueeze(-2).unbind(-1)[: len(model.coefficients)]


def _distort(model: LensModel, points: Components, distortion: Tensor) -> Components:
    (x, y), k = points, _own(model, distortion)
    xx, yy = x * x, y * y
    rr = xx + yy
    factor = model.radial(1.0, rr, k)
    if model.decentering is None:
        return x * factor, y * factor, rr
    p1, p2 = (k[i] for i in model.decentering)
    xy2 = 2 * x * y
    return x * factor + p1 * xy2 + p2 * (rr + 2 * xx), y * factor + p1 * (rr + 2 * yy) + p2 * xy2, rr


def _distort_with_jacobian(model: LensModel, points: Components, distortion: Tensor) -> Components:
    (x, y), k = points, _own(model, distortion)
    xd, yd, rr = _distort(model, points, distortion)
    factor, growth = model.radial(1.0, rr, k), model.growth(1.0, rr, k)
    jxx, jxy, jyy = factor + growth * x * x, growth * x * y, factor + growth * y * y
    if model.decentering is not None:
        p1, p2 = (k[i] for i in model.decentering)
        jxx = jxx + 2 * p1 * y + 6 * p2 * x
        jxy = jxy + 2 * p1 * x + 2 * p2 * y
        jyy = jyy + 6 * p1 * y + 2 * p2 * x
    return xd, yd, jxx, jxy, jyy, rr


def _distort_by_coefficients(model: LensModel, points: Components, distortion: Tensor) -> Components:
    (x, y), k = points, _own(model, distortion)
    rr = x * x + y * y
    radial = model.by_coefficients(1.0, rr, k)
    by_x, by_y = [x * slope for slope in radial], [y * slope for slope in radial]
    if model.decentering is not None:
        first, second = model.decentering
        by_x[first] = by_y[second] = 2 * x * y
        by_x[second], by_y[first] = rr + 2 * x * x, rr + 2 * y * y
    none = [torch.zeros_like(by_x[0])] * (distortion.shape[-1] - len(radial))
    return (*by_x, *none, *by_y, *none)


def _is_before_fold(model: LensModel, points: Components, distortion: Tensor) -> Components:
    (rr,), k = points, _own(model, distortion)
    if model.is_before_fold is not None:
        return (model.is_before_fold(rr, k),)
    k = tuple(part.expand(*part.shape[:-1], 1) for part in k)
    low, high = _bracket(model, FOLD_RADII.to(rr).square(), k)
    low, high = _bracket(model, low + (high - low) * FOLD_SHARES.to(rr), k)
    return (rr < low,)


def _bracket(model: LensModel, s: Tensor, k: Components) -> Components:
    """Neighbours (*B, C, 1) among squared radii (*B, C, R) between which the image folds; infinite if it does not.

    It folds where the slope of the distorted radius falls to zero, or before that at a pole.
    """
    factor = model.radial(1.0, s, k)
    ends = torch.minimum(factor, factor + s * model.growth(1.0, s, k)) <= 0
    first, s = ends.to(s.dtype).argmax(-1, keepdim=True), s.expand(ends.shape)
    folds = ends.any(-1, keepdim=True)
    low, high = (torch.where(folds, s.gather(-1, i), torch.inf) for i in ((first - 1).clamp_min(0), first))
    return low, high


def _start(model: LensModel, points: Components, distortion: Tensor) -> Components:
    """Initial guess of the undistorted points."""
    x, y = points
    if model.inverse is None:
        return x, y
    factor = model.inverse(1.0, x * x + y * y, _own(model, distortion))
    return x * factor, y * factor


def _distort_kornia(model: LensModel, points: Components, distortion: Tensor) -> Components:
    xy = torch.stack(points, dim=-1)
    coefficients = distortion[..., : len(model.coefficients)]
    flat = model.kornia(xy.reshape(-1, *xy.shape[-2:]), coefficients.reshape(-1, coefficients.shape[-1]))
    return flat.reshape(xy.shape).unbind(-1)

"""A lens in another model: exactly where that can express it, else by a fit over the image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from imgcal.formats.lens import Array, Lens, distort

GRID = 33  # pixels along each side of the image, border included


@dataclass(frozen=True)
class Holds:
    """Which lenses a format can store: how many of OpenCV's coefficients, and whether a fisheye."""

    opencv: tuple[int, ...] = (5,)  # counts that a file may have, ascending
    fisheye: bool = False

    def stores_exactly(self, lens: Lens) -> bool:
        """Tell whether the lens can be stored as it is."""
        if lens.skew or lens.model == "to_ideal":
            return lens.length == 0 and not lens.skew
        return self.fisheye if lens.model == "fisheye" else lens.length <= self.opencv[-1]


@dataclass(frozen=True)
class Fit:
    """A lens of another model, and how well it replaces the first one over the image."""

    lens: Lens
    worst: float  # pixels, anywhere in the image; infinite where the other model has no answer
    rms: float  # pixels
    exact: bool


def fit_lens(lens: Lens, image_size: tuple[int, int], holds: Holds) -> Fit:
    """Express a lens in another model.

    Args:
        lens: what a file states.
        image_size: pixels: width, height, over which the two are to agree.
        holds: which lenses the other side can store.

    Returns:
        The lens itself where the model can express it, else the fit of the model that comes nearest.
    """
    if holds.stores_exactly(lens):
        return Fit(replace(lens, model="opencv") if lens.model == "to_ideal" else lens, 0.0, 0.0, True)
    uv = pixel_grid(image_size, GRID)
    rays = grid_rays(lens, image_size, GRID)
    if not np.isfinite(rays).all():
        return Fit(lens, np.inf, np.inf, False)
    tried = [_opencv(lens, uv, rays, holds.opencv[-1])] if holds.opencv else []
    if holds.fisheye:
        tried.append(_fisheye(lens, uv, rays))
    fits = [_judge(lens, candidate, image_size) for candidate in tried]
    return min(fits, key=lambda fit: fit.worst)


def pixel_grid(image_size: tuple[int, int], count: int) -> Array:
    """A grid of pixels over an image, its border included: (count^2, 2)."""
    sides = [np.linspace(-0.5, side - 0.5, count) for side in image_size]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


@lru_cache(maxsize=64)  # a rig is written, read and compared with the same lenses
def grid_rays(lens: Lens, image_size: tuple[int, int], count: int) -> Array:
    """Find the rays of `pixel_grid`: (count^2, 3) with z = 1, read-only; nan where the lens has none."""
    rays = lens.rays(pixel_grid(image_size, count))
    rays.setflags(write=False)
    return rays


def _judge(lens: Lens, candidate: Lens, image_size: tuple[int, int]) -> Fit:
    """Compare on a finer grid than the fit's, with its own points between."""
    uv = pixel_grid(image_size, 2 * GRID)
    away = np.linalg.norm(candidate.project(grid_rays(lens, image_size, 2 * GRID)) - uv, axis=-1)
    back = grid_rays(candidate, image_size, 9)  # its fold must lie outside
    if not np.isfinite(away).all() or not np.isfinite(back).all():
        return Fit(candidate, np.inf, np.inf, False)
    return Fit(candidate, float(away.max()), float(np.sqrt((away**2).mean())), False)


def fit_lens_like(
    lens: Lens, image_size: tuple[int, int], like: Lens, one_focal_length: bool = False, limit: float = np.inf
) -> Fit:
    """Express a lens in the model of another one, with as many coefficients.

    Args:
        lens: the lens to express.
        image_size: pixels: width, height, over which the two are to agree.
        like: a lens of the model.
        one_focal_length: fx and fy are one number there.
        limit: pixels; a distortion `to_ideal` keeps its centre at the principal point if that is enough.

    Returns:
        The lens itself where the model can express it, else the nearest one.
    """
    count = len(like.coefficients)
    sayable = not one_focal_length or lens.focal_length[0] == lens.focal_length[1]
    if like.model == lens.model and lens.length <= count and sayable and not lens.skew:
        return Fit(replace(lens, coefficients=tuple(lens.pad(count))), 0.0, 0.0, True)
    uv = pixel_grid(image_size, GRID)
    rays = grid_rays(lens, image_size, GRID)
    if not np.isfinite(rays).all():
        return Fit(lens, np.inf, np.inf, False)
    if like.model == "to_ideal":
        radial = min(count, 3)
        tied = _judge(lens, _to_ideal(lens, uv, rays, radial, like, False), image_size)
        if tied.worst <= limit or count < 5:
            return tied
        free = _judge(lens, _to_ideal(lens, uv, rays, radial, like, True), image_size)
        return min((tied, free), key=lambda fit: fit.worst)
    fit = _fisheye if like.model == "fisheye" else _opencv
    return _judge(lens, fit(lens, uv, rays, count, one_focal_length), image_size)


def _to_ideal(lens: Lens, uv: Array, rays: Array, count: int, like: Lens, free: bool) -> Lens:
    """Fit where a pinhole would have put each pixel: focal lengths, principal point, coefficients, and their centre."""
    x, y = rays[:, 0], rays[:, 1]
    unit = float(np.abs(uv).max())  # so that all values are of the order of one

    def predicted(values: Array) -> Array:
        fx, fy, cx, cy = values[:4]
        centre = values[4 + count :] if free else np.zeros(2)
        du, dv = uv[:, 0] - cx - centre[0], uv[:, 1] - cy - centre[1]
        square = (du**2 + (dv * fx / fy) ** 2) / unit**2
        factor = sum(values[4 + n] * square ** (n + 1) for n in range(count))
        return np.stack((2 * uv[:, 0] + du * factor - fx * x - cx, 2 * uv[:, 1] + dv * factor - fy * y - cy), axis=-1)

    start = [*lens.focal_length, *lens.principal_point]
    start += [value * unit ** (2 * n + 2) for n, value in enumerate(like.pad(count))]
    start += [0.0, 0.0] if free else []
    values = _least_squares(predicted, uv, start)
    ks = [value / unit ** (2 * n + 2) for n, value in enumerate(values[4 : 4 + count])]
    return Lens((values[0], values[1]), (values[2], values[3]), (*ks, *values[4 + count :]), "to_ideal")


def _repeat_focal_length(values: Array, one: bool) -> Array:
    """Fx, fy, cx, cy and so on, of values in which fy may be left out."""
    return np.concatenate((values[:1], values)) if one else values


def _opencv(lens: Lens, uv: Array, rays: Array, count: int, one_focal_length: bool = False) -> Lens:
    """Fit focal lengths, principal point and `count` coefficients."""
    count = min(count, 8)  # thin prisms and tilts are small, and hard to tell from the rest
    start = lens.pad(8) if lens.model == "opencv" else [0.0] * 8
    start = [*start[: min(count, 5)], *[0.0] * (count - min(count, 5))]
    x, y = rays[:, 0], rays[:, 1]

    def predicted(values: Array) -> Array:
        fx, fy, cx, cy, *coefficients = _repeat_focal_length(values, one_focal_length)
        u, v = distort(x, y, [*coefficients, *[0.0] * (14 - count)])
        return np.stack((fx * u + cx, fy * v + cy), axis=-1)

    focal = lens.focal_length[: 1 if one_focal_length else 2]
    found = _least_squares(predicted, uv, [*focal, *lens.principal_point, *start])
    values = _repeat_focal_length(np.array(found), one_focal_length).tolist()
    return Lens((values[0], values[1]), (values[2], values[3]), tuple(values[4:]))


def _fisheye(lens: Lens, uv: Array, rays: Array, count: int = 4, one_focal_length: bool = False) -> Lens:
    x, y = rays[:, 0], rays[:, 1]
    radius = np.maximum(np.hypot(x, y), 1e-30)
    angle = np.arctan(radius)

    def predicted(values: Array) -> Array:
        fx, fy, cx, cy, *ks = _repeat_focal_length(values, one_focal_length)
        ks = [*ks, *[0.0] * (4 - count)]
        square = angle * angle
        bent = angle * (1 + square * (ks[0] + square * (ks[1] + square * (ks[2] + square * ks[3])))) / radius
        return np.stack((fx * x * bent + cx, fy * y * bent + cy), axis=-1)

    start = (lens.pad(4) if lens.model == "fisheye" else [0.3, 0.1, 0.0, 0.0])[:count]
    focal = lens.focal_length[: 1 if one_focal_length else 2]
    found = _least_squares(predicted, uv, [*focal, *lens.principal_point, *start])
    values = _repeat_focal_length(np.array(found), one_focal_length).tolist()
    return Lens((values[0], values[1]), (values[2], values[3]), tuple(values[4:]), "fisheye")


def _least_squares(predicted: object, uv: Array, start: list[float]) -> list[float]:
    """Levenberg-Marquardt with derivatives by complex steps, which are exact."""
    assert callable(predicted)
    tiny = 1e-200
    values = np.array(start, dtype=np.float64)
    scale = np.maximum(np.abs(values), 1.0)
    damping = 1e-3
    with np.errstate(all="ignore"):
        residual = (predicted(values) - uv).ravel()
        for _ in range(100):
            columns = []
            for number in range(len(values)):
                moved = values.astype(complex)
                moved[number] += 1j * tiny
                columns.append(predicted(moved).imag.ravel() / tiny * scale[number])
            jacobian = np.stack(columns, axis=-1)
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
            if not np.isfinite(normal).all():
                break
            step = -np.linalg.lstsq(normal + damping * np.diag(np.diag(normal) + 1e-12), gradient, rcond=None)[0]
            tried = values + step * scale
            new = (predicted(tried) - uv).ravel()
            if np.isfinite(new).all() and new @ new < residual @ residual:
                done = residual @ residual - new @ new < 1e-14 * (residual @ residual)
                values, residual, damping = tried, new, damping / 10
                if done:
                    break
            else:
                damping *= 10
                if damping > 1e8:
                    break
    return [float(value) for value in values]

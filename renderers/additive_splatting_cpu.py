"""Add Gaussian splats to images on CPUs: compiled, so that only pixels that a splat reaches are touched.

With tensors, adding windows takes an index for every pixel of every window, or a matrix product over whole images.
Both cost several times as much. `additive_splatting.py` is the tensor version; tests compare the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from renderers.additive_splatting import Splats
from renderers.compiling import njit

Array = NDArray[np.floating[Any]]
Flags = NDArray[np.bool_]
Places = NDArray[np.int32]

# Standard deviations beyond which a profile is less than the rounding of its peak: it is cut off there.
REACH = {torch.float32: 6.0, torch.float64: 8.6}
# Fewer images than this are not worth starting another thread for.
IMAGES_PER_THREAD = 64
NOWHERE = -(2**31)  # window start of splats that are not drawn
FAST = {"contract", "reassoc", "nsz"}


def draw_new(splats: Splats, image_size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Draw splats into new images (B, K, H, W); return the images, then what `draw` returns."""
    kind = np.float64 if splats.uv.dtype == torch.float64 else np.float32
    # NumPy asks Linux for huge pages: a large new tensor spends most of its time on faults of small pages.
    images = np.empty((len(splats.uv), splats.colours.shape[2], *image_size), dtype=kind)
    return torch.from_numpy(images), *_draw(images, splats)


def draw(images: Tensor, splats: Splats) -> tuple[Tensor, Tensor]:
    """Draw splats, overwriting images (B, K, H, W); return what `windows` returns."""
    return _draw(images.numpy(), splats)


def _draw(images: Array, splats: Splats) -> tuple[Tensor, Tensor]:
    # Large images push Python and PyTorch out of the caches, and each call then costs several microseconds: convert
    # each tensor once.
    uv, sizes, weight, colours, visible = _arrays(*splats)
    steps, starts = _windows(uv, sizes, visible, REACH[splats.uv.dtype], max(images.shape[2:]))
    _in_threads(_add, [images, sizes, weight, colours, steps, starts])
    return torch.from_numpy(steps), torch.from_numpy(starts)


def windows(splats: Splats, longest: int) -> tuple[Tensor, Tensor]:
    """Find the pixels that each splat reaches, in images whose longer side is given.

    Returns:
        (B, N, 2, w + 1) error function at the pixel edges of each window, and (B, N, 2) first pixel of each window.

    """
    uv, sizes, visible = _arrays(splats.uv, splats.sizes, splats.visible)
    steps, starts = _windows(uv, sizes, visible, REACH[splats.uv.dtype], longest)
    return torch.from_numpy(steps), torch.from_numpy(starts)


def _windows(uv: Array, sizes: Array, visible: Flags, reach: float, longest: int) -> tuple[Array, Places]:
    half = min(math.ceil(reach * _widest(sizes, visible)), longest)
    steps, starts = np.empty((*uv.shape, 2 * half + 2), dtype=uv.dtype), np.empty(uv.shape, dtype=np.int32)
    _place(uv, sizes, visible, longest, steps, starts)
    torch.from_numpy(steps).erf_()  # all edges at once, which is vectorized
    return steps, starts


def gradients(upstream: Tensor, splats: Splats, steps: Tensor, starts: Tensor) -> tuple[Tensor, ...]:
    """Pull the gradient of images (B, K, H, W) back to all inputs but `visible`; windows as returned by `windows`."""
    values = splats[:4]
    found = [torch.empty_like(x, memory_format=torch.contiguous_format) for x in values]
    _in_threads(_gradients, _arrays(upstream, *values, steps, starts, *found))
    return tuple(found)


def _arrays(*tensors: Tensor) -> list[NDArray[Any]]:
    """Share the memory of contiguous tensors; copy the others."""
    plain = (tensor.detach() if tensor.requires_grad else tensor for tensor in tensors)
    return [(tensor if tensor.is_contiguous() else tensor.contiguous()).numpy() for tensor in plain]


def _in_threads(work: Callable[..., None], arrays: list[NDArray[Any]]) -> None:
    """Call compiled work on all images, or on shares of them in as many threads as torch would use."""
    count = len(arrays[0])
    threads = min(torch.get_num_threads(), count // IMAGES_PER_THREAD)
    if threads < 2:
        work(*arrays)
        return
    bounds = [count * share // threads for share in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        shares = [[x[a:b] for x in arrays] for a, b in pairwise(bounds)]
        list(pool.map(lambda share: work(*share), shares))


@njit(cache=True)
def _widest(sizes: Array, visible: Flags) -> float:
    widest = 0.0
    for b in range(sizes.shape[0]):
        for n in range(sizes.shape[1]):
            if visible[b, n] and widest < sizes[b, n] < np.inf:
                widest = sizes[b, n]
    return widest


@njit(cache=True, error_model="numpy")
def _place(uv: Array, sizes: Array, visible: Flags, longest: int, edges: Array, starts: Places) -> None:
    """Find where windows start, and the edges of their pixels from the centre, in units of sqrt(2) size."""
    half = edges.shape[3] // 2 - 1
    for b in range(uv.shape[0]):
        for n in range(uv.shape[1]):
            u, v = uv[b, n]
            if not (visible[b, n] and np.isfinite(u) and np.isfinite(v) and 0 < sizes[b, n] < np.inf):
                starts[b, n], edges[b, n] = NOWHERE, 0
                continue
            scale = 1 / (math.sqrt(2) * sizes[b, n])
            for axis in range(2):
                # Clamp positions far outside the image to just out of reach, which fits into an integer.
                start = round(min(max(uv[b, n, axis], -half - 1.0), longest + half + 1.0)) - half
                if half == longest:  # reaches as far or farther: cover the whole image from wherever the splat is
                    start = min(max(start, -longest - 1), 0)
                starts[b, n, axis] = start
                first = start - 0.5 - uv[b, n, axis]
                for j in range(edges.shape[3]):
                    edges[b, n, axis, j] = (first + j) * scale


@njit(cache=True, nogil=True, fastmath=FAST)
def _add(images: Array, sizes: Array, weight: Array, colours: Array, steps: Array, starts: Places) -> None:
    height, width = images.shape[2:]
    length = steps.shape[3] - 1
    profiles = np.empty((2, length), dtype=images.dtype)
    for b in range(images.shape[0]):
        images[b] = 0
        for n in range(sizes.shape[1]):
            left, top = starts[b, n]
            first, last = max(left, 0), min(left + length, width)
            if left == NOWHERE or last <= first:
                continue
            _profiles(steps[b, n], sizes[b, n], profiles)
            across, down = profiles[0, first - left : last - left], profiles[1]
            for k in range(images.shape[1]):
                light = colours[b, n, k] * weight[b, n]
                if light == 0:
                    continue
                for i in range(max(top, 0), min(top + length, height)):
                    row, factor = images[b, k, i, first:last], light * down[i - top]
                    for j in range(len(across)):
                        row[j] += factor * across[j]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _gradients(
    upstream: Array, uv: Array, sizes: Array, weight: Array, colours: Array, steps: Array, starts: Places,
    by_uv: Array, by_sizes: Array, by_weight: Array, by_colours: Array,
) -> None:  # fmt: skip
    height, width = upstream.shape[2:]
    length = steps.shape[3] - 1
    zero = upstream.dtype.type(0)
    profiles = np.empty((2, length), dtype=upstream.dtype)
    by_profiles = np.empty_like(profiles)
    by_uv[:], by_sizes[:], by_weight[:], by_colours[:] = 0, 0, 0, 0
    for b in range(upstream.shape[0]):
        for n in range(sizes.shape[1]):
            left, top = starts[b, n]
            first, last = max(left, 0), min(left + length, width)
            if left == NOWHERE or last <= first:
                continue
            _profiles(steps[b, n], sizes[b, n], profiles)
            by_profiles[:] = 0
            across, down = profiles[0, first - left : last - left], profiles[1]
            by_across, by_down = by_profiles[0, first - left : last - left], by_profiles[1]
            for k in range(upstream.shape[1]):
                light, by_light = colours[b, n, k] * weight[b, n], zero
                # Two loops over the window; the second finds it in the cache. A sum alone is vectorized without checks
                # for overlapping reads and writes.
                for i in range(max(top, 0), min(top + length, height)):
                    row, total = upstream[b, k, i, first:last], zero
                    for j in range(len(across)):
                        total += row[j] * across[j]
                    by_down[i - top] += light * total
                    by_light += down[i - top] * total
                by_colours[b, n, k] = weight[b, n] * by_light
                by_weight[b, n] += colours[b, n, k] * by_light
                for i in range(max(top, 0), min(top + length, height)):
                    row, factor = upstream[b, k, i, first:last], light * down[i - top]
                    for j in range(len(across)):
                        by_across[j] += factor * row[j]
            for axis in range(2):
                start = starts[b, n, axis] - uv[b, n, axis]
                by_uv[b, n, axis], by_size = _through_profile(by_profiles[axis], profiles[axis], start, sizes[b, n])
                by_sizes[b, n] += by_size


@njit(cache=True, nogil=True, fastmath=FAST)
def _profiles(steps: Array, size: float, profiles: Array) -> None:
    scale = profiles.dtype.type(math.sqrt(math.pi / 2)) * size
    for axis in range(2):
        for j in range(profiles.shape[1]):
            profiles[axis, j] = scale * (steps[axis, j + 1] - steps[axis, j])


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _through_profile(by_profile: Array, values: Array, start: float, size: float) -> Any:
    """Pull a gradient of a profile's pixels back to its centre and its size."""
    by_centre = by_size = before = by_profile.dtype.type(0)
    for j in range(len(values)):
        edge = (start + j - 0.5) / size
        gaussian = math.exp(-0.5 * edge * edge)
        # This is the right edge of the previous pixel, and the left edge of this pixel.
        change = by_profile[j] - before
        by_centre += change * gaussian
        by_size += change * edge * gaussian + by_profile[j] * values[j] / size
        before = by_profile[j]
    edge = (start + len(values) - 0.5) / size
    gaussian = math.exp(-0.5 * edge * edge)
    return by_centre - before * gaussian, by_size - before * edge * gaussian

"""Add Gaussian splats to images on CPUs: compiled, so that only pixels that a splat reaches are touched.

Tensors cannot add windows without an index for every pixel of every window, or a matrix product over whole images; both
cost several times what is done here. `adding.py` says the same in tensors and is what this is tested against.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from renderers import adding
from renderers.adding import profile

Array = NDArray[np.floating[Any]]
Places = NDArray[np.integer[Any]]

# Standard deviations beyond which a profile is less than the rounding of its peak: it is cut off there.
REACH = {torch.float32: 6.0, torch.float64: 8.6}
# Fewer images than this are not worth the start of another thread.
IMAGES_PER_THREAD = 64
FAST = {"contract", "reassoc", "nsz"}


def added(uv: Tensor, sizes: Tensor, colours: Tensor, image_size: tuple[int, int], out: Tensor | None = None) -> Tensor:
    """Do the work of `adding.added`, which has the arguments, for finite float32 or float64 tensors on the CPU."""
    if out is None:
        images: Tensor = _Added.apply(uv, sizes, colours, image_size)
        return images
    _draw(out, *(x.detach() for x in (uv, sizes, colours)))
    return out


class _Added(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, uv: Tensor, sizes: Tensor, colours: Tensor, image_size: tuple[int, int]) -> Tensor:
        kind = np.float64 if uv.dtype == torch.float64 else np.float32
        # NumPy asks Linux for huge pages: most of the time of a large fresh tensor goes into faults of small ones.
        images = torch.from_numpy(np.empty((len(uv), colours.shape[2], *image_size), dtype=kind))
        ctx.save_for_backward(uv, sizes, colours, *_draw(images, uv, sizes, colours))
        return images

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        uv, sizes, colours, profiles, starts = ctx.saved_tensors
        inputs = (uv, sizes, colours)
        if torch.is_grad_enabled():  # the gradient itself is to be differentiated
            images = adding.added(uv, sizes, colours, (upstream.shape[2], upstream.shape[3]))
            wanted = [x for x in inputs if x.requires_grad]
            found = iter(torch.autograd.grad(images, wanted, upstream, create_graph=True))
            return (*(next(found) if x.requires_grad else None for x in inputs), None)
        gradients = [torch.empty_like(x, memory_format=torch.contiguous_format) for x in inputs]
        _in_threads(_gradients, upstream, *inputs, profiles, starts, *gradients)
        return (*gradients, None)


def _draw(images: Tensor, uv: Tensor, sizes: Tensor, colours: Tensor) -> tuple[Tensor, Tensor]:
    """Overwrite images; return the profiles (B, N, 2, w) on windows and where these start (B, N, 2)."""
    widest = float(sizes.max()) if sizes.numel() else 0.0
    longest = max(images.shape[2:])
    half = min(math.ceil(REACH[uv.dtype] * widest), longest)
    # Far outside the image is as good as just outside of reach, and fits into an integer.
    starts = uv.round().clamp_(-half - 1, longest + half).sub_(half)
    profiles = profile(uv, sizes[..., None].expand_as(uv), starts, 2 * half + 1)
    starts = starts.int()
    _in_threads(_add, images, colours, profiles, starts)
    return profiles, starts


def _in_threads(work: Callable[..., None], *tensors: Tensor) -> None:
    """Call compiled work on all images, or on shares of them in as many threads as torch would use."""
    arrays = [tensor.contiguous().numpy() for tensor in tensors]
    count = len(arrays[0])
    threads = min(torch.get_num_threads(), count // IMAGES_PER_THREAD)
    if threads < 2:
        work(*arrays)
        return
    bounds = [count * share // threads for share in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        shares = [[x[a:b] for x in arrays] for a, b in pairwise(bounds)]
        list(pool.map(lambda share: work(*share), shares))


@njit(cache=True, nogil=True, fastmath=FAST)
def _add(images: Array, colours: Array, profiles: Array, starts: Places) -> None:
    height, width = images.shape[2:]
    length = profiles.shape[3]
    for b in range(images.shape[0]):
        images[b] = 0
        for n in range(colours.shape[1]):
            left, top = starts[b, n]
            first, last = max(left, 0), min(left + length, width)
            across, down = profiles[b, n, 0, first - left : max(last - left, 0)], profiles[b, n, 1]
            for k in range(images.shape[1]):
                colour = colours[b, n, k]
                if colour == 0 or last <= first:
                    continue
                for i in range(max(top, 0), min(top + length, height)):
                    row, factor = images[b, k, i, first:last], colour * down[i - top]
                    for j in range(len(across)):
                        row[j] += factor * across[j]


@njit(cache=True, nogil=True, fastmath=FAST)
def _gradients(
    upstream: Array, uv: Array, sizes: Array, colours: Array, profiles: Array, starts: Places,
    by_uv: Array, by_sizes: Array, by_colours: Array,
) -> None:  # fmt: skip
    height, width = upstream.shape[2:]
    length = profiles.shape[3]
    zero = upstream.dtype.type(0)
    by_profile = np.empty((2, length), dtype=upstream.dtype)
    for b in range(upstream.shape[0]):
        for n in range(colours.shape[1]):
            left, top = starts[b, n]
            first, last = max(left, 0), max(min(left + length, width), 0)
            across, down = profiles[b, n, 0, first - left : max(last - left, 0)], profiles[b, n, 1]
            by_profile[:] = 0
            by_across, by_down = by_profile[0, first - left :], by_profile[1]
            for k in range(upstream.shape[1]):
                colour, light = colours[b, n, k], zero
                # Two loops over the window, the second finds it in the cache: a sum alone is vectorized, without
                # checks whether what is written overlaps what is read.
                for i in range(max(top, 0), min(top + length, height)):
                    row, total = upstream[b, k, i, first:last], zero
                    for j in range(len(across)):
                        total += row[j] * across[j]
                    by_down[i - top] += colour * total
                    light += down[i - top] * total
                by_colours[b, n, k] = light
                for i in range(max(top, 0), min(top + length, height)):
                    row, factor = upstream[b, k, i, first:last], colour * down[i - top]
                    for j in range(len(across)):
                        by_across[j] += factor * row[j]
            by_sizes[b, n] = zero
            for axis in range(2):
                by_uv[b, n, axis], by_size = _through_profile(
                    by_profile[axis], profiles[b, n, axis], starts[b, n, axis] - uv[b, n, axis], sizes[b, n]
                )
                by_sizes[b, n] += by_size


@njit(cache=True, nogil=True, fastmath=FAST)
def _through_profile(by_profile: Array, values: Array, start: float, size: float) -> Any:
    """Take a gradient by a profile's pixels to one by its centre and one by its size.

    The profile is sqrt(pi / 2) size (erf(right) - erf(left)) of edges over sqrt(2) size.
    """
    by_centre = by_size = before = by_profile.dtype.type(0)
    for j in range(len(values)):
        edge = (start + j - 0.5) / size
        gaussian = math.exp(-0.5 * edge * edge)
        # This edge is the right one of the pixel before, and the left one of this pixel.
        change = by_profile[j] - before
        by_centre += change * gaussian
        by_size += change * edge * gaussian + by_profile[j] * values[j] / size
        before = by_profile[j]
    edge = (start + len(values) - 0.5) / size
    gaussian = math.exp(-0.5 * edge * edge)
    return by_centre - before * gaussian, by_size - before * edge * gaussian

"""Draw fiducials as Gaussian splats: differentiable, anti-aliased, sub-pixel exact."""

import math
from contextlib import nullcontext
from typing import Literal

import torch
from torch import Tensor

from renderers import additive_splatting, additive_splatting_operator
from renderers.additive_splatting import Splats, profile
from renderers.compositing import Canvas, composite_windows, window_starts

# A window of 5 standard deviations cuts the profile off at 4e-6 of its peak.
WINDOW_SIGMAS = 5.0
# Images converted at a time when the buffer has a lower precision: the float32 images then stay in the cache.
IMAGES_PER_CONVERSION = 16


def splat(
    uv: Tensor,
    colours: Tensor,
    size: Tensor | float,
    image_size: tuple[int, int],
    *,
    intensity: Tensor | None = None,
    visible: Tensor | None = None,
    depth: Tensor | None = None,
    compositing: Literal["add", "over"] = "add",
    out: Tensor | None = None,
) -> Tensor:
    """Draw every fiducial as a coloured Gaussian, integrated over the area of each pixel.

    A pixel holds ``colour * intensity * integral of exp(-r^2 / (2 size^2))`` over its area: a wide splat peaks at its
    colour, a narrow one dims but keeps its mass ``2 pi size^2``, wherever in the pixel it lies. Differentiable in
    ``uv``, ``colours``, ``size`` and ``intensity``; a fiducial that is invisible, far outside the image, or not finite
    in place or size draws nothing and gets zero gradients. Light below the rounding of a splat's peak may be left out.

    Where splats overlap, ``"add"`` sums their light, in any order (values may exceed 1 and are not clamped). ``"over"``
    composites front to back: a splat has the opacity ``intensity * profile``, clamped to [0, 1], and hides what lies
    deeper. Where nothing overlaps both give the same image; ``"over"`` costs several times more, cuts profiles off
    beyond 5 sizes, and needs memory for the images plus one window per fiducial.

    On a CPU ``"add"`` costs little more than clearing the images: a reused ``out`` that stays in the cache is fastest,
    while fresh memory costs page faults for every image. ``"over"`` gains from ``THP_MEM_ALLOC_ENABLE=1``, with which
    PyTorch asks Linux for huge pages; ``"add"`` asks for them itself.

    Args:
        uv: (*B, N, 2) pixels of the output image.
        colours: (N, K) or (*B, N, K) colours in [0, 1], K = 3 for RGB.
        size: Standard deviation of the Gaussian in pixels, positive; a number or broadcastable to (*B, N).
        image_size: Height and width of the images.
        intensity: Broadcastable to (*B, N), default 1.
        visible: Broadcastable to (*B, N), bool, default all.
        depth: (*B, N), smaller is nearer; only for ``"over"``, default: the first fiducial is the nearest.
        compositing: ``"add"`` or ``"over"``.
        out: (*B, K, H, W) contiguous buffer that is overwritten and returned; not differentiable. May have a lower
            precision (bfloat16, float16): the images are computed in float32 and rounded once.

    Returns:
        (*B, K, H, W) images on black, in the dtype of ``uv`` (at least float32) or of ``out``.

    Raises:
        ValueError: Shapes do not fit, a compositing mode is unknown, or ``out`` is used while gradients are recorded.

    Convention: pixel (0, 0) is the centre of the top-left pixel, u right, v down.

    Examples:
        >>> uv = torch.tensor([[10.0, 12.0], [20.0, 4.0]])  # centres of two fiducials
        >>> image = splat(uv, torch.eye(3)[:2], 1.5, (32, 24))  # red and green dots, 32 rows of 24 pixels
        >>> image.shape, image[0, 12, 10] > image[0, 12, 13]
        (torch.Size([3, 32, 24]), tensor(True))
    """
    if isinstance(size, int | float) and not 0 < size < math.inf:
        raise ValueError(f"size must be positive and finite, found {size}")
    batch, count = uv.shape[:-2], uv.shape[-2]
    images = math.prod(batch)
    _check(uv, colours, compositing, depth)
    for name, value in (("size", size), ("intensity", intensity), ("visible", visible)):
        if isinstance(value, Tensor) and not _broadcasts(value.shape, uv.shape[:-1]):
            expected = f"{tuple(uv.shape[:-1])} or broadcast to it"
            raise ValueError(f"{name} must have shape {expected}, found {tuple(value.shape)}")
    dtype = uv.dtype if uv.dtype == torch.float64 else torch.float32

    def one_each(value: Tensor | float, dtype: torch.dtype) -> Tensor:  # (images, N)
        if not isinstance(value, Tensor):
            return torch.full((images, count), value, dtype=dtype, device=uv.device)
        return value.to(uv.device, dtype).expand(*batch, count).reshape(images, count)

    # Autocast would round the profiles to bfloat16, and the gradient of a coordinate with them.
    kind = uv.device.type
    with torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext():
        splats = Splats(
            uv.to(dtype).reshape(images, count, 2),
            one_each(size, dtype),
            one_each(1.0 if intensity is None else intensity, dtype),
            colours.to(dtype).expand(*batch, *colours.shape[-2:]).reshape(images, count, colours.shape[-1]),
            one_each(True if visible is None else visible, torch.bool),
        )
        shape = (*batch, colours.shape[-1], *image_size)
        if out is not None:
            _check_out(out, shape, uv.device, splats)
        if compositing == "add":
            return _add(splats, shape, out)
        drawn = splats.drop_undrawable()
        reach = _reach(drawn.sizes if isinstance(size, Tensor) else size)
        composed = _over(drawn, reach, image_size, depth).reshape(shape)
        return composed if out is None else out.copy_(composed)


def _add(splats: Splats, shape: tuple[int, ...], out: Tensor | None) -> Tensor:
    """Sum the splats in any order."""
    splat_additively = (
        additive_splatting_operator.splat_additively
        if splats.uv.device.type == "cpu"
        else additive_splatting.splat_additively
    )
    image_size = (shape[-2], shape[-1])
    if out is None:
        return splat_additively(splats, image_size).view(shape)
    images, count = out.view(len(splats.uv), *shape[-3:]), len(splats.uv)
    if out.dtype == splats.uv.dtype:
        splat_additively(splats, image_size, images)
        return out
    buffer = splats.uv.new_empty(min(count, IMAGES_PER_CONVERSION), *shape[-3:])
    for first in range(0, count, IMAGES_PER_CONVERSION):
        part = slice(first, min(first + IMAGES_PER_CONVERSION, count))
        images[part] = splat_additively(Splats(*(x[part] for x in splats)), image_size, buffer[: part.stop - first])
    return out


def _reach(size: Tensor | float) -> float:
    """Largest size, in pixels; infinite while tracing, since a graph must not depend on values."""
    if isinstance(size, int | float):
        return float(size)
    if torch.compiler.is_compiling():
        return math.inf
    return float(size.detach().max()) if size.numel() else 0.0


def _over(splats: Splats, reach: float, image_size: tuple[int, int], depth: Tensor | None) -> Tensor:
    """Composite the splats front to back on local windows, or on whole images: (B, K, H, W)."""
    uv, sizes, weight, colours, _ = splats
    if depth is not None:
        order = depth.reshape(sizes.shape).argsort(dim=-1, stable=True)
        uv, colours = (x.gather(1, order[..., None].expand_as(x)) for x in (uv, colours))
        sizes, weight = sizes.gather(1, order), weight.gather(1, order)
    height, width = image_size
    window = 2 * math.ceil(WINDOW_SIGMAS * reach) + 1 if reach < math.inf else max(image_size)
    window_height, window_width = min(window, height), min(window, width)
    rows = window_starts(uv[..., 1], window_height, height)
    columns = window_starts(uv[..., 0], window_width, width)
    along_v = weight[..., None] * profile(uv[..., 1], sizes, rows, window_height)
    along_u = profile(uv[..., 0], sizes, columns, window_width)
    alpha = (along_v[..., :, None] * along_u[..., None, :]).clamp(0, 1)  # (B, N, h, w)
    canvas = Canvas.blank(len(uv), colours.shape[-1], image_size, like=alpha)
    composite_windows(canvas, alpha, colours, rows, columns)
    return canvas.images


def _broadcasts(shape: torch.Size, to: torch.Size) -> bool:
    ends = zip(reversed(shape), reversed(to), strict=False)
    return len(shape) <= len(to) and all(one in (1, other) for one, other in ends)


def _check(uv: Tensor, colours: Tensor, compositing: str, depth: Tensor | None) -> None:
    if uv.ndim < 2 or uv.shape[-1] != 2 or not uv.is_floating_point():
        raise ValueError(f"uv must be floating point of shape (*B, N, 2), found {uv.dtype} of shape {tuple(uv.shape)}")
    if colours.ndim < 2 or colours.shape[-2] != uv.shape[-2] or not _broadcasts(colours.shape[:-2], uv.shape[:-2]):
        expected = f"({uv.shape[-2]}, K) or (*B, {uv.shape[-2]}, K)"
        raise ValueError(f"colours must have shape {expected}, found {tuple(colours.shape)}")
    if compositing not in ("add", "over"):
        raise ValueError(f"compositing must be 'add' or 'over', found {compositing!r}")
    if depth is not None and (compositing == "add" or depth.shape != uv.shape[:-1]):
        expected = f"shape {tuple(uv.shape[:-1])} and compositing='over'"
        raise ValueError(f"depth needs {expected}, found shape {tuple(depth.shape)} and {compositing!r}")


def _check_out(out: Tensor, shape: tuple[int, ...], device: torch.device, inputs: tuple[Tensor, ...]) -> None:
    if tuple(out.shape) != shape or out.device != device or not out.is_contiguous() or not out.is_floating_point():
        found = f"{out.dtype} of shape {tuple(out.shape)} on {out.device}"
        raise ValueError(f"out must be contiguous, floating point, of shape {shape} on {device}; found {found}")
    if torch.is_grad_enabled() and any(x.requires_grad for x in inputs):
        raise ValueError("out is not differentiable: render without it, or under torch.no_grad()")

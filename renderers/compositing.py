"""Draw many small windows into images, nearest first, without a volume of fiducials times pixels."""

from typing import NamedTuple

import torch
from torch import Tensor


def window_starts(centre: Tensor, length: int, image_length: int) -> Tensor:
    """Place windows around centres along one axis, moved so that they lie inside the image.

    Args:
        centre: (...) pixels, finite.
        length: Pixels in a window, at most ``image_length``.
        image_length: Pixels of the image along this axis.

    Returns:
        (...) integer pixel at which each window starts.

    """
    # Clamped before the conversion: a finite float can lie far outside the range of an integer.
    last = image_length - length
    return (centre.detach() - (length - 1) / 2).clamp(0, last).round().long()


class Canvas(NamedTuple):
    """Images being composited front to back."""

    images: Tensor  # (B, K, H, W)
    transmittance: Tensor  # (B, H, W) share of the light from behind that still passes

    @classmethod
    def blank(cls, batch: int, channels: int, image_size: tuple[int, int], like: Tensor) -> "Canvas":
        """Start with black images and nothing in front."""
        return cls(like.new_zeros(batch, channels, *image_size), like.new_ones(batch, *image_size))


def composite_windows(
    canvas: Canvas, alpha: Tensor, colours: Tensor, rows: Tensor, columns: Tensor, light: Tensor | None = None
) -> Tensor:
    """Composite windows front to back: every window adds ``transmittance * alpha * colour``. Changes ``canvas``.

    Memory is that of the windows plus the images; the loop runs over fiducials, the batch is vectorized.

    Args:
        canvas: Images so far, which lie in front.
        alpha: (B, N, h, w) opacity in [0, 1] on each window, nearest fiducial first.
        colours: (B, N, K) colour of each fiducial.
        rows: (B, N) first image row of each window.
        columns: (B, N) first image column of each window.
        light: (B, N, h, w) emitted light where it differs from `alpha`: adds `transmittance * light * colour`.

    Returns:
        (B, N) sum of each fiducial's opacity over the pixels, less what nearer fiducials hide.
    """
    (batch, count, window_height, window_width), channels = alpha.shape, colours.shape[-1]
    height, width = canvas.images.shape[-2:]
    images, transmittance = canvas.images.flatten(2), canvas.transmittance.flatten()  # views
    y = rows[..., None] + torch.arange(window_height, device=alpha.device)  # (B, N, h)
    x = columns[..., None] + torch.arange(window_width, device=alpha.device)  # (B, N, w)
    index = (y[..., :, None] * width + x[..., None, :]).flatten(2)  # (B, N, h*w)
    first_pixel = height * width * torch.arange(batch, device=alpha.device)[:, None]
    seen = []
    for n in range(count):
        at = first_pixel + index[:, n]
        # Indexing and accumulation save indices only: autograd keeps windows, never a copy of the images.
        passed = transmittance[at]
        visible = passed * alpha[:, n].flatten(1)  # (B, h*w)
        shining = visible if light is None else passed * light[:, n].flatten(1)
        transmittance.index_put_((at,), -visible, accumulate=True)
        window = index[:, None, n].expand(-1, channels, -1)
        images.scatter_add_(2, window, shining[:, None] * colours[:, n, :, None])
        seen.append(visible.sum(-1))
    return torch.stack(seen, dim=-1) if seen else alpha.new_zeros(batch, 0)

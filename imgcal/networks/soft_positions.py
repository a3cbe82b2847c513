"""Fiducial positions in colour-coded images: soft coordinates by colour, weighted by an encoder's heatmaps.

An image is almost all black. Only the other pixels are processed, as one long ragged row over all images, so that the
cost depends on the number of dots, not on the number of pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.operators import Operator, Tensors
from renderers import is_traced

DARK = 8 / 255  # darker pixels are background: quantization has destroyed their hue
HUE_TOLERANCE = 0.06  # rad between the hues of a pixel and a fiducial; the first 8 colours are 0.3 apart
WINDOW = 2.0  # in sizes of a dot: Gaussian window of the second pass, around the centroid of the first
LEAST_LIGHT = 0.05  # smallest share of a full dot's light for a detection
OUTLIER_SPREAD = 2.0  # in sizes of a dot: light with a larger spread is not a single dot


def find_soft_positions(
    images: Tensor, colours: Tensor, dot: float, heatmap_logits: Tensor | None = None, *, through_window: bool = False
) -> tuple[Tensor, Tensor]:
    """Locate every fiducial in every image.

    Args:
        images: (I, 3, H, W) colour-coded splats on black, in [0, 1].
        colours: (N, 3) of the fiducials.
        dot: standard deviation of a dot in pixels.
        heatmap_logits: (I, N, h, w) log weights of an encoder's cells, which multiply the colour's; None = colour only.
        through_window: also differentiate through the position of the second pass's window. Otherwise the gradient only
            comes from the pixels within the window, which is more stable in training.

    Returns:
        uv (I, N, 2) pixels of the image and confidence (I, N) in [0, 1]: the share of a full dot's light that was found
        in one place; zero without a detection, with finite positions. Differentiable in `heatmap_logits`, in the dtype
        of `images`.
    """
    if not is_traced():
        return _soft_positions(images, colours, dot, heatmap_logits, through_window)
    given = images.new_zeros(len(images), 0, 1, 1) if heatmap_logits is None else heatmap_logits.to(images.dtype)
    uv, confidence = OPERATOR(images, colours, given, options=f"{float(dot)!r} {int(through_window)}")
    return uv, confidence


def _soft_positions(
    images: Tensor, colours: Tensor, dot: float, heatmap_logits: Tensor | None, through_window: bool
) -> tuple[Tensor, Tensor]:
    """Do the work of `find_soft_positions`; the number of processed pixels depends on the images."""
    count, _, height, width = images.shape
    with torch.no_grad():
        pixels = images.amax(1)
        image, v, u = (pixels > DARK).nonzero(as_tuple=True)
        colour = images[image, :, v, u]  # (M, 3)
        likeness = _likeness(colour, colours.to(images))
        light = (colour @ torch.nn.functional.normalize(colours.to(images), dim=-1).T) * likeness  # (M, N)
        place = torch.stack((u, v), dim=-1).to(images)
    weight = light
    if heatmap_logits is not None:
        row, column = v * heatmap_logits.shape[-2] // height, u * heatmap_logits.shape[-1] // width
        weight = light * heatmap_logits[image, :, row, column].to(light.dtype).clamp(-8, 8).exp()
    first, _, _ = _centres(weight, place, image, count)
    with torch.set_grad_enabled(torch.is_grad_enabled() and through_window):
        apart = (place[:, None] - first[image]).square().sum(-1) / (WINDOW * dot) ** 2
        window = torch.exp(-0.5 * apart)
    second, found, spread = _centres(weight * window, place, image, count)
    # A window of w sizes keeps w^2 / (1 + w^2) of a dot's light and biases its centroid accordingly: correct for it.
    kept = WINDOW**2 / (1 + WINDOW**2)
    centre = first.detach() + (second - first.detach()) / kept if heatmap_logits is None else second
    full = colours.to(images).norm(dim=-1) * (2 * torch.pi * dot**2) * kept
    share = (_sums(light * window, image, count) / full).clamp(0, 1)
    confidence = torch.where((share > LEAST_LIGHT) & (spread < (OUTLIER_SPREAD * dot) ** 2), share, 0.0)
    return torch.where((found > 0)[..., None], centre, 0.0), confidence


def _likeness(colour: Tensor, colours: Tensor) -> Tensor:
    """Agreement between the hues of pixels (M, 3) and fiducials (N, 3): (M, N) in [0, 1]."""
    direction = torch.nn.functional.normalize(colour, dim=-1)
    cosine = (direction @ torch.nn.functional.normalize(colours, dim=-1).T).clamp(-1, 1)
    # Quantization changes the hue of dark pixels, so their tolerance is larger.
    tolerance = HUE_TOLERANCE + (0.5 / 255) / colour.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return torch.exp(-(1 - cosine) / tolerance.square())


def _centres(weight: Tensor, place: Tensor, image: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted centroids (I, N, 2), sums of weights (I, N) and mean squared distances from the centroid (I, N)."""
    total = _sums(weight, image, count)
    safe = total.clamp_min(1e-12)
    moments = torch.stack([_sums(weight * place[:, axis, None], image, count) for axis in (0, 1)], dim=-1)
    centre = moments / safe[..., None]
    with torch.no_grad():
        squared = (place[:, None] - centre[image]).square().sum(-1)
        spread = _sums(weight * squared, image, count) / safe
    return centre, total, spread


def _sums(values: Tensor, image: Tensor, count: int) -> Tensor:
    """Sum rows (M, N) by image: (I, N)."""
    return values.new_zeros(count, values.shape[-1]).index_add(0, image, values)


def _compute(inputs: Tensors, options: str) -> Tensors:
    images, colours, heatmap_logits = inputs
    dot, through_window = options.split()
    given = heatmap_logits if heatmap_logits.shape[1] else None
    return _soft_positions(images, colours, float(dot), given, through_window == "1")


def _like(inputs: Tensors, options: str) -> Tensors:
    images, colours, _ = inputs
    confidence = images.new_empty(len(images), len(colours))
    return images.new_empty(*confidence.shape, 2), confidence


OPERATOR = Operator(
    name="soft_positions",
    inputs=("images", "colours", "heatmap_logits"),
    outputs=("uv", "confidence"),
    differentiable=frozenset(("heatmap_logits", "uv", "confidence")),
    batched=frozenset(("images", "heatmap_logits")),
    compute=_compute,
    attach=lambda inputs, outputs, options: _compute(inputs, options),
    like=_like,
)

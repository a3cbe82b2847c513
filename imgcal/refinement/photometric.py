"""Photometric normal equations of colour-coded dots, for the position of each dot.

A dot is an outer product (colour x profile down x profile across), so products of images of dots are products of short
one-dimensional sums. Blurred steps (`take_blurred_step`) render no image at all. Near steps (`DotWindows`) render
windows, because only rendering models overlapping dots that saturate.

Axes: M images (rigs times cameras), N dots, K channels, H, W image, w side of a window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from renderers.compositing import window_starts

AMPLITUDE_RIDGE = 0.1  # weight of the prior that every dot is present
WINDOW_SIGMAS = 3.5  # beyond it a dot is darker than half a grey level of 8 bit
WINDOW_MARGIN = 0.75  # pixels that a dot may move in its window
FARTHEST = 30.0  # half the squared distance, in standard deviations, beyond which the slope is zero
DAMPING = 1e-3  # added to the diagonal of the near normal equations, relative to it


@dataclass(frozen=True)
class ShiftPrior:
    """How far dots may be from their predicted positions: pixels, one standard deviation of each axis."""

    together: float  # shift common to all dots of an image
    alone: float  # independent shift of each dot

    def precision(self, like: Tensor) -> Tensor:
        """Inverse covariance of all u and all v of N dots, (2N, 2N). `like` (N, K) gives N, dtype and device."""
        count, alone, together = len(like), self.alone**2, self.together**2
        one_axis = (torch.eye(count).to(like) - together / (alone + count * together)) / alone
        return torch.block_diag(one_axis, one_axis)

    def scale(self, factor: float) -> ShiftPrior:
        """Change the unit of length."""
        return ShiftPrior(self.together * factor, self.alone * factor)


def take_blurred_step(
    images: Tensor, uv: Tensor, colours: Tensor, dot: float, blur: float, prior: ShiftPrior, trust: float
) -> tuple[Tensor, Tensor]:
    """Take one Gauss-Newton step of all dots at once on blurred images with blurred dots.

    The blur is applied to the profiles instead of the images: the product with a blurred image equals the product of
    the image with a blurred profile. Amplitudes are solved for first, so that missing dots have no influence.

    Args:
        images: (M, K, H, W), square.
        uv: (M, N, 2) pixels where dots are predicted, finite.
        colours: (N, K).
        dot: standard deviation of a dot, pixels.
        blur: standard deviation of the blur, pixels.
        prior: how far the dots may be from the prediction.
        trust: standard deviation of a measured position in the blurred image, as a fraction of the blurred dot's width.

    Returns:
        (M, N, 2) step in pixels, and (M, N) amplitude: about 1 where a dot is found, about 0 where it is missing.
    """
    size, count = images.shape[-1], len(colours)
    model, match = math.hypot(dot, blur), math.sqrt(dot**2 + 2 * blur**2)
    value, slope = profile_and_slope(uv.mT, model, size)  # (M, 2 axes, N, size)
    (value_u, value_v), (slope_u, slope_v), (cross_u, cross_v) = (  # (M, N, N): <g_n, g_m>, <g'_n, g'_m>, <g'_n, g_m>
        (first @ second.mT).unbind(1) for first, second in ((value, value), (slope, slope), (slope, value))
    )
    alike = colours @ colours.mT
    overlap = alike * value_u * value_v
    alike_u, alike_v = alike * cross_u * value_v, alike * value_u * cross_v

    value, slope = profile_and_slope(uv.mT, match, size)
    across = torch.cat((value[:, 0], slope[:, 0]), 1).mT  # (M, W, 2N)
    rows = torch.bmm(images.flatten(1, 2), across).unflatten(1, images.shape[1:3])  # (M, K, H, 2N)
    of_value, of_slope = (rows.unflatten(-1, (2, count)) * colours.mT[:, None, None]).sum(1).unbind(-2)  # (M, H, N)
    value_down, slope_down = value[:, 1].mT, slope[:, 1].mT  # (M, H, N)
    scale = model**4 / (dot * match) ** 2
    light = scale * (of_value * value_down).sum(1)
    by_u, by_v = scale * (of_slope * value_down).sum(1), scale * (of_value * slope_down).sum(1)

    ridge = AMPLITUDE_RIDGE * math.pi * model**2 * alike.diagonal()
    amplitude = torch.linalg.solve(overlap + torch.diag(ridge), light + ridge).clamp(0, 1)
    by_u = by_u - (alike_u @ amplitude[..., None]).squeeze(-1)
    by_v = by_v - (alike_v @ amplitude[..., None]).squeeze(-1)
    pull = torch.cat((amplitude * by_u, amplitude * by_v), -1)
    mixed = alike * cross_u * cross_v.mT
    hessian = _blocks(alike * slope_u * value_v, mixed, mixed.mT, alike * value_u * slope_v)
    both = torch.cat((amplitude, amplitude), -1)
    hessian = hessian * both[:, :, None] * both[:, None]
    stiffness = math.pi / 2 * (trust * model) ** 2 * prior.precision(colours)
    step = torch.linalg.solve(hessian + stiffness, pull)
    return step.unflatten(1, (2, count)).mT, amplitude


class NearFit(NamedTuple):
    """Positions of dots after some near steps, and their accuracy."""

    uv: Tensor  # (M, N, 2) pixels
    variance: Tensor  # (M, N) square pixels, per axis, for unit noise variance of a channel
    mean_square: Tensor  # (M, N) residual before the last step, over the pixels and channels of each window


class DotWindows:
    """Windows of the images around the predicted dots, cut out once and compared with rendered dots in each step."""

    def __init__(self, images: Tensor, uv: Tensor, colours: Tensor, dot: float) -> None:
        """Cut the windows out.

        Args:
            images: (M, K, H, W).
            uv: (M, N, 2) pixels, finite; positions outside the image get the nearest window.
            colours: (N, K); their dtype is used for the computation.
            dot: standard deviation of a dot, pixels.
        """
        height, width = images.shape[-2:]
        self.colours, self.dot = colours, dot
        self.side = min(2 * math.ceil(WINDOW_SIGMAS * dot + WINDOW_MARGIN) + 1, height, width)
        starts = [window_starts(uv[..., i], self.side, size) for i, size in ((0, width), (1, height))]
        self.start = torch.stack(starts, -1)  # (M, N, 2) first column and row
        offsets = torch.arange(self.side, device=uv.device)
        index = (starts[1][..., None] + offsets)[..., None] * width + (starts[0][..., None] + offsets)[..., None, :]
        channels = images.shape[1]
        pixels = images.flatten(2).gather(2, index.flatten(1)[:, None].expand(-1, channels, -1))
        self.windows = pixels.unflatten(2, index.shape[1:]).transpose(1, 2).contiguous().to(colours)  # (M, N, K, w, w)

    def fit(self, uv: Tensor, present: Tensor, steps: int) -> NearFit:
        """Take Gauss-Newton steps. The last one reuses the previous Hessian, because the dots hardly move by then.

        Args:
            uv: (M, N, 2) pixels to start from.
            present: (M, N) bool: dots that are in the image.
            steps: at least 1.
        """
        count = len(self.colours)
        for step in range(steps):
            pull, mean_square, render = self._compare(uv, present)
            if step == 0 or step < steps - 1:
                hessian = self._hessian(*render)
                diagonal = hessian.diagonal(dim1=1, dim2=2)
                factor, _ = torch.linalg.cholesky_ex(hessian + torch.diag_embed(DAMPING * diagonal + (diagonal == 0)))
            change = torch.cholesky_solve(pull[..., None], factor).squeeze(-1)
            uv = uv + change.unflatten(1, (2, count)).mT.clamp(-1, 1).to(uv)
        variance = torch.cholesky_inverse(factor).diagonal(dim1=1, dim2=2).unflatten(1, (2, count)).mean(1)
        return NearFit(uv, variance.to(uv), mean_square.to(uv))

    def _compare(self, uv: Tensor, present: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Render all dots in all windows.

        Returns:
            Minus the gradient (M, 2N), the mean squared residual (M, N), and for `_hessian` the profiles across and
            down (M, N windows, N dots, 2, w), value and slope, and the unsaturated pixels (M, N, K, w, w).
        """
        colours = self.colours
        # Subtract the window's origin before lowering the precision.
        centre = (uv[:, None] - self.start[:, :, None]).to(colours)  # (M, N windows, N dots, 2)
        both = torch.stack(profile_and_slope(centre, self.dot, self.side), -2)  # (M, N, N, 2 axes, 2, w)
        across, down = (both * present.to(colours)[:, None, :, None, None, None]).unbind(3)
        coloured = colours.mT[:, None] * down[..., 0, :].mT[:, :, None]  # (M, N, K, w, N)
        model = (coloured.flatten(2, 3) @ across[..., 0, :]).unflatten(2, (-1, self.side))
        free = (model < 1).to(model.dtype)
        residual = self.windows - model.clamp_max(1)
        own_across, own_down = self._own(across), self._own(down)
        rows = ((residual * free).flatten(2, 3) @ own_across.mT).unflatten(2, (-1, self.side))  # (M, N, K, w, 2)
        products = ((own_down[:, :, None] @ rows) * colours[..., None, None]).sum(2)  # (M, N, 2 down, 2 across)
        pull = torch.cat((products[..., 0, 1], products[..., 1, 0]), -1)
        return pull, residual.square().mean((2, 3, 4)), (across, down, free)

    def _hessian(self, across: Tensor, down: Tensor, free: Tensor) -> Tensor:
        """Gauss-Newton Hessian (M, 2N, 2N) from the windows: row n sums over the pixels of window n."""
        count = len(self.colours)
        along = self._own(across)[:, :, None, :, None] * across[:, :, :, None]  # (M, N, N, 2 own, 2 other, w)
        below = self._own(down)[:, :, None, :, None] * down[:, :, :, None]
        rows = free.flatten(2, 3) @ along.flatten(2, 4).mT  # (M, N, K w, 4N)
        rows = rows.unflatten(2, (-1, self.side)).unflatten(-1, (count, 4))
        # Slope across is paired with value down, and vice versa.
        columns = below.flatten(3, 4).flip(3).permute(0, 1, 4, 2, 3)[:, :, None]  # (M, N, 1, w, N, 4)
        pairs = self.colours[:, :, None] * self.colours.mT  # (N, K, N)
        blocks = ((rows * columns).sum(3) * pairs[..., None]).sum(2)  # (M, N, N, 4): vv, vu, uv, uu
        vv, vu, uv, uu = blocks.unbind(-1)
        hessian = _blocks(uu, uv, vu, vv)
        return 0.5 * (hessian + hessian.mT)

    def _own(self, profiles: Tensor) -> Tensor:
        """Select each window's own dot from the profiles of all dots in all windows: (M, N, 2, w)."""
        return profiles.diagonal(dim1=1, dim2=2).movedim(-1, 1)


def profile_and_slope(centre: Tensor, size: float, length: int) -> tuple[Tensor, Tensor]:
    """Integrate a Gaussian of peak 1 over neighbouring pixels, and differentiate the result by its centre.

    Args:
        centre: (...) pixels, relative to the centre of the first pixel.
        size: standard deviation, pixels.
        length: number of pixels.

    Returns:
        Values and derivatives, each (..., length).
    """
    edges = torch.arange(length + 1, dtype=centre.dtype, device=centre.device) - 0.5 - centre[..., None]
    scaled = edges * (1 / (math.sqrt(2) * size))
    value = (math.sqrt(math.pi / 2) * size) * torch.erf(scaled).diff(dim=-1)
    # Exactly zero far away: denormal numbers would make everything that follows several times slower.
    return value, -torch.exp(-scaled.square().clamp_max(FARTHEST)).diff(dim=-1)


def _blocks(uu: Tensor, uv: Tensor, vu: Tensor, vv: Tensor) -> Tensor:
    """Assemble blocks (M, N, N) into (M, 2N, 2N), all u first."""
    return torch.cat((torch.cat((uu, uv), 2), torch.cat((vu, vv), 2)), 1)

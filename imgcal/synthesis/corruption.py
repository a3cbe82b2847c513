"""What goes wrong in real views: noise, missing fiducials, exchanged labels, false blobs."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from imgcal.io import StrictRecord
from imgcal.types import Views

SWAPPED, FALSE = 1, 2

Noise = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True)
class Corruption(StrictRecord):
    """Amounts of corruption. Shares are of fiducials in one camera's view, drawn independently.

    It is also the block `corruption` of an experiment file.
    """

    noise: Noise = 0.0  # pixels, one standard deviation of each axis, Gaussian
    missing: Share = 0.0  # share that is not seen
    swapped: Share = 0.0  # share of the seen whose label is exchanged with that of another one in the same camera
    false: Share = 0.0  # share of the seen that is found somewhere else in the image, anywhere

    @property
    def nothing(self) -> bool:
        """Tell whether views stay unchanged."""
        return not any(getattr(self, field.name) for field in fields(self))

    @torch.no_grad()
    def apply(self, views: Views, image_size: Tensor, generator: torch.Generator) -> Corrupted:
        """Corrupt views of labelled points.

        The number of random draws does not depend on the values, so that of two corruptions from equal generators the
        larger one hits the same fiducials and more.

        Args:
            views: uv (B, C, N, 2) and seen (B, C, N); images, if any, are dropped: they are drawn from the result.
            image_size: (C, 2) pixels, width and height.
            generator: on the device of the views.
        """
        if views.uv is None or views.seen is None:
            raise ValueError("views hold no points")
        uv, seen = views.uv, views.seen
        draws = torch.rand((6, *seen.shape), generator=generator, dtype=uv.dtype, device=uv.device)
        noise = torch.randn(uv.shape, generator=generator, dtype=uv.dtype, device=uv.device)
        if self.nothing:
            return Corrupted(Views(uv=_hide(uv, seen), seen=seen), seen, torch.zeros_like(seen, dtype=torch.uint8))
        uv = uv + self.noise * noise
        seen = seen & (draws[0] >= self.missing)
        source = _exchange(seen, self.swapped, draws[1], draws[2])
        own = torch.arange(seen.shape[-1], device=uv.device)
        uv = uv.gather(-2, source[..., None].expand(uv.shape))
        false = seen & (draws[3] < self.false)
        anywhere = draws[4:].movedim(0, -1)
        uv = torch.where(false[..., None], anywhere * image_size.to(uv)[:, None] - 0.5, uv)
        fault = (source != own).to(torch.uint8) * SWAPPED
        fault = torch.where(false, FALSE, fault)
        return Corrupted(Views(uv=_hide(uv, seen), seen=seen), seen & (fault == 0), fault)


@dataclass(frozen=True)
class Corrupted:
    """Corrupted views, and which of their labels are true."""

    views: Views  # (B,)
    inlier: Tensor  # (B, C, N) bool: seen, and neither swapped nor false
    fault: Tensor  # (B, C, N) uint8: 0, SWAPPED or FALSE; means nothing where not seen


def _hide(uv: Tensor, seen: Tensor) -> Tensor:
    """Remove the positions of unseen fiducials, so that nothing can learn from them."""
    return torch.where(seen[..., None], uv, 0.0)


def _exchange(seen: Tensor, share: float, order: Tensor, chance: Tensor) -> Tensor:
    """For each fiducial (*B, N) the one whose place it takes: itself, or its partner in a random pair of seen ones.

    A pair is exchanged with the probability that makes `share` of the seen ones exchanged on average; of an odd number
    one has no partner.
    """
    count = seen.sum(-1, keepdim=True)
    paired = 2 * (count // 2)
    probability = (share * count / paired.clamp_min(2)).clamp_max(1)
    drawn = torch.where(seen, order, 2.0).argsort(-1)  # the seen first, in random order
    pairs = seen.shape[-1] // 2
    first, second = drawn[..., 0 : 2 * pairs : 2], drawn[..., 1 : 2 * pairs : 2]
    complete = 2 * torch.arange(pairs, device=seen.device) < paired
    exchange = complete & (chance[..., :pairs] < probability)
    source = torch.arange(seen.shape[-1], device=seen.device).expand(seen.shape).clone()
    source.scatter_(-1, first, torch.where(exchange, second, first))
    return source.scatter_(-1, second, torch.where(exchange, first, second))

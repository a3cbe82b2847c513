"""Exchanged labels in colour-coded images: dots whose colour is that of another fiducial."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.refinement.graduated_non_convexity import mutual_nearest
from imgcal.refinement.photometric import profile_and_slope

RIDGE = 0.05  # relative to a dot's own weight: dots at the same place share the light there
MOST_DIFFERENCE = 0.3  # largest RGB distance between the colours of a dot and of a fiducial


def colours_at(images: Tensor, uv: Tensor, dot: float) -> Tensor:
    """Solve for the colours of dots at given places that reproduce an image, by linear least squares.

    Args:
        images: (M, K, H, W), square.
        uv: (M, N, 2) pixels, finite.
        dot: standard deviation of a dot, pixels.

    Returns:
        (M, N, K), about 0 where the image has no dot.
    """
    size = images.shape[-1]
    value, _ = profile_and_slope(uv.mT, dot, size)  # (M, 2 axes, N, size)
    value = value.to(torch.float32)
    overlap = (value @ value.mT).prod(1)  # (M, N, N)
    across, down = value.unbind(1)  # (M, N, size)
    seen = torch.einsum("mkhn,mnh->mnk", images.float() @ across.mT[:, None], down)
    weight = overlap.diagonal(dim1=1, dim2=2)
    return torch.linalg.solve(overlap + torch.diag_embed(RIDGE * weight + (weight == 0)), (1 + RIDGE) * seen)


def find_swapped_labels(found: Tensor, colours: Tensor, fits: Tensor) -> Tensor:
    """Find the fiducial whose colour appears at each fiducial's place.

    Args:
        found: (*B, N, K) colours at the places.
        colours: (N, K) of the fiducials.
        fits: (*B, N) bool: places that are known to have their own colour; that colour is not assigned elsewhere.

    Returns:
        (*B, N) indices of fiducials, each at most once; -1 where no fiducial matches.
    """
    own = torch.arange(len(colours), device=found.device)
    difference = (found.unsqueeze(-2) - colours.to(found)).norm(dim=-1)  # (*B, N places, N colours)
    difference = difference.masked_fill(fits.unsqueeze(-1) | fits.unsqueeze(-2), torch.inf)
    nearest, colour, mutual = mutual_nearest(difference)
    named = torch.where(mutual & (nearest < MOST_DIFFERENCE), colour, -1)
    return torch.where(fits, own, named)

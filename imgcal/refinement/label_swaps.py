"""Exchanged labels in colour-coded images: which colour a dot has that should be another one."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.refinement.graduated_non_convexity import mutual_nearest
from imgcal.refinement.photometric import profile_and_slope

RIDGE = 0.05  # of a dot's own weight: dots in the same place share what is there
MOST_DIFFERENCE = 0.3  # between a dot's colour and that of a fiducial, as a distance in RGB


def colours_at(images: Tensor, uv: Tensor, dot: float) -> Tensor:
    """Tell what colours dots at given places must have to make an image, by linear least squares.

    Args:
        images: (M, K, H, W), square.
        uv: (M, N, 2) pixels, finite.
        dot: standard deviation of a dot, pixels.

    Returns:
        (M, N, K), about 0 where there is no dot.
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
    """Name the fiducial whose colour is at each fiducial's place.

    Args:
        found: (*B, N, K) colours at the places.
        colours: (N, K) of the fiducials.
        fits: (*B, N) bool: places whose own colour is known to be there; no other place can have it.

    Returns:
        (*B, N) numbers of fiducials, each at most once; -1 where there is none.
    """
    own = torch.arange(len(colours), device=found.device)
    difference = (found.unsqueeze(-2) - colours.to(found)).norm(dim=-1)  # (*B, N places, N colours)
    difference = difference.masked_fill(fits.unsqueeze(-1) | fits.unsqueeze(-2), torch.inf)
    nearest, colour, mutual = mutual_nearest(difference)
    named = torch.where(mutual & (nearest < MOST_DIFFERENCE), colour, -1)
    return torch.where(fits, own, named)

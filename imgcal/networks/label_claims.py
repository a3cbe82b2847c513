"""Label claims from evidence: at most one place per fiducial, and at most one fiducial per place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from imgcal.networks.infrared import Evidence
from imgcal.networks.transport import partial_transport

PEAKS = 3  # most candidate places per fiducial ...
LEAST_MASS = 0.02  # ... and the smallest probability of each
SAME = 1.5  # crop pixels within which two places are the same
TOLERANCE = 0.6  # crop pixels, standard deviation between two fiducials' positions for one place
STRAY = -3.0  # log odds that a place belongs to no fiducial


@dataclass(frozen=True)
class Claims:
    """The claimed place of each fiducial."""

    place: Tensor  # (P, N, 2) crop pixels
    sigma: Tensor  # (P, N) crop pixels, standard deviation per axis
    probability: Tensor  # (P, N) that the fiducial is there; 0 for invalid queries


def claim(evidence: Evidence, asked: Tensor) -> Claims:
    """Assign the candidate places of each crop to its fiducials.

    Args:
        evidence: of (P, N) queries.
        asked: (P, N) bool, the valid queries.
    """
    mass = _local_mass(evidence)
    logit, place, log_sigma = _peaks(evidence, mass, asked)
    kept = _distinct(place, logit)
    step = evidence.cells[0, 0, 0, 1, 0] - evidence.cells[0, 0, 0, 0, 0]
    # Evaluate every fiducial's evidence at every place: (P, N, M).
    along = (place[:, None] - evidence.cells[:, :, None, 0, 0]) / step
    size = mass.shape[-1]
    inside = ((along > -0.5) & (along < size - 0.5)).all(-1)
    column, row = along.round().clamp(0, size - 1).long().unbind(-1)
    index = row * size + column
    own = (evidence.cells + evidence.offset).flatten(2, 3).gather(2, index[..., None].expand(*index.shape, 2))
    # Another fiducial's place counts less the farther it is from this fiducial's own position there.
    beside = (own - place[:, None]).square().sum(-1) / (2 * TOLERANCE**2)
    said = mass.flatten(2).gather(2, index) - beside
    present = functional.logsigmoid(evidence.present)[..., None]
    usable = inside & kept[:, None] & asked[..., None]
    scores = (said + present).masked_fill(~usable, -torch.inf)
    absent = functional.logsigmoid(-evidence.present)
    stray = torch.full_like(logit, STRAY).masked_fill(~kept, -torch.inf)
    shares = partial_transport(scores, absent, stray).exp()[..., :-1]
    # With two confident rivals, transport converges slowly: normalize shares that still exceed one.
    shares = shares / shares.sum(1, keepdim=True).clamp(min=1)
    share, best = shares.max(-1)
    chosen = place.gather(1, best[..., None].expand(*best.shape, 2))
    return Claims(chosen, log_sigma.gather(1, best).exp(), share * asked)


def _local_mass(evidence: Evidence) -> Tensor:
    """Log probability of each cell and its neighbours, given that the fiducial is visible: (P, N, K, K)."""
    shape = evidence.logits.shape
    probability = evidence.logits.flatten(2).softmax(-1).unflatten(2, shape[2:])
    pooled = functional.avg_pool2d(probability, 3, stride=1, padding=1) * 9
    return pooled.clamp(1e-12, 1.0).log()


def _peaks(evidence: Evidence, mass: Tensor, asked: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Best local maxima of all windows, concatenated: log odds (P, M), place (P, M, 2), log sigma (P, M)."""
    # The radius is large enough that no two peaks share the mass of their neighbours.
    highest = functional.max_pool2d(evidence.logits, 5, stride=1, padding=2) == evidence.logits
    highest &= mass > math.log(LEAST_MASS)
    value, index = mass.masked_fill(~highest, -torch.inf).flatten(2).topk(PEAKS, dim=-1)
    places = (evidence.cells + evidence.offset).flatten(2, 3)
    place = places.gather(2, index[..., None].expand(*index.shape, 2))
    log_sigma = evidence.log_sigma.flatten(2).gather(2, index)
    value = (value + functional.logsigmoid(evidence.present)[..., None]).masked_fill(~asked[..., None], -torch.inf)
    return value.flatten(1), place.flatten(1, 2), log_sigma.flatten(1)


def _distinct(place: Tensor, value: Tensor) -> Tensor:
    """Non-maximum suppression of places (P, M, 2) by value (P, M): (P, M) bool, True for those to keep."""
    order = torch.arange(value.shape[1], device=value.device)
    near = (place[:, :, None] - place[:, None]).square().sum(-1) < SAME**2
    equal = value[:, None] == value[:, :, None]
    better = (value[:, None] > value[:, :, None]) | (equal & (order[None, None] < order[None, :, None]))
    return ~(near & better).any(-1) & value.isfinite()

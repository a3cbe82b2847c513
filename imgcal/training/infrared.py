"""Losses of the query network: the correct cell, the offset in it, its standard deviation, and visibility."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from imgcal.networks import Evidence, Queries
from imgcal.synthesis import CropTruth

NEIGHBOUR = 2.5  # crop pixels, each axis: cells this near learn the offset


@dataclass(frozen=True)
class QueryLosses:
    """Parts of the loss, each a mean over the valid entries: ()."""

    cell: Tensor  # cross-entropy over the cells of a window, nats
    offset: Tensor  # crop pixels, absolute error per axis
    likelihood: Tensor  # negative log likelihood of the offset, per axis, with the predicted sigma
    presence: Tensor  # binary cross-entropy of `present`: visible, and in its window

    @property
    def total(self) -> Tensor:
        """The weighted sum to minimize."""
        return self.cell + 0.5 * self.offset + 0.3 * self.likelihood + 0.5 * self.presence


def make_queries(truth: CropTruth) -> Queries:
    """Build queries for all fiducials of rendered crops: (P, N), P = B C; the ones outside the crop are invalid."""
    inside = ((truth.expected > -0.5) & (truth.expected < truth.placement.size - 0.5)).all(-1) & truth.radius.isfinite()
    asked = inside & (truth.radius > 0)
    parts = (truth.expected, truth.radius, truth.depth, asked)
    return Queries(*(part.flatten(0, 1) for part in parts))


def query_losses(evidence: Evidence, asked: Tensor, place: Tensor, seen: Tensor) -> QueryLosses:
    """Compare evidence with the true marker positions.

    Args:
        evidence: of (P, N) queries.
        asked: (P, N) bool, the valid queries.
        place: (P, N, 2) crop pixels, the truth.
        seen: (P, N) bool: the marker is visible.
    """
    shape = evidence.logits.shape
    step = evidence.cells[0, 0, 0, 1, 0] - evidence.cells[0, 0, 0, 0, 0]
    along = (place - evidence.cells[:, :, 0, 0]) / step  # cells from the first one's centre
    inside = ((along > -0.5) & (along < shape[-1] - 0.5)).all(-1)
    good = (asked & seen & inside).to(evidence.logits.dtype)
    column, row = along.round().clamp(0, shape[-1] - 1).long().unbind(-1)
    index = row * shape[-1] + column

    def at(values: Tensor) -> Tensor:
        return values.flatten(2).gather(2, index[..., None])[..., 0]

    def mean(values: Tensor) -> Tensor:
        return (torch.where(good > 0, values, 0.0)).sum() / good.sum().clamp(min=1)

    cell = mean(-at(evidence.logits.flatten(2).log_softmax(-1)))
    # Neighbours of the correct cell must learn the offset, too, because one of them may be chosen.
    apart = place[:, :, None, None] - evidence.cells
    near = ((apart.abs() < NEIGHBOUR).all(-1) & (good > 0)[..., None, None]).to(apart.dtype)
    error = (evidence.offset - apart).abs()
    count = near.sum().clamp(min=1)
    offset = (error.mean(-1) * near).sum() / count
    squared, log_sigma = error.detach().square().mean(-1), evidence.log_sigma
    likelihood = ((squared / 2 * (-2 * log_sigma).exp() + log_sigma) * near).sum() / count
    target = (seen & inside).to(evidence.present.dtype)
    presence = functional.binary_cross_entropy_with_logits(evidence.present, target, reduction="none")
    presence = (presence * asked).sum() / asked.sum().clamp(min=1)
    return QueryLosses(cell, offset, likelihood, presence)


def evidence_at_best(evidence: Evidence) -> tuple[Tensor, Tensor, Tensor]:
    """Most probable position of each fiducial: place (P, N, 2) crop pixels, sigma (P, N), and probability (P, N)."""
    flat = evidence.logits.flatten(2)
    probability, best = flat.softmax(-1).max(-1)
    places = (evidence.cells + evidence.offset).flatten(2, 3)
    place = places.gather(2, best[..., None, None].expand(*best.shape, 1, 2))[:, :, 0]
    log_sigma = evidence.log_sigma.flatten(2).gather(2, best[..., None])[..., 0]
    return place, log_sigma.exp(), probability * evidence.present.sigmoid()

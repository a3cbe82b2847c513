"""One pass of a query network over a snapshot's frames, and the conclusions from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from imgcal.geometry import RigidTransform
from imgcal.networks import Claims, Evidence, Tiles
from imgcal.types import CameraRig

CHANCE = 0.05  # probability that the network mistakes a window


@dataclass(frozen=True)
class NetworkPass:
    """Result of one pass: H poses, C cameras, T tiles of up to n fiducials."""

    rig: CameraRig  # rig of the predictions
    poses: RigidTransform  # (H,)
    tiles: Tiles
    evidence: Evidence  # (H T, n)
    claims: Claims  # (H T, n)
    asked: Tensor  # (H, T, n) bool

    @cached_property
    def found(self) -> Tensor:
        """Expected number of visible fiducials at each pose: (H,)."""
        return (self.claims.probability.view(self.asked.shape) * self.tiles.counts).sum((1, 2))

    @cached_property
    def count(self) -> int:
        """Number of fiducials in view at the first pose."""
        return int((self.asked[0] & self.tiles.counts).sum())

    @cached_property
    def joint(self) -> Tensor:
        """Log odds, by cell, of displacements shared by all fiducials of a camera, at one pose: (C, K, K)."""
        logits, asked = self.evidence.logits, self.asked.flatten(0, 1)
        size = logits.shape[-1]
        probability = functional.avg_pool2d(logits.flatten(2).softmax(-1).unflatten(2, (size, size)), 3, 1, 1) * 9
        present = self.evidence.present.sigmoid()[..., None, None] * (1 - CHANCE)
        even = 9 / size**2
        odds = (present * probability.clamp(max=1) / even + 1 - present).log()
        return self.tiles.sum_by_camera(odds * asked[..., None, None], self.rig.num_cameras)

    @cached_property
    def margin(self) -> float:
        """Log odds of zero displacement at the first pose against the best other displacement, over the cameras."""
        joint = self.joint.clone()
        size = joint.shape[-1]
        middle = slice(size // 2 - 3, size // 2 + 3)
        here = joint[:, middle, middle].amax((1, 2))
        joint[:, middle, middle] = -torch.inf
        return float((here - joint.amax((1, 2)).clamp(min=0)).sum())

    def displacements(self, most: int) -> Tensor:
        """Most probable displacements of each camera, local maxima: (most, C, 2) crop pixels."""
        highest = functional.max_pool2d(self.joint, 5, stride=1, padding=2) == self.joint
        best = self.joint.masked_fill(~highest, -torch.inf).flatten(1).topk(most).indices.T
        cells = self.evidence.cells[0, 0].flatten(0, 1)
        return (cells - cells.mean(0))[best]

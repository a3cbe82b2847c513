"""One look of a query network at the frames of a snapshot, and what can be read off it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from imgcal.geometry import RigidTransform
from imgcal.networks import Claims, Evidence, Tiles
from imgcal.types import CameraRig

CHANCE = 0.05  # probability that a window is not what the network takes it for


@dataclass(frozen=True)
class NetworkPass:
    """What one look says: H poses, C cameras, T tiles of up to n fiducials."""

    rig: CameraRig  # that was looked with
    poses: RigidTransform  # (H,)
    tiles: Tiles
    evidence: Evidence  # (H T, n)
    claims: Claims  # (H T, n)
    asked: Tensor  # (H, T, n) bool

    @cached_property
    def found(self) -> Tensor:
        """How many fiducials each pose shows, expected: (H,)."""
        return (self.claims.probability.view(self.asked.shape) * self.tiles.counts).sum((1, 2))

    @cached_property
    def found_in_camera(self) -> Tensor:
        """How many fiducials the only pose shows in each camera, expected: (C,)."""
        return self.tiles.sum_by_camera(self.claims.probability, self.rig.num_cameras)

    @cached_property
    def count(self) -> int:
        """How many fiducials the first pose puts in view."""
        return int((self.asked[0] & self.tiles.counts).sum())

    @cached_property
    def joint(self) -> Tensor:
        """Log odds of the displacements that all fiducials of a camera may share, by cell: (C, K, K), of one pose."""
        logits, asked = self.evidence.logits, self.asked.flatten(0, 1)
        size = logits.shape[-1]
        probability = functional.avg_pool2d(logits.flatten(2).softmax(-1).unflatten(2, (size, size)), 3, 1, 1) * 9
        present = self.evidence.present.sigmoid()[..., None, None] * (1 - CHANCE)
        even = 9 / size**2
        odds = (present * probability.clamp(max=1) / even + 1 - present).log()
        return self.tiles.sum_by_camera(odds * asked[..., None, None], self.rig.num_cameras)

    @cached_property
    def margin(self) -> float:
        """Log odds of the first pose's displacements being none against the best other one, camera by camera."""
        joint = self.joint.clone()
        size = joint.shape[-1]
        middle = slice(size // 2 - 3, size // 2 + 3)
        here = joint[:, middle, middle].amax((1, 2))
        joint[:, middle, middle] = -torch.inf
        return float((here - joint.amax((1, 2)).clamp(min=0)).sum())

    def displacements(self, most: int) -> Tensor:
        """The likeliest displacements of each camera, local maxima: (most, C, 2) crop pixels."""
        highest = functional.max_pool2d(self.joint, 5, stride=1, padding=2) == self.joint
        best = self.joint.masked_fill(~highest, -torch.inf).flatten(1).topk(most).indices.T
        cells = self.evidence.cells[0, 0].flatten(0, 1)
        return (cells - cells.mean(0))[best]

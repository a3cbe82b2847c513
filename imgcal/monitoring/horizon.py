"""A filter that uses the last N snapshots only: what remains known about a rig when a snapshot is forgotten.

What remains is the factory calibration and the information of those snapshots. A camera that none of them shows keeps
its last values, relative to the cameras that it was last seen with, with the uncertainty they had then.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imgcal.estimation import displace, error_between
from imgcal.monitoring.rig_belief import RigBelief, cholesky_factor
from imgcal.types import EXTRINSICS


@dataclass(frozen=True)
class LastSighting:
    """What was known about a camera when the last snapshot that shows it was forgotten."""

    others: tuple[int, ...]  # cameras that its values are relative to
    value: Tensor  # (K,) rad, mm, pixels, 1: its error in the prior's chart minus the others' mean error
    information: Tensor  # (K, K) of that value


@dataclass(frozen=True)
class Remainder:
    """What is known without the snapshots that are forgotten or will be absorbed again."""

    first: RigBelief
    away: dict[int, LastSighting]  # cameras that no remaining snapshot shows


@dataclass
class Horizon:
    """How many snapshots count, and what is known without them.

    Examples:
        >>> import imgcal
        >>> prior = RigBelief.of_prior(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"))
        >>> Horizon(1, prior).most, Horizon(3, prior).most, Horizon(80, prior).most
        (1, 4, 101)
    """

    snapshots: int
    prior: RigBelief  # the factory calibration; cameras that have moved since are unconstrained
    away: dict[int, LastSighting] = field(default_factory=dict)

    @property
    def most(self) -> int:
        """Maximum number of snapshots to keep; several are forgotten together because forgetting is slow."""
        return 1 if self.snapshots == 1 else self.snapshots + 1 + self.snapshots // 4

    def free(self, prior: RigBelief, cameras: Collection[int]) -> None:
        """Set a prior in which some cameras have moved, and drop their last values."""
        self.prior = prior
        self.away = {camera: last for camera, last in self.away.items() if camera not in cameras}

    def remove(self, belief: RigBelief, forgotten: Tensor, kept: Tensor, first: RigBelief) -> Remainder:
        """Compute what is known without the snapshots.

        Args:
            belief: with all snapshots.
            forgotten: (C,) bool, cameras shown by the snapshots that are forgotten now.
            kept: (C,) bool, cameras shown by the other snapshots.
            first: the belief before all snapshots; its object is used, because the object is not forgotten.
        """
        present = set(kept.nonzero().flatten().tolist())
        away = {camera: last for camera, last in self.away.items() if camera not in present}
        for camera in (forgotten & ~kept).nonzero().flatten().tolist():
            away[camera] = self._last_sighting(belief, camera, tuple(sorted(present)))
        return Remainder(self._add_object(self._add_absent_cameras(away), first), away)

    def _last_sighting(self, belief: RigBelief, camera: int, others: tuple[int, ...]) -> LastSighting:
        relative, wide = self._relative(camera, others), self.prior.unit.numel()
        error = (error_between(belief.rig, self.prior.rig) / self.prior.unit).flatten()
        covariance = torch.cholesky_inverse(belief.factor)[:wide, :wide]
        spread = cholesky_factor(relative @ covariance @ relative.mT)
        return LastSighting(others, relative @ error, torch.cholesky_inverse(spread))

    def _relative(self, camera: int, others: tuple[int, ...]) -> Tensor:
        """Derivative (K, K C) of a camera's values relative to others, by all errors in units."""
        unit = self.prior.unit
        relative = torch.zeros(unit.shape[1], *unit.shape, dtype=unit.dtype)
        relative[:, camera] = unit[camera].diag()
        for other in others:
            relative[:EXTRINSICS, other, :EXTRINSICS] = -unit[other, :EXTRINSICS].diag() / len(others)
        return relative.flatten(1)

    def _add_absent_cameras(self, away: dict[int, LastSighting]) -> RigBelief:
        """The prior, with absent cameras as they were last seen."""
        prior, width = self.prior, self.prior.unit.shape[1]
        if not away:
            return prior
        information, wide = prior.information.clone(), prior.unit.numel()
        weighted = prior.object_offset.new_zeros(len(information))
        for camera in away:  # their last values include the prior already
            own = slice(camera * width, (camera + 1) * width)
            information[own], information[:, own] = 0.0, 0.0
        for camera, last in away.items():
            relative = self._relative(camera, last.others)
            information[:wide, :wide] += relative.mT @ last.information @ relative
            weighted[:wide] += relative.mT @ last.information @ last.value
        factor = cholesky_factor(information)
        error = torch.cholesky_solve(weighted[:, None], factor)[:wide, 0].view(prior.unit.shape)
        return replace(prior, rig=displace(prior.rig, error * prior.unit), factor=factor)

    def _add_object(self, cameras: RigBelief, first: RigBelief) -> RigBelief:
        """Combine the cameras of one belief with the object of another."""
        wide = self.prior.unit.numel()
        if len(first.factor) == wide:
            return cameras
        information = torch.zeros_like(first.factor)
        information[:wide, :wide] = cameras.information[:wide, :wide]
        covariance = torch.cholesky_inverse(first.factor)[wide:, wide:]
        information[wide:, wide:] = torch.cholesky_inverse(cholesky_factor(covariance))
        return replace(cameras, obj=first.obj, object_offset=first.object_offset, factor=cholesky_factor(information))

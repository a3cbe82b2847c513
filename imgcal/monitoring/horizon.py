"""A filter that knows the last N snapshots and nothing older: what is left of a rig when a snapshot is forgotten.

What is known is the factory calibration and the information of those snapshots. A camera that none of them shows keeps
its last values against the cameras it was last seen with, as surely as they were known then.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imgcal.estimation import displace, error_between
from imgcal.monitoring.rig_belief import RigBelief, cholesky_factor

EXTRINSICS = 6


@dataclass(frozen=True)
class LastSighting:
    """What was known of a camera when the last snapshot that shows it was forgotten."""

    others: tuple[int, ...]  # cameras that it is placed against
    value: Tensor  # (K,) rad, mm, pixels, 1: its error in the chart of the prior, less the mean error of the others
    information: Tensor  # (K, K) of that value


@dataclass(frozen=True)
class Remainder:
    """What is known without snapshots that are forgotten, or learnt again."""

    first: RigBelief
    away: dict[int, LastSighting]  # cameras that no snapshot shows any more


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
    prior: RigBelief  # the factory calibration; cameras that have moved since may be anywhere
    away: dict[int, LastSighting] = field(default_factory=dict)

    @property
    def most(self) -> int:
        """Snapshots that are kept at most: forgetting costs time, so that several are forgotten at once."""
        return 1 if self.snapshots == 1 else self.snapshots + 1 + self.snapshots // 4

    def free(self, prior: RigBelief, cameras: Collection[int]) -> None:
        """Believe another prior, in which some cameras have moved: their last values hold no more."""
        self.prior = prior
        self.away = {camera: last for camera, last in self.away.items() if camera not in cameras}

    def without(self, belief: RigBelief, forgotten: Tensor, kept: Tensor, first: RigBelief) -> Remainder:
        """What is known without any snapshot.

        Args:
            belief: with all of them.
            forgotten: (C,) bool, cameras that the snapshots show which are forgotten now.
            kept: (C,) bool, those that the others show.
            first: what was known before all of them; of it the object counts, which has not been forgotten.
        """
        present = set(kept.nonzero().flatten().tolist())
        away = {camera: last for camera, last in self.away.items() if camera not in present}
        for camera in (forgotten & ~kept).nonzero().flatten().tolist():
            away[camera] = self._last_sighting(belief, camera, tuple(sorted(present)))
        return Remainder(self._with_object(self._with_away(away), first), away)

    def _last_sighting(self, belief: RigBelief, camera: int, others: tuple[int, ...]) -> LastSighting:
        relative, wide = self._relative(camera, others), self.prior.unit.numel()
        error = (error_between(belief.rig, self.prior.rig) / self.prior.unit).flatten()
        covariance = torch.cholesky_inverse(belief.factor)[:wide, :wide]
        spread = cholesky_factor(relative @ covariance @ relative.mT)
        return LastSighting(others, relative @ error, torch.cholesky_inverse(spread))

    def _relative(self, camera: int, others: tuple[int, ...]) -> Tensor:
        """Derivative (K, K C) of a camera's own values, placed against others, by all errors in units."""
        unit = self.prior.unit
        relative = torch.zeros(unit.shape[1], *unit.shape, dtype=unit.dtype)
        relative[:, camera] = unit[camera].diag()
        for other in others:
            relative[:EXTRINSICS, other, :EXTRINSICS] = -unit[other, :EXTRINSICS].diag() / len(others)
        return relative.flatten(1)

    def _with_away(self, away: dict[int, LastSighting]) -> RigBelief:
        """The prior, and cameras that are away as they were seen last."""
        prior, width = self.prior, self.prior.unit.shape[1]
        if not away:
            return prior
        information, wide = prior.information.clone(), prior.unit.numel()
        weighted = prior.object_offset.new_zeros(len(information))
        for camera in away:  # the prior has part in what was known of them
            own = slice(camera * width, (camera + 1) * width)
            information[own], information[:, own] = 0.0, 0.0
        for camera, last in away.items():
            relative = self._relative(camera, last.others)
            information[:wide, :wide] += relative.mT @ last.information @ relative
            weighted[:wide] += relative.mT @ last.information @ last.value
        factor = cholesky_factor(information)
        error = torch.cholesky_solve(weighted[:, None], factor)[:wide, 0].view(prior.unit.shape)
        return replace(prior, rig=displace(prior.rig, error * prior.unit), factor=factor)

    def _with_object(self, cameras: RigBelief, first: RigBelief) -> RigBelief:
        """What is known of cameras by one belief, and of the object by another."""
        wide = self.prior.unit.numel()
        if len(first.factor) == wide:
            return cameras
        information = torch.zeros_like(first.factor)
        information[:wide, :wide] = cameras.information[:wide, :wide]
        covariance = torch.cholesky_inverse(first.factor)[wide:, wide:]
        information[wide:, wide:] = torch.cholesky_inverse(cholesky_factor(covariance))
        return replace(cameras, obj=first.obj, object_offset=first.object_offset, factor=cholesky_factor(information))

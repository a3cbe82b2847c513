"""Snapshots that need an explanation (`Case`), and what an explanation makes of them (`Variant`, `Finding`)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.types import Observations, UnknownLights

EARLY_SNAPSHOTS, EARLY_SECONDS = 12, 1.0
"""Number of earlier snapshots, and seconds since the start. Below both, a moved camera cannot be told from a late one:
in so short a time an object moves steadily, so a move and a delay shift the image alike."""
OBJECT_MOTION = 5.0
"""Median shift of a moving object's blobs along an axis, in standard deviations of a blob."""

SHAPE = -1
"""Stands for a fiducial's number when all fiducials have moved."""

Snapshot = tuple[Observations, RigidTransform]
"""Observations (1, C, N), and the object's pose (1,)."""


@dataclass(frozen=True)
class ClockSlip:
    """A camera whose exposure time has shifted."""

    camera: int
    since: int  # number of the first snapshot, counted from 0, that shows the slip
    seconds: float  # delay of its exposures
    sigma: float  # one standard deviation of the delay
    odds: float  # log odds against the next best explanation


@dataclass(frozen=True)
class ObjectChange:
    """What happened to the object."""

    fiducial: int | None  # the one that moved; `SHAPE` = all; None = another scale: a different object
    since: int  # number of the first snapshot, counted from 0, that shows the change
    size: float  # mm that the fiducial moved (RMS over all), or the relative change of scale
    sigma: float  # one standard deviation of the size
    odds: float  # log odds against the next best explanation


@dataclass(frozen=True)
class Finding:
    """What follows from an explanation besides the belief about the rig."""

    slips: tuple[ClockSlip, ...] = ()
    unsynchronized: tuple[int, ...] = ()  # cameras excluded from learning for now
    shake: Tensor | None = None  # (C,) px, how much each camera shakes
    object_change: ObjectChange | None = None


@dataclass(frozen=True)
class Start:
    """The belief before some of a case's latest snapshots."""

    before: RigBelief
    snapshots: Sequence[Snapshot]
    log_prior: float = 0.0  # add this where they are more snapshots than the case covers


@dataclass(frozen=True)
class Case:
    """Snapshots that need an explanation."""

    before: RigBelief  # the belief before them
    snapshots: Sequence[Snapshot]  # explain the last `count`; earlier ones show how the object moves
    pauses: Sequence[float]  # s before each
    count: int
    options: EstimationOptions = EstimationOptions()
    cameras: tuple[int, ...] = ()  # suspects, the most likely first; empty = no particular camera
    uncertain: bool = False  # the poses of these cameras are hardly known
    quarantined: bool = False  # these cameras are excluded from learning since then
    lasting: Tensor | None = None  # (C,) px, standard deviation of persistent image shifts; None = there are none
    beginning: RigBelief | None = None  # the belief before all snapshots, if it is the factory's
    excluded: Mapping[str, str] = field(default_factory=dict)  # explanations not to weigh, and why

    @property
    def latest(self) -> Sequence[Snapshot]:
        """The snapshots that need an explanation."""
        return self.snapshots[-self.count :]

    @cached_property
    def starts(self) -> tuple[Start, ...]:
        """When the change may have happened: before the first of the latest snapshots, or before all snapshots."""
        since = Start(self.before, self.latest)
        if self.beginning is None or self.count >= len(self.snapshots):
            return (since,)
        try:
            earlier = absorb(self.beginning, *stack_snapshots(self.snapshots[: -self.count]), self.options)
        except RefusedError:  # nothing to compare with
            return (since,)
        return since, Start(self.beginning, self.snapshots, -earlier.evidence)

    @property
    def camera_sets(self) -> tuple[tuple[int, ...], ...]:
        """Return the most likely camera alone, and all suspected cameras.

        Raises:
            RefusedError: no camera is suspected.
        """
        if not self.cameras:
            raise RefusedError("no camera is suspected")
        return tuple(dict.fromkeys((self.cameras[:1], self.cameras)))

    def require_body(self) -> None:
        """Refuse a case that cannot be decided without an object of fixed shape.

        Raises:
            RefusedError: the points are lights.
        """
        if isinstance(self.before.obj, UnknownLights):
            raise RefusedError("lights have no fixed shape")

    @property
    def too_early(self) -> bool:
        """Tell whether too few snapshots of a moving object came before to tell a move from a late clock."""
        few = self.beginning is not None and len(self.snapshots) - self.count < EARLY_SNAPSHOTS
        return few and sum(self.pauses) < EARLY_SECONDS and self._object_moves

    @property
    def _object_moves(self) -> bool:
        """Tell whether blobs moved in the earlier snapshots."""
        seen = [(one.seen[0], one.uv[0], one.sigma[0]) for one, _ in self.snapshots[: -self.count]]
        if not seen:
            return True
        there, uv, sigma = (torch.stack(parts) for parts in zip(*seen, strict=True))  # (S, C, N), (S, C, N, 2)
        last = torch.where(there[..., None], uv, -torch.inf).amax(0)
        first = torch.where(there[..., None], uv, torch.inf).amin(0)
        went = (last - first).amax(-1)[there.sum(0) > 1]
        return not len(went) or bool(went.median() > OBJECT_MOTION * sigma[there].median())


@dataclass(frozen=True)
class Variant:
    """One form of an explanation: a belief, and the snapshots as they would have been under it."""

    before: RigBelief
    snapshots: Sequence[Snapshot]
    log_prior: float = 0.0  # of this variant where it stands for a range of values; see `Start`
    more: Callable[[MeasurementUpdate], float] | None = None  # log probability of data left out of `snapshots`
    find: Callable[[MeasurementUpdate], Finding] = lambda _: Finding()  # may refuse the explanation after all


@dataclass(frozen=True)
class Explained:
    """A case and an explanation of it: the most probable variant."""

    explanation: Explanation
    evidence: float  # log probability of the snapshots, averaged over all variants, times the prior probability
    before: RigBelief
    snapshots: list[Snapshot]  # under this explanation, with the estimated poses
    finding: Finding = Finding()

    @property
    def name(self) -> str:
        """Name of the explanation."""
        return self.explanation.name


class Explanation(ABC):
    """Something that may have happened."""

    name: ClassVar[str]
    log_prior: ClassVar[float] = 0.0
    """Prior log probability, up to a constant that all explanations share."""

    @abstractmethod
    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """List the forms of this explanation, all equally probable.

        Raises:
            RefusedError: the explanation does not apply to this case; a variant may raise it, too.
        """

    def premature(self, case: Case, found: Explained) -> str | None:
        """Say why the most probable explanation needs more snapshots before it is believed; None = it does not."""
        return None


def mean_evidence(evidences: Sequence[float], count: int) -> float:
    """Average the evidence over `count` equally probable variants; those that failed are not in `evidences`."""
    return float(torch.logsumexp(torch.tensor(evidences, dtype=torch.float64), 0)) - math.log(count)

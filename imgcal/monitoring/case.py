"""Snapshots that want an explanation (`Case`), and what an explanation says of them (`Variant`, `Finding`)."""

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
from imgcal.types import Observations

EARLY_SNAPSHOTS, EARLY_SECONDS = 12, 1.0
"""Snapshots before a change, and seconds since the beginning, below both of which a camera that has moved looks like a
late one: in so little time an object moves steadily, and both shift an image alike."""
OBJECT_MOTION = 5.0
"""Standard deviations of a blob by which the blobs of an object that moves go along an axis, in the median."""

SHAPE = -1
"""In place of a fiducial's number: all fiducials are elsewhere."""

Snapshot = tuple[Observations, RigidTransform]
"""Observations (1, C, N), and the object's pose (1,)."""


@dataclass(frozen=True)
class ClockSlip:
    """A camera that exposes at another time than before."""

    camera: int
    since: int  # number of the first snapshot, counted from 0, that saw it so
    seconds: float  # by which it exposes later
    sigma: float  # one standard deviation of it
    odds: float  # log odds against the next best explanation


@dataclass(frozen=True)
class ObjectChange:
    """What happened to the object."""

    fiducial: int | None  # the one that is elsewhere, `SHAPE` = all; None = another scale: it is another object
    since: int  # number of the first snapshot, counted from 0, that saw it so
    size: float  # mm that the fiducial went (RMS of all), or the relative change of scale
    sigma: float  # one standard deviation of it
    odds: float  # log odds against the next best explanation


@dataclass(frozen=True)
class Finding:
    """What follows from an explanation, besides what is believed of the rig."""

    slips: tuple[ClockSlip, ...] = ()
    unsynchronized: tuple[int, ...] = ()  # cameras of which nothing can be learnt yet
    shake: Tensor | None = None  # (C,) px, by which cameras shake
    object_change: ObjectChange | None = None


@dataclass(frozen=True)
class Start:
    """What was believed before some of a case's latest snapshots."""

    before: RigBelief
    snapshots: Sequence[Snapshot]
    log_prior: float = 0.0  # to be added where these are more than the case is about


@dataclass(frozen=True)
class Case:
    """Snapshots that want an explanation."""

    before: RigBelief  # what was believed before them
    snapshots: Sequence[Snapshot]  # the last `count` want an explanation; earlier ones say how the object moves
    pauses: Sequence[float]  # s before each
    count: int
    options: EstimationOptions = EstimationOptions()
    cameras: tuple[int, ...] = ()  # suspected, the surest first; none = no camera in particular
    uncertain: bool = False  # it is hardly known where these cameras are
    quarantined: bool = False  # nothing has been learnt of these cameras since
    lasting: Tensor | None = None  # (C,) px, one standard deviation of shifts of an image that last; None = none do
    beginning: RigBelief | None = None  # what was believed before all snapshots, where that is what the factory says
    excluded: Mapping[str, str] = field(default_factory=dict)  # explanations that need not be weighed, and why

    @property
    def latest(self) -> Sequence[Snapshot]:
        """The snapshots that want an explanation."""
        return self.snapshots[-self.count :]

    @cached_property
    def starts(self) -> tuple[Start, ...]:
        """Since when something may have been so: the first of the latest snapshots, or from the very beginning."""
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
        """The surest camera alone, and all that are suspected.

        Raises:
            RefusedError: no camera is suspected.
        """
        if not self.cameras:
            raise RefusedError("no camera is suspected")
        return tuple(dict.fromkeys((self.cameras[:1], self.cameras)))

    def require_body(self) -> None:
        """Refuse what only fiducials that keep their distances can tell.

        Raises:
            RefusedError: lights are seen.
        """
        if self.before.obj.unknown_markers:
            raise RefusedError("each light goes its own way")

    @property
    def too_early(self) -> bool:
        """Tell whether too little was seen before, of an object that moves, to tell a move from a late clock."""
        few = self.beginning is not None and len(self.snapshots) - self.count < EARLY_SNAPSHOTS
        return few and sum(self.pauses) < EARLY_SECONDS and self._object_moves

    @property
    def _object_moves(self) -> bool:
        """Tell whether blobs went elsewhere in the snapshots before."""
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
    """One way in which an explanation may hold: a belief, and the snapshots as they would have been."""

    before: RigBelief
    snapshots: Sequence[Snapshot]
    log_prior: float = 0.0  # of this variant, where it stands for a range of values; see `Start`
    more: Callable[[MeasurementUpdate], float] | None = None  # log probability of what these snapshots leave out
    find: Callable[[MeasurementUpdate], Finding] = lambda _: Finding()  # may refuse: it is not what it seems


@dataclass(frozen=True)
class Explained:
    """A case as an explanation has it: its most probable variant."""

    explanation: Explanation
    evidence: float  # log probability of the snapshots, averaged over all variants, times the prior probability
    before: RigBelief
    snapshots: list[Snapshot]  # as they would have been, with the poses that were found
    finding: Finding = Finding()

    @property
    def name(self) -> str:
        """Of the explanation."""
        return self.explanation.name


class Explanation(ABC):
    """Something that may have happened."""

    name: ClassVar[str]
    log_prior: ClassVar[float] = 0.0
    """Log probability before anything is seen, up to what is the same for all."""

    @abstractmethod
    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """List the ways in which it may hold, each as probable as the others.

        Raises:
            RefusedError: it does not apply to this case; a variant may raise it, too.
        """

    def premature(self, case: Case, found: Explained) -> str | None:
        """Say why more snapshots are needed before it is believed, though it is most probable; None = they are not."""
        return None


def mean_evidence(evidences: Sequence[float], count: int) -> float:
    """Log probability of snapshots, averaged over `count` variants as probable as each other; others failed."""
    return float(torch.logsumexp(torch.tensor(evidences, dtype=torch.float64), 0)) - math.log(count)

"""Cameras that have changed in a still unknown way; later snapshots decide the kind of change."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imgcal.estimation import MOUNT_JOINT, displace, error_between
from imgcal.monitoring.case import Snapshot, mean_evidence
from imgcal.monitoring.change_test import (
    CHANGES,
    FORMS_OF,
    JUMPS,
    LARGE,
    MOTION_KINDS,
    TURNS,
    ChangeTest,
    Comparison,
    camera_change_errors,
    change_std,
    pixel_changes,
)
from imgcal.monitoring.far_turns import have_turned_far, place_cameras, resect_cameras
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief, age_belief, widen
from imgcal.monitoring.rig_filter import YOUNG_SECONDS
from imgcal.types import CameraRig

# Log odds at which the kind of a change is believed.
KIND_LEAD = 5.0
"""One kind against every other; ..."""
SINGLE_KIND_LEAD, ALL_KINDS_LEAD = 3.0, 15.0
"""... against a change of all kinds together, and the latter against each kind: a wrong belief does no harm then."""
MAIN_KIND_SHARE = 0.99
"""A change of all kinds together is reported as its main kind if that one has this share of the log odds: the rest
shifts the image by a tenth of it at most."""
LENS_KINDS, LENS_LOG_PRIOR = ("focal_length", "principal_point"), -3.0
"""Changes of the lens alone, and their prior log odds against a rotation or a shift: bumps hit the camera."""
LENS_REST = 2.0
"""A change of the lens alone is the main kind only if it leaves this many times less unexplained than other kinds."""
CERTAIN_SIGMAS = 5.0
"""Least size, in standard deviations, of a motion that is reported, and of another kind of motion beside it."""
DECIDE_AFTER = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
"""Numbers of snapshots since a change at which its kind is decided if possible."""


@dataclass(frozen=True)
class Change:
    """What happened to a camera."""

    camera: int
    since: int  # number of the first snapshot, counted from 0, taken from its new pose
    kind: str  # of `CHANGES`; "unknown" = undecided, or more than one kind
    size: float  # rad, mm or pixels; nan if the kind is unknown
    sigma: float  # one standard deviation of the size
    decided: bool = False  # this report is final
    evidence: float = math.nan  # chi-squared for "it stood still"; nan = not tested
    also: tuple[tuple[str, float, float], ...] = field(default=(), metadata={"saved": False})
    """Other kinds of motion that are certain, with size and standard deviation; only where the kind is decided."""


@dataclass
class PendingChange:
    """The belief before some cameras changed, and the information since, in one chart."""

    before: RigBelief
    origin: RigBelief  # of the chart: rig and object at the last linearization of the later snapshots
    brought: Tensor  # (D, D)
    weighted: Tensor  # (D,) gradient at the origin
    count: int  # snapshots
    seconds: float
    kinds: dict[int, str | None]  # by camera that changed; None = undecided
    most: int = DECIDE_AFTER[-1]  # decide the kinds after this many snapshots

    @property
    def overdue(self) -> bool:
        """Tell whether waiting for more snapshots is pointless."""
        return self.count >= self.most or self.seconds > YOUNG_SECONDS

    def distance(self, belief: RigBelief) -> Tensor:
        """Error (D,) of an earlier belief in this chart.

        Cameras that changed are compared by their own parameters, so that a large change of one kind does not leak into
        others.
        """
        at = _distance(belief.rig, belief.object_offset, self.origin)
        change, step = camera_change_errors(belief.rig, belief.unit), self.origin.rig.local(belief.rig)
        width = belief.rig.num_parameters
        for camera in self.kinds:
            at[camera * width : (camera + 1) * width] = -(change[camera] @ step[camera])
        return at

    @classmethod
    def of(
        cls, result: MeasurementUpdate, before: RigBelief, seconds: float, kinds: dict[int, str | None]
    ) -> PendingChange:
        """Start with the first snapshots after the change, absorbed together."""
        brought = result.brought
        origin = replace(result.belief, rig=brought.rig, object_offset=brought.object_offset)
        return cls(before, origin, brought.information(), brought.pull.sum(0), len(brought), seconds, kinds)

    @property
    def due(self) -> bool:
        """Tell whether to try to decide the kind now."""
        return self.overdue or self.count in DECIDE_AFTER

    def add(self, result: MeasurementUpdate, seconds: float) -> None:
        """Add a snapshot's information."""
        brought = result.brought
        information = brought.information()
        at = _distance(brought.rig, brought.object_offset, self.origin)
        self.brought, self.weighted = self.brought + information, self.weighted + brought.pull[0] + information @ at
        self.count, self.seconds = self.count + 1, self.seconds + seconds

    def has_turned_far(self, camera: int) -> bool:
        """Tell whether a camera is turned far from its pose before."""
        return bool(have_turned_far(self.before.rig, self.origin.rig)[camera])

    def others(self, camera: int) -> dict[int, str | None]:
        """The other cameras that changed, and how."""
        return {other: kind for other, kind in self.kinds.items() if other != camera}

    def test(self, walk: Tensor) -> ChangeTest:
        """Test the snapshots since the change against the belief before it.

        Args:
            walk: (C, K) standard deviation of an hour's drift.
        """
        before = self.before
        known = age_belief(before, self.seconds, walk).information
        pull = self.weighted - self.brought @ self.distance(before)
        change = camera_change_errors(before.rig, before.unit)
        return Comparison(known, self.brought, pull, change, pixel_changes(before.rig)).test_together()

    def decide(self, test: ChangeTest, camera: int, last: bool) -> tuple[str | None, str | None] | None:
        """Decide how a camera has changed, now if it is the `last` chance.

        Returns:
            The kind to believe (None = any) and the kind to report (None = no single kind); None = cannot be decided
            yet.
        """
        if self.has_turned_far(camera):
            return None, "rotation"
        odds: dict[str | None, float] = {None: test.odds({**self.others(camera), camera: None})}
        for kind, forms in FORMS_OF.items():
            found = [test.odds({**self.others(camera), camera: form}) for form in forms]
            odds[kind] = mean_evidence(found, len(found)) + LENS_LOG_PRIOR * (kind in LENS_KINDS)
        best, second = sorted(odds, key=lambda kind: -odds[kind])[:2]
        least = ALL_KINDS_LEAD if best is None else SINGLE_KIND_LEAD if second is None else KIND_LEAD
        if odds[best] - odds[second] >= least:
            return best, best or _main_kind(odds)
        # Report the most probable kind, but believe that any is possible.
        return (None, max(CHANGES, key=lambda kind: odds[kind]) if self.overdue else None) if last else None

    def decide_kinds(
        self, test: ChangeTest, changes: Mapping[int, Change], last: bool
    ) -> tuple[tuple[Change, ...], dict[int, str | None]]:
        """Decide the kinds of pending changes, by camera, where possible or overdue.

        Returns:
            The decided changes to report, and the kinds to believe for their cameras.
        """
        decided, kinds = [], dict[int, str | None]()
        for camera, change in changes.items():
            decision = self.decide(test, camera, last)
            if decision is None:
                continue
            kinds[camera], kind = decision
            sizes = {} if kind is None else self.sizes(test, camera, kind)
            if kind is not None and not sizes[kind][0] > CERTAIN_SIGMAS * sizes[kind][1]:
                kind, sizes = None, {}  # the camera has hardly been seen since
            size = (math.nan, math.nan) if kind is None else sizes.pop(kind)
            scores = test.condition_on(self.others(camera)).each.scores()
            evidence = max(float(scores[name][camera]) for name in ([kind] if kind else CHANGES))
            motion = {} if self.has_turned_far(camera) else {one: sizes[one] for one in MOTION_KINDS if one in sizes}
            also = tuple((one, *of) for one, of in motion.items() if of[0] >= CERTAIN_SIGMAS * of[1])
            found = Change(camera, change.since, kind or "unknown", *size, decided=True, evidence=evidence, also=also)
            decided.append(found)
        return tuple(decided), kinds

    def sizes(self, test: ChangeTest, camera: int, kind: str) -> dict[str, tuple[float, float]]:
        """Sizes of a camera's changes of all kinds, whatever changed beside this one, and their standard deviations."""
        every, joint = test.condition_on(self.others(camera)).estimate(camera, kind)
        found = {}
        for name, part in CHANGES.items():
            change, covariance = every[part], joint[part, part]
            size = float(change.norm())
            along = change / max(size, 1e-30)
            found[name] = size, float((along @ covariance @ along).clamp_min(0).sqrt())
        return found

    def adopt_kinds(self, test: ChangeTest) -> tuple[RigBelief, RigBelief, Tensor]:
        """Restrict the changes of cameras to the `kinds`.

        The earlier belief is moved along with the cameras first: a large rotation is not linear, and one that is far
        was not estimated in this chart.

        Returns:
            The belief before, the belief now, and its information (D, D), both without drift since.
        """
        before = place_cameras(self.before, self.origin.rig, self.kinds)
        step, std = torch.zeros_like(before.unit), change_std(self.kinds, pixel_changes(before.rig))
        for camera, kind in self.kinds.items():
            if kind is not None:
                step[camera, CHANGES[kind]] = test.condition_on(self.others(camera)).jump(camera, kind)[0]
            if kind in TURNS:
                std[camera, CHANGES["position"]] = MOUNT_JOINT * step[camera, CHANGES[kind]].norm()
        first = widen(replace(before, rig=before.rig.retract(step)), std.square())
        information = first.information + self.brought
        factor = torch.linalg.cholesky(information)
        pull = first.information @ self.distance(first) + self.weighted
        error = torch.cholesky_solve(pull[:, None], factor)[:, 0]
        origin, wide = self.origin, first.unit.numel()
        rig = displace(origin.rig, error[:wide].view(first.unit.shape) * first.unit)
        belief = replace(first, rig=rig, object_offset=origin.object_offset + error[wide:], factor=factor)
        return first, belief, information


def _main_kind(odds: Mapping[str | None, float]) -> str | None:
    """The kind that explains nearly all of a change of all kinds together; None = no single kind does."""
    rest = {kind: odds[None] - odds[kind] for kind in CHANGES}
    found = [kind for kind in CHANGES if rest[kind] <= (1 - MAIN_KIND_SHARE) * odds[None]]
    return min(found, key=lambda kind: rest[kind] * (LENS_REST if kind in LENS_KINDS else 1), default=None)


def free_cameras(belief: RigBelief, changes: Mapping[int, str | None], jump: float = LARGE) -> RigBelief:
    """Let cameras have changed in some form (None = any) by a jump in pixels."""
    return widen(belief, change_std(changes, pixel_changes(belief.rig), jump).square())


def free_anywhere(belief: RigBelief, cameras: Collection[int], snapshots: Sequence[Snapshot]) -> RigBelief:
    """Let cameras have moved anywhere before some snapshots; those that have turned far start where these show them."""
    placed = place_cameras(belief, resect_cameras(belief, snapshots, cameras), cameras)
    return free_cameras(placed, dict.fromkeys(cameras), JUMPS[-1])


def _distance(rig: CameraRig, object_offset: Tensor, origin: RigBelief) -> Tensor:
    """Error (D,) of a rig and an object in a chart."""
    cameras = (error_between(rig, origin.rig) / origin.unit).flatten()
    return torch.cat((cameras, object_offset - origin.object_offset))

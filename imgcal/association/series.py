"""Which blob is which fiducial, snapshot by snapshot: each accepted one helps with the next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Identity, Status, identify, oriented
from imgcal.association.options import PipelineOptions
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import ON_A_LINE, estimate, flat_std
from imgcal.geometry import RigidTransform
from imgcal.messages import listed
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations, RigPrior, check_object, check_rig

MOST_REMEMBERED = 64
"""Snapshots that take part in refits of the rig while identity goes on: later ones add little to it."""

NOT_TRIED = "not tried: nothing could be decided in many snapshots before"
MOST_IN_VAIN = 8_000_000
"""Hypotheses without any success, after which only a choice of the other snapshots is tried: as many once more."""

LEAST_CERTAIN_FIRST = ("ambiguous", "by_prior", "unique", "coded", "by_tracking")

Progress = Callable[[Iterable[int], int], Iterable[int]]


@dataclass(frozen=True)
class SnapshotIdentity:
    """What was decided about one snapshot."""

    name: str
    status: str  # coded | unique | by_prior | by_tracking | ambiguous | refused
    reason: str
    alternatives: int
    rig_from_object: RigidTransform | None


@dataclass(frozen=True)
class Associations:
    """Detections with a fiducial for every blob that has one, and how that was decided."""

    detections: Detections  # `fiducial` filled in, -1 = not used
    snapshots: tuple[SnapshotIdentity, ...]  # S

    @property
    def used(self) -> list[int]:
        """Numbers of the snapshots that are not refused."""
        return [i for i, snapshot in enumerate(self.snapshots) if snapshot.status != "refused"]

    @property
    def identity(self) -> str:
        """How identity was decided as a whole: as the least certain snapshot was.

        Snapshots that were followed from another are as certain as that one.
        """
        found = {snapshot.status for snapshot in self.snapshots}
        return next((status for status in LEAST_CERTAIN_FIRST if status in found), "refused")


def associate(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    progress: Progress | None = None,
) -> Associations:
    """Decide which blob is which fiducial, snapshot by snapshot.

    Each accepted snapshot predicts the next one. What the accepted ones say about the rig narrows the search in the
    following; refused ones are tried once more at the end, with the rig that all the others gave.

    Raises:
        RefusedError: no snapshot could be decided.

    Examples:
        >>> import torch, imgcal
        >>> from dataclasses import replace
        >>> from imgcal.synthesis import simulate_truth, true_detections
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> seen = true_detections(simulate_truth(rig, obj, 2, torch.Generator().manual_seed(0), None))
        >>> unlabelled = replace(seen, fiducial=np.full_like(seen.fiducial, -1))
        >>> found = associate(unlabelled, rig, obj)
        >>> found.identity, bool((found.detections.fiducial == seen.fiducial).all())
        ('unique', True)
    """
    count = len(detections.snapshot_names)
    coded = _coded_snapshots(detections, count)
    tracker = Tracker(rig, obj, options)
    results: dict[int, tuple[SnapshotIdentity, NDArray[np.int64]]] = {}
    rows = _rows_by_snapshot(detections, count)

    def decide(s: int) -> None:
        name = detections.snapshot_names[s]
        if coded[s]:
            results[s] = tracker.accept(name, detections.fiducial[rows[s]])
        else:
            results[s] = tracker.decide(detections.select(rows[s]), name)

    order: Iterable[int] = range(count)
    patience = Patience(count)
    for number, s in enumerate(progress(order, count) if progress else order):
        if coded[s] or patience.tries(number, tracker.in_vain):
            decide(s)
        else:
            results[s] = SnapshotIdentity(detections.snapshot_names[s], "refused", NOT_TRIED, 0, None), rows[s] * 0 - 1
    again = [s for s in range(count) if not coded[s] and _incomplete(*results[s], detections.camera[rows[s]])]
    accepted = np.array([s for s in range(count) if results[s][0].status != "refused"])
    if len(accepted):
        patience, tracker.in_vain = Patience(len(again)), 0
        # Those nearest to where the object was seen first: they are the likeliest to show it.
        for number, s in enumerate(sorted(again, key=lambda s: _gap(s, accepted))):
            first = results[s][0]
            if patience.tries(number, tracker.in_vain):
                decide(s)
            if first.status != "refused" and results[s][0].status != "refused":
                # The rig that it helped to find labels more of it, but says nothing new of how sure it is.
                retold = replace(results[s][0], status=first.status, alternatives=first.alternatives)
                results[s] = retold, results[s][1]
    fiducial = np.full(len(detections), -1, dtype=np.int64)
    for s in range(count):
        if results[s][0].status != "refused":
            fiducial[rows[s]] = results[s][1]
    labelled = Associations(replace(detections, fiducial=fiducial), tuple(results[s][0] for s in range(count)))
    if not labelled.used:
        reasons = Counter(snapshot.reason for snapshot in labelled.snapshots if snapshot.reason != NOT_TRIED)
        reason, times = reasons.most_common(1)[0] if count else ("found no snapshot", 0)
        tried = f"{reasons.total()} snapshots" + (f" tried, {count} in all" if reasons.total() < count else "")
        why = f"{reason} ({times} of {tried})" if count else reason
        raise RefusedError(f"identity: {why}")
    return labelled


def without_snapshots(labelled: Associations, rows: Sequence[int]) -> Associations:
    """Refuse snapshots (numbers among the used ones) whose labels lie on one line.

    Raises:
        RefusedError: none is left.
    """
    numbers, snapshots = [labelled.used[row] for row in rows], list(labelled.snapshots)
    for number in numbers:
        snapshots[number] = replace(snapshots[number], status="refused", reason=ON_A_LINE, rig_from_object=None)
    detections = labelled.detections
    fiducial = np.where(np.isin(detections.snapshot, numbers), -1, detections.fiducial)
    left = Associations(replace(detections, fiducial=fiducial), tuple(snapshots))
    if not left.used:
        raise RefusedError(f"estimation: in every snapshot: {ON_A_LINE}; capture more, with the whole object in view")
    return left


def _gap(snapshot: int, accepted: NDArray[np.int64]) -> int:
    """Snapshots to the nearest of the accepted ones, which are in ascending order."""
    near = int(np.searchsorted(accepted, snapshot))
    return int(np.abs(accepted[max(near - 1, 0) : near + 1] - snapshot).min())


def _incomplete(snapshot: SnapshotIdentity, labels: NDArray[np.int64], camera: NDArray[np.int64]) -> bool:
    """Tell whether another try may help: the snapshot was refused, or no blob of some camera (M,) has a label."""
    return snapshot.status == "refused" or not np.isin(camera, camera[labels >= 0]).all()


@dataclass
class Patience:
    """Bounds the effort for snapshots in which nothing is found, however many: a wrong object, clutter alone."""

    count: int  # snapshots
    first_left_out: int = -1
    stride: int = 1

    def tries(self, number: int, in_vain: int) -> bool:
        """Tell whether the next snapshot is worth the effort, after so many hypotheses without any success."""
        if in_vain <= MOST_IN_VAIN:
            self.first_left_out = -1
            return True
        if self.first_left_out < 0:
            self.first_left_out = number
            self.stride = max(1, round((self.count - number) * in_vain / max(number, 1) / MOST_IN_VAIN))
        return (number - self.first_left_out) % self.stride == self.stride - 1


class Tracker:
    """Carries what earlier snapshots say, the pose and the rig, to the next one."""

    def __init__(
        self, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions, remembered: int = MOST_REMEMBERED
    ) -> None:
        check_rig(rig)
        check_object(obj)
        self.factory, self.obj, self.options, self.remembered = rig, obj, options, remembered
        self.rig = rig
        self.prior_std = (rig.prior or RigPrior()).std(rig)
        self.pose = None if options.start_pose is None else _checked_pose(options.start_pose, rig)
        self.alternatives = 0  # that the accepted snapshots leave open, 0 = none was accepted yet
        self.in_vain = 0  # hypotheses that were tried since something was accepted
        self.accepted: list[tuple[Detections, NDArray[np.int64], RigidTransform]] = []

    def accept(self, name: str, labels: NDArray[np.int64]) -> tuple[SnapshotIdentity, NDArray[np.int64]]:
        """Take over the labels that came with a snapshot."""
        few = self._too_few(name, labels)
        return few or SnapshotIdentity(name, "coded", "labelled in the input", 1, None), labels

    def decide(self, blobs: Detections, name: str) -> tuple[SnapshotIdentity, NDArray[np.int64]]:
        """Label the blobs of one snapshot."""
        identity = self._identify(blobs)
        labels, pose = identity.labels, identity.rig_from_object
        if not identity.accepted:
            return SnapshotIdentity(name, "refused", identity.reason, identity.alternatives, None), labels
        if (few := self._too_few(name, labels)) is not None:
            return few, labels
        assert pose is not None  # an accepted identity has one
        self._remember(blobs, labels, pose)
        return SnapshotIdentity(name, identity.status, identity.reason, identity.alternatives, pose), labels

    def _too_few(self, name: str, labels: NDArray[np.int64]) -> SnapshotIdentity | None:
        """Refuse a snapshot that shows too few fiducials; None = it shows enough."""
        shown = len(np.unique(labels[labels >= 0]))
        if shown >= self.options.least_fiducials:
            return None
        reason = f"too few fiducials: found {shown}, expected at least {self.options.least_fiducials}"
        return SnapshotIdentity(name, "refused", reason, 1, None)

    def follow(self, pose: RigidTransform) -> tuple[Status, int]:
        """Take over the pose of a snapshot that was followed from the last one.

        Returns:
            How sure that one is: status and alternatives, which it inherits.
        """
        self.pose = pose
        return ("ambiguous" if self.alternatives > 1 else "by_tracking"), max(self.alternatives, 1)

    def _identify(self, blobs: Detections) -> Identity:
        error = np.hypot(self.options.identity_error, self._tolerance_px(blobs))
        blobs = replace(blobs, sigma=np.hypot(blobs.sigma, error))
        known = [] if self.pose is None else [self.pose]
        # Many captures are taken with the object at the origin of the rig's frame; it costs little to look there first.
        guesses = [] if known else [RigidTransform.identity(dtype=self.rig.focal_length.dtype)]
        found = identify(blobs, self.rig, self.obj, self.prior_std, known, self.options.identity, guesses)
        pose = found.rig_from_object
        if not found.accepted or pose is None:
            self.in_vain += found.hypotheses
            return found
        if self.alternatives == 0 and self.pose is not None and found.status != "unique":
            found = oriented(found, self.obj, self.pose)
        elif found.status == "by_tracking":
            status, alternatives = self.follow(pose)
            found = replace(found, status=status, alternatives=alternatives)
        self.alternatives, self.in_vain = found.alternatives, 0
        return found

    def _tolerance_px(self, blobs: Detections) -> float:
        """What the object's tolerances are in the image, roughly."""
        obj = self.obj
        if obj.exact:
            return 0.0
        tolerance = 0.0 if obj.tolerance is None else float(obj.tolerance.max())
        tolerance = float(np.hypot(tolerance, obj.scale_tolerance * obj.size))
        distance = self.rig.working_distance
        if distance is None and self.pose is not None:
            centre = self.pose.apply(obj.points.mean(0, keepdim=True))[0]
            distance = float((self.rig.positions - centre).norm(dim=-1).median())
        if distance is not None:
            return tolerance * float(self.rig.focal_length.mean()) / distance
        cameras = [blobs.uv[blobs.camera == c] for c in np.unique(blobs.camera)]
        extents = [np.linalg.norm(uv - np.median(uv, axis=0), axis=1).mean() for uv in cameras]
        return tolerance * float(np.median(extents)) / obj.size if extents else 0.0

    def _remember(self, blobs: Detections, labels: NDArray[np.int64], pose: RigidTransform) -> None:
        """Keep the pose; refit the rig after 1, 2, 4, 8, ... accepted snapshots."""
        self.pose = pose
        if len(self.accepted) >= self.remembered:
            return
        self.accepted.append((blobs, labels, pose))
        count = len(self.accepted)
        if count & (count - 1):
            return
        parts = [to_observations(replace(b, fiducial=given), self.factory, self.obj) for b, given, _ in self.accepted]
        sigma = (torch.cat([p.sigma for p in parts]).square() + self.options.identity_error**2).sqrt()
        observations = Observations(torch.cat([p.uv for p in parts]), sigma, torch.cat([p.seen for p in parts]))
        poses = RigidTransform.stack([p for _, _, p in self.accepted])
        fit = estimate(observations, self.factory, self.obj, poses, options=self.options.estimation)
        if bool(fit.converged):
            prior = (self.factory.prior or RigPrior()).std(self.factory)
            self.rig, self.prior_std = fit.rig, torch.minimum(2 * flat_std(fit), prior)


def _checked_pose(pose: RigidTransform, rig: CameraRig) -> RigidTransform:
    """Return a pose that a user gave, in the rig's precision.

    Raises:
        InputError: it is none.
    """
    shapes = tuple(pose.rotation.shape), tuple(pose.translation.shape)
    if shapes != ((3, 3), (3,)):
        raise InputError(f"start pose: found shapes {shapes[0]} and {shapes[1]}, expected one rotation and translation")
    pose = pose.to(rig.focal_length.dtype)
    off = (pose.rotation @ pose.rotation.mT - torch.eye(3, dtype=pose.rotation.dtype)).abs().max()
    if not (bool(off < 1e-3) and bool(torch.det(pose.rotation) > 0) and bool(pose.translation.isfinite().all())):
        raise InputError("start pose: found no rotation and finite translation, expected those of rig_from_object")
    return pose


def matched_to_rig(detections: Detections, rig: CameraRig) -> Detections:
    """Renumber the cameras of detections in the order of the rig.

    Raises:
        InputError: a camera that the rig does not have.
    """
    unknown = [name for name in detections.camera_names if name not in rig.camera_names]
    if unknown:
        raise InputError(
            f"detections: found camera {listed(unknown)}, expected cameras of rig {rig.name}: "
            f"{listed(rig.camera_names)}"
        )
    index = np.array([rig.camera_names.index(name) for name in detections.camera_names], dtype=np.int64)
    camera = index[detections.camera] if len(detections) else detections.camera
    return replace(detections, camera=camera, camera_names=rig.camera_names)


def to_observations(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Observations:
    """Arrange labelled blobs densely: (S, C, N). Of two blobs with one label in a camera the last one counts."""
    snapshots = np.unique(detections.snapshot) if len(detections) else np.empty(0, dtype=np.int64)
    shape = (max(len(snapshots), 1), rig.num_cameras, obj.num_fiducials)
    rows = np.flatnonzero(detections.fiducial >= 0)
    where = (np.searchsorted(snapshots, detections.snapshot[rows]), detections.camera[rows], detections.fiducial[rows])
    uv, sigma, seen = np.zeros((*shape, 2)), np.ones(shape), np.zeros(shape, dtype=bool)
    uv[where], sigma[where], seen[where] = detections.uv[rows], detections.sigma[rows], True
    dtype = rig.focal_length.dtype
    return Observations(torch.from_numpy(uv).to(dtype), torch.from_numpy(sigma).to(dtype), torch.from_numpy(seen))


def observations_of(
    labelled: Associations, rig: CameraRig, obj: CalibrationObject
) -> tuple[Observations, RigidTransform | None]:
    """Observations of the accepted snapshots, and their poses where identity found all of them."""
    used = labelled.used
    detections = labelled.detections
    rows = detections.fiducial >= 0
    if len(used) < len(labelled.snapshots):
        rows &= np.isin(detections.snapshot, used)
    observations = to_observations(detections if rows.all() else detections.select(rows), rig, obj)
    poses = [labelled.snapshots[s].rig_from_object for s in used]
    known = [pose for pose in poses if pose is not None]
    return observations, RigidTransform.stack(known) if len(known) == len(used) else None


def _rows_by_snapshot(detections: Detections, count: int) -> list[NDArray[np.int64]]:
    """Rows of the usable blobs of each snapshot, in one pass over the table."""
    usable = np.flatnonzero(detections.usable)
    snapshot = detections.snapshot[usable]
    order = np.argsort(snapshot, kind="stable")
    return np.split(usable[order], np.searchsorted(snapshot[order], np.arange(1, count)))[:count]


def _coded_snapshots(detections: Detections, count: int) -> NDArray[np.bool_]:
    """Tell which snapshots come with labels."""
    coded = np.zeros(count, dtype=bool)
    coded[detections.snapshot[detections.fiducial >= 0]] = True
    return coded

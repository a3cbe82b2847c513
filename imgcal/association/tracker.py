"""Use earlier snapshots, by their pose and rig, to label the next one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association.identification import identify_with
from imgcal.association.identity import Identity, PipelineOptions, Status, orient
from imgcal.association.proposals import Sight, Snapshot, judge
from imgcal.association.verification import Known
from imgcal.errors import InputError
from imgcal.estimation import estimate, flat_std, has_poses
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations, RigPrior, check_object, check_rig

MOST_REMEMBERED = 64
"""Maximum number of snapshots in refits of the rig during identification: later ones add little."""

NEARLY_KNOWN = 0.35
"""Maximum rotation (rad) of a proposed pose against the last one to count as found by tracking."""


@dataclass(frozen=True)
class SnapshotIdentity:
    """The decision about one snapshot."""

    name: str
    status: str  # coded | unique | by_prior | by_tracking | ambiguous | refused
    reason: str
    alternatives: int
    rig_from_object: RigidTransform | None
    found_by: str = "classical"  # blobs, or the name of the proposer
    moment: int = -1  # number of the input's snapshot if several rows share one; -1 = its own number
    part: int = 0  # number of the object, of several


class LearntRig:
    """The rig estimated from accepted snapshots; shared by the trackers of several objects."""

    def __init__(self, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions, remembered: int) -> None:
        self.factory, self.obj, self.options, self.remembered = rig, obj, options, remembered
        self.rig = rig
        self.prior_std = (rig.prior or RigPrior()).std(rig)
        self.accepted: dict[str, tuple[Detections, NDArray[np.int64], RigidTransform]] = {}  # by name

    def remember(self, name: str, blobs: Detections, labels: NDArray[np.int64], pose: RigidTransform) -> None:
        """Refit the rig after 1, 2, 4, 8, ... accepted snapshots."""
        known = name in self.accepted
        if not known and len(self.accepted) >= self.remembered:
            return
        self.accepted[name] = blobs, labels, pose
        count = len(self.accepted)
        # A snapshot that was tried again replaces its earlier result: it is not further evidence.
        if known or count & (count - 1):
            return
        accepted, obj = self.accepted.values(), self.obj
        parts = [to_observations(replace(b, fiducial=given), self.factory, obj) for b, given, _ in accepted]
        sigma = (torch.cat([p.sigma for p in parts]).square() + self.options.identity_error**2).sqrt()
        observations = Observations(torch.cat([p.uv for p in parts]), sigma, torch.cat([p.seen for p in parts]))
        poses = RigidTransform.stack([p for _, _, p in accepted])
        part_of = obj.part_of if obj.parts else None
        posed = torch.from_numpy(has_poses(observations.seen.numpy(), obj.points, part_of))
        if not bool(posed.any()):
            return
        observations, poses = observations.of_snapshots(posed), poses[posed]
        fit = estimate(observations, self.factory, obj, poses, options=self.options.estimation)
        if bool(fit.converged):
            prior = (self.factory.prior or RigPrior()).std(self.factory)
            self.rig, self.prior_std = fit.rig, torch.minimum(2 * flat_std(fit), prior)


class Tracker:
    """Carries pose and rig from earlier snapshots to the next one."""

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        options: PipelineOptions,
        remembered: int = MOST_REMEMBERED,
        learnt: LearntRig | None = None,
        first: int = 0,
    ) -> None:
        """Start with the prior knowledge.

        Args:
            rig: the factory calibration.
            obj: the tracked object.
            options: how certain the result must be.
            remembered: maximum number of snapshots in refits of the rig.
            learnt: state shared with trackers of other objects; None = this is the only one.
            first: number of the object's first fiducial among those of all objects.
        """
        check_rig(rig)
        check_object(obj)
        self.obj, self.options, self.first = obj, options, first
        self.learnt = learnt or LearntRig(rig, obj, options, remembered)
        self.pose = None if options.start_pose is None else _check_pose(options.start_pose, rig)
        self._known: Known | None = None
        self.alternatives = 0  # left by the accepted snapshots, 0 = none accepted yet
        self.in_vain = 0  # number of hypotheses since the last success
        self.looks_in_vain = 0  # snapshots without a proposal, less those with one

    @property
    def rig(self) -> CameraRig:
        """The rig estimated from the accepted snapshots."""
        return self.learnt.rig

    @rig.setter
    def rig(self, rig: CameraRig) -> None:
        self.learnt.rig = rig

    @property
    def prior_std(self) -> Tensor:
        """Standard deviations of its values: (C, K)."""
        return self.learnt.prior_std

    @prior_std.setter
    def prior_std(self, prior_std: Tensor) -> None:
        self.learnt.prior_std = prior_std

    def accept(self, name: str, labels: NDArray[np.int64]) -> tuple[SnapshotIdentity, NDArray[np.int64]]:
        """Accept the labels (M,) that came with the M blobs of a snapshot, and return them with the decision."""
        few = self._refuse_too_few(name, labels)
        return few or SnapshotIdentity(name, "coded", "labelled in the input", 1, None), labels

    def decide(
        self, blobs: Detections, name: str, expected: RigidTransform | None = None, search: bool = True
    ) -> tuple[SnapshotIdentity, NDArray[np.int64]]:
        """Label the blobs of one snapshot.

        Args:
            blobs: M of one snapshot.
            name: of the snapshot.
            expected: () as for `propose`.
            search: as for `propose`.

        Returns:
            The decision, and the labels (M,); -1 = none.
        """
        return self._conclude(self._adopt(self.propose(blobs, expected, search)), blobs, name)

    def look(
        self, sight: Sight, number: int, blobs: Detections, name: str
    ) -> tuple[SnapshotIdentity, NDArray[np.int64], Detections]:
        """Label one snapshot by a proposer's view of its frames; also return the blobs that the labels refer to.

        If it sees nothing, and blobs have not been tried yet, they give a pose to try, or decide themselves. Without a
        frame, blobs decide.
        """
        frames = sight.frames(number)
        if all(frame is None for frame in frames.values()):
            return *self.decide(blobs, name), blobs
        known = () if self.pose is None else (self.pose,)
        snapshot = Snapshot(frames, blobs, self.rig, self.obj, self.prior_std, known, sight.detection, sight.masks)
        identity, found, found_by = self._judge(sight, snapshot)
        identity = self._adopt(identity)
        if not identity.accepted and not sight.where_blobs_fail:
            told = self._adopt(self.propose(blobs))
            if told.accepted and told.rig_from_object is not None:
                there, at, by = self._judge(sight, replace(snapshot, candidates=(told.rig_from_object,)))
                if there.accepted:
                    found_by = by
                    identity, found = replace(there, status=told.status, alternatives=told.alternatives), at
                else:
                    identity, found, found_by = told, blobs, "classical"
        self.looks_in_vain = max(0, self.looks_in_vain + (-1 if identity.accepted else 1))
        concluded, labels = self._conclude(identity, found, name)
        return replace(concluded, found_by=found_by), labels, found

    def _judge(self, sight: Sight, snapshot: Snapshot) -> tuple[Identity, Detections, str]:
        """Run a proposer; judge its proposal, or the one behind it where that is refused, and name who made it."""
        proposal = sight.proposer.propose(snapshot)
        error = float(np.hypot(self.options.identity_error, self._tolerance_px(snapshot.blobs)))
        while True:
            near = False
            if snapshot.candidates and proposal.rig_from_object is not None:
                known, found = snapshot.candidates[0].rotation, proposal.rig_from_object.rotation
                near = bool(geodesic_angle(known, found) < NEARLY_KNOWN)
            identity, blobs = judge(proposal, snapshot, self.options.identity, error=error, pose_known=near)
            if identity.accepted or proposal.otherwise is None:
                return identity, blobs, proposal.found_by or sight.proposer.name
            proposal = proposal.otherwise()

    def _conclude(self, identity: Identity, blobs: Detections, name: str) -> tuple[SnapshotIdentity, NDArray[np.int64]]:
        labels, pose = identity.labels, identity.rig_from_object
        if not identity.accepted:
            return SnapshotIdentity(name, "refused", identity.reason, identity.alternatives, None), labels
        if (few := self._refuse_too_few(name, labels)) is not None:
            return few, labels
        assert pose is not None  # an accepted identity has one
        self._remember(name, blobs, labels, pose)
        return SnapshotIdentity(name, identity.status, identity.reason, identity.alternatives, pose), labels

    def _refuse_too_few(self, name: str, labels: NDArray[np.int64]) -> SnapshotIdentity | None:
        """Refuse a snapshot with too few fiducials; None = it has enough."""
        shown = np.count_nonzero(np.bincount(labels[labels >= 0]))
        least = self.options.least_fiducials
        least = least if self.obj.pose_rank == 6 else min(least, self.obj.num_fiducials)
        if shown >= least:
            return None
        reason = f"too few fiducials: found {shown}, expected at least {least}"
        return SnapshotIdentity(name, "refused", reason, 1, None)

    def follow(self, pose: RigidTransform) -> tuple[Status, int]:
        """Take the pose of a snapshot that was tracked from the last one.

        Returns:
            Its certainty, inherited from the last one: status and alternatives.
        """
        self.pose = pose
        return ("ambiguous" if self.alternatives > 1 else "by_tracking"), max(self.alternatives, 1)

    def propose(self, blobs: Detections, expected: RigidTransform | None = None, search: bool = True) -> Identity:
        """Label the blobs of one snapshot without changing the state.

        Args:
            blobs: of the snapshot.
            expected: pose to try before the last one.
            search: also search for a pose elsewhere.
        """
        error = np.hypot(self.options.identity_error, self._tolerance_px(blobs))
        blobs = replace(blobs, sigma=np.hypot(blobs.sigma, error))
        poses = [pose for pose in (expected, self.pose) if pose is not None]
        # In many captures the object is at the origin of the rig's frame; this is cheap to try first.
        guesses = [] if poses else [RigidTransform.identity(dtype=self.rig.focal_length.dtype)]
        return identify_with(self._know(), blobs, poses, self.options.identity, guesses, search=search)

    def conclude(self, proposed: Identity, blobs: Detections, name: str) -> tuple[SnapshotIdentity, NDArray[np.int64]]:
        """Update the state with the result of `propose` for these M blobs; return the decision and the labels (M,)."""
        return self._conclude(self._adopt(proposed), blobs, name)

    def _know(self) -> Known:
        """Return what the accepted snapshots tell about the rig, the same until they tell more."""
        known = self._known
        if known is None or known.rig is not self.rig or known.std is not self.prior_std:
            known = self._known = Known(self.obj, self.rig, self.prior_std)
        return known

    def _adopt(self, found: Identity) -> Identity:
        """Interpret a decision given the earlier ones."""
        pose = found.rig_from_object
        if not found.accepted or pose is None:
            self.in_vain += found.hypotheses
            return found
        if self.alternatives == 0 and self.pose is not None and found.status != "unique":
            found = orient(found, self.obj, self.pose)
        elif found.status == "by_tracking":
            status, alternatives = self.follow(pose)
            found = replace(found, status=status, alternatives=alternatives)
        self.alternatives, self.in_vain = found.alternatives, 0
        return found

    def _tolerance_px(self, blobs: Detections) -> float:
        """Approximate size of the object's tolerances in the image."""
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

    def _remember(self, name: str, blobs: Detections, labels: NDArray[np.int64], pose: RigidTransform) -> None:
        """Keep the pose, and update the rig."""
        self.pose = pose
        labels = np.where(labels >= 0, labels + self.first, -1)
        self.learnt.remember(name if self.first == 0 else f"{name} {self.first}", blobs, labels, pose)


def _check_pose(pose: RigidTransform, rig: CameraRig) -> RigidTransform:
    """Convert a user's pose to the rig's precision.

    Raises:
        InputError: it is not a pose.
    """
    shapes = tuple(pose.rotation.shape), tuple(pose.translation.shape)
    if shapes != ((3, 3), (3,)):
        raise InputError(f"start pose: found shapes {shapes[0]} and {shapes[1]}, expected one rotation and translation")
    pose = pose.to(rig.focal_length.dtype)
    off = (pose.rotation @ pose.rotation.mT - torch.eye(3, dtype=pose.rotation.dtype)).abs().max()
    if not (bool(off < 1e-3) and bool(torch.det(pose.rotation) > 0) and bool(pose.translation.isfinite().all())):
        raise InputError("start pose: expected a rotation matrix and a finite translation (rig_from_object)")
    return pose


def to_observations(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Observations:
    """Arrange labelled blobs densely: (S, C, N). If two blobs in a camera have the same label, the last one counts."""
    snapshots = np.unique(detections.snapshot) if len(detections) else np.empty(0, dtype=np.int64)
    shape = (max(len(snapshots), 1), rig.num_cameras, obj.num_fiducials)
    rows = np.flatnonzero(detections.fiducial >= 0)
    where = (np.searchsorted(snapshots, detections.snapshot[rows]), detections.camera[rows], detections.fiducial[rows])
    uv, sigma, seen = np.zeros((*shape, 2)), np.ones(shape), np.zeros(shape, dtype=bool)
    uv[where], sigma[where], seen[where] = detections.uv[rows], detections.sigma[rows], True
    dtype = rig.focal_length.dtype
    return Observations(torch.from_numpy(uv).to(dtype), torch.from_numpy(sigma).to(dtype), torch.from_numpy(seen))

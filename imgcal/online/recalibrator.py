"""Recalibration while a rig runs: frames of one snapshot after another, a calibration for each."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import TracebackType
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import PipelineOptions, Proposer, SnapshotIdentity
from imgcal.detection import DetectionOptions, Frame
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import aligned, flat_std
from imgcal.geometry import RigidTransform
from imgcal.online.breaks import MEDIAN, information, series_of
from imgcal.online.following import (
    LEAST_BLOBS,
    LEAST_EXPLAINED,
    astray,
    found_again,
    near_prediction,
    spare_blobs,
    widened,
    without_strays,
)
from imgcal.online.labelling import LEAST_FOLLOWED, NEAR, Labelling
from imgcal.online.motion import measured_move
from imgcal.online.resection import resected
from imgcal.online.window import RELEARNT, SIGNIFICANT, Kept, Usual, Window, WindowFit
from imgcal.pipeline import Calibration, DetectorName, checked_frames
from imgcal.types import CalibrationObject, CameraRig, Detections, MovedCamera, RigPrior

REMEMBERED = 8
"""Latest snapshots that are compared with a new one which does not fit, however small the window."""

CameraState = Literal["seen", "recent", "kept", "factory", "astray"]


@dataclass(frozen=True)
class LiveCalibration(Calibration):
    """A calibration from the latest snapshots, and what each camera's values are made from.

    States of a camera: `seen` in this snapshot; `recent`, in an earlier one of the window; `kept`, in none of them: it
    has the values that it had last, with their standard deviation; `factory`, it has seen nothing yet: the factory's
    values and prior; `astray`, it sees what may be the object, but not where its values put it: they are its last ones,
    and hold no more.
    """

    cameras: Mapping[str, CameraState] = field(default_factory=dict)
    moved: tuple[MovedCamera, ...] = ()  # noticed with this snapshot; again when a camera that was lost is found
    restarted: bool = False  # older snapshots did not go with this one, nothing said why, and they were given up


@dataclass(frozen=True)
class _Last:
    """What was known of a camera when it was last seen."""

    rig: CameraRig
    std: Tensor  # (K,)
    seen: frozenset[int]  # cameras in the window of that time


class Recalibrator:
    """Keeps what the next snapshot needs: the last pose, what the rig has shown itself to be, a pool of threads.

    Memory does not grow with the number of snapshots. A context manager: leaving it ends the threads.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> blobs = true_detections(truth)
        >>> with imgcal.Recalibrator(factory, obj, window=3) as live:
        ...     for snapshot in range(4):
        ...         result = live.update(blobs.of_snapshots(snapshot, snapshot + 1))
        >>> result.cameras["cam01"], len(result.labelled.used)
        ('seen', 3)
    """

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        options: PipelineOptions = PipelineOptions(),
        *,
        detection: DetectionOptions = DetectionOptions(),
        window: int = 1,
        detector: DetectorName | Proposer = "classical",
    ) -> None:
        """Start from a factory calibration.

        Args:
            rig: the factory calibration, without batch axes.
            obj: the calibration object.
            options: how sure each result must be. Cameras that see nothing are always accepted.
            detection: how blobs are found.
            window: number of latest snapshots that a calibration is made from; more know the rig better and follow it
                more slowly. Of a camera that moves, those before the move are left out.
            detector: who finds the fiducials in frames, as for `calibrate`; blobs found elsewhere decide alone.
        """
        obj.require_rigid("for a running rig")
        if window < 1:
            raise InputError(f"window: found {window}, expected at least 1 snapshot")
        rig = rig.to(torch.float64)
        self.rig, self.obj, self.detection, self.window = rig, obj, detection, window
        self.options = replace(options, blind_cameras=True)
        self._labelling = Labelling(rig, obj, self.options, detection, detector)
        self._fit = WindowFit(rig, obj, self.options, window)
        self._recent: deque[Kept] = deque(maxlen=max(window, REMEMBERED))
        self._prior_std = (rig.prior or RigPrior()).std(rig)
        self._latest: LiveCalibration | None = None
        self._fitted: Calibration | None = None  # the same without what is kept of cameras that are not in the window
        self._last: dict[int, _Last] = {}
        self._lost: dict[int, tuple[int, int]] = {}  # camera -> when it went astray, how often since
        self._spare: deque[NDArray[np.int64]] = deque(maxlen=15)
        self._tests: deque[float] = deque(maxlen=200)
        self._additive_noises: deque[float] = deque(maxlen=10)
        self._count = 0

    def __enter__(self) -> Recalibrator:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the threads."""
        self._labelling.close()

    def update(self, source: Mapping[str, Frame | None] | Detections) -> LiveCalibration:
        """Recalibrate from a new snapshot.

        Args:
            source: frames by camera, (H, W), None = no frame; or blobs that were found elsewhere, labelled or not.

        Returns:
            The calibration from the latest snapshots. Cameras that see nothing stay in it: see `LiveCalibration`.

        Raises:
            RefusedError: this snapshot cannot decide; the next one is tried afresh.
            InputError: a frame is no grey image, of another size than the rig says, or of a camera that the rig does
                not have; blobs of more than one snapshot.
        """
        name = f"{self._count:05d}"
        self._count += 1
        source = source if isinstance(source, Detections) else checked_frames(source, self._labelling.rig)
        detections = self._labelling.blobs(source, name)
        usable = detections.select(detections.usable)
        coded = usable.fiducial.copy() if (usable.fiducial >= 0).any() else None
        followed = self._follow(usable, name) if coded is None else None
        if followed is not None:
            return followed
        frames = None if isinstance(source, Detections) or coded is not None else source
        return self._concluded(*self._labelling.decided(usable, name, coded, frames, self._known()))

    def _known(self) -> tuple[CameraRig, Tensor] | None:
        """The rig, and with some reserve how well it is known; None = nothing but the factory calibration."""
        if self._latest is None:
            return None
        prior = (self.rig.prior or RigPrior()).std(self.rig)
        return self._latest.rig, torch.minimum(2 * flat_std(self._latest.estimate), prior)

    def _follow(self, blobs: Detections, name: str) -> LiveCalibration | None:
        """Label blobs by the last result's prediction, where the object has moved little; None = not to be trusted.

        What is accepted here has been fitted: as many labels as before, hardly any of them an outlier.
        """
        latest = self._latest
        if latest is None or not self._labelling.follows or self._labelling.slips:
            return None
        points = latest.rig_from_object[-1:].apply(latest.points_object)
        predicted = latest.rig.expand(1).project_values(points, self.obj.radius).uv[0].numpy()  # (C, N, 2)
        named = replace(blobs, fiducial=near_prediction(blobs, predicted))
        blobs, pose = without_strays(named, latest.rig, latest.object, latest.rig_from_object[-1], self.options)
        before = int(latest.observations.seen[-1].sum())
        if (blobs.fiducial >= 0).sum() < LEAST_FOLLOWED * before or self._astray(blobs, pose).any():
            return None
        snapshot = SnapshotIdentity(name, "by_tracking", NEAR, 1, pose)
        try:
            return self._concluded(blobs, snapshot, least=LEAST_FOLLOWED * before)
        except RefusedError:
            return None

    def _usual(self) -> Usual:
        """What earlier fits looked like."""
        enough = len(self._tests) >= self.rig.num_cameras
        excess = float(np.median(self._tests)) / MEDIAN if enough else None
        return Usual(excess, max(self._additive_noises)) if self._additive_noises else Usual(excess)

    def _astray(self, blobs: Detections, pose: RigidTransform) -> NDArray[np.bool_]:
        """Find cameras, of which something is known, that see what may be the object where it should not be: (C,)."""
        if self._latest is None or spare_blobs(blobs, self.rig.num_cameras).max() < LEAST_BLOBS:
            return np.zeros(self.rig.num_cameras, dtype=bool)
        usual = np.median(self._spare, axis=0) if self._spare else np.zeros(self.rig.num_cameras)
        return astray(blobs, usual, self._latest.rig, self.obj, pose)

    def _concluded(self, blobs: Detections, snapshot: SnapshotIdentity, least: float = 0.0) -> LiveCalibration:
        """Fit the window, find out what moved, and keep what the next snapshot needs.

        Args:
            blobs: labelled.
            snapshot: how they were.
            least: number of labels that must fit.
        """
        window, found, missed = self._searched(Window((*self._recent, Kept(blobs, snapshot)), self._prior_std))
        # A larger window is compared with its newest snapshot whenever it is fitted.
        doubtful = self.window == 1 and (bool(found) or self._contradicted(window.kept[-1]))
        fitted = self._fit(window, self._fitted, self._usual(), doubtful)
        result, window = fitted.result, fitted.window
        if int(result.observations.seen[-1].sum()) < least:
            raise RefusedError("estimation: too few labels fit")
        missed += sorted(_all_out(window.kept[-1].blobs, result) - set(missed))
        found_now = _seen(result, -1) - set(missed)
        self._lost = {camera: lost for camera, lost in self._lost.items() if camera not in found_now}
        for camera in missed:
            first, times = self._lost.get(camera, (self._count - 1, 0))
            self._lost[camera] = first, times + 1
        live = self._completed(result, window)
        if fitted.tests or not window.moved:
            self._tests.extend(fitted.tests)
            self._additive_noises.append(result.additive_noise)
        self._recent.clear()
        self._recent.extend(window.kept)
        self._prior_std = window.prior_std
        self._spare.append(spare_blobs(window.kept[-1].blobs, self.rig.num_cameras))
        self._latest, self._fitted = live, result
        self._labelling.follow(result.rig_from_object[-1])
        return live

    def _contradicted(self, newest: Kept) -> bool:
        """Tell whether most labels of some camera are not where the last snapshot's rig puts them."""
        pose, latest = newest.snapshot.rig_from_object, self._latest
        if latest is None or pose is None or newest.snapshot.reason == NEAR:
            return False
        fitting, _ = without_strays(newest.blobs, latest.rig, self.obj, pose, self.options)
        given, left = (
            np.bincount(blobs.camera[blobs.fiducial >= 0], minlength=self.rig.num_cameras)
            for blobs in (newest.blobs, fitting)
        )
        return bool(((given >= 3) & (left < 0.5 * given)).any())

    def _searched(self, window: Window) -> tuple[Window, list[int], list[int]]:
        """Look for the object in cameras that do not see it where it should be: also says in which, or in vain."""
        newest, latest, found, missed = window.kept[-1], self._latest, [], []
        pose = newest.snapshot.rig_from_object
        cameras = [] if latest is None or pose is None else np.flatnonzero(self._astray(newest.blobs, pose)).tolist()
        if latest is None or pose is None or not cameras:
            return window, [], []
        std = torch.minimum(2 * flat_std(latest.estimate), self._prior_std)
        for camera in cameras:
            wide = widened(self._prior_std, latest.rig, [camera], pose, self.obj, RELEARNT)
            labelled = found_again(newest.blobs, camera, latest.rig, self.obj, pose, std, self.options)
            labelled = self._resected(window, camera, latest) if labelled is None else labelled
            if labelled is None:
                missed.append(camera)
                if self._lost.get(camera, (0, 0))[1] == 1:  # twice is no chance
                    window = window.after_move(camera, len(window.kept), wide)
                continue
            found.append(camera)
            newest = replace(newest, blobs=labelled)
            window = replace(window, kept=(*window.kept[:-1], newest))
            if not any(kept.sees(camera) for kept in window.kept[:-1]):
                # Nothing that is remembered contradicts, but the prior may: it is of the place before.
                window = window.after_move(camera, len(window.kept) - 1, wide)
        return window, found, missed

    def _resected(self, window: Window, camera: int, latest: Calibration) -> Detections | None:
        """Look for a camera anywhere, by all snapshots since it was lost: after 1, 2, 4, 8, ... of them."""
        first, times = self._lost.get(camera, (0, 0))
        if not times or times & (times - 1):
            return None
        since = [kept for kept in window.kept if int(kept.snapshot.name) >= first]
        places = self._fit.rough(window)[0].rig_from_object[-len(since) :].apply(latest.points_object)
        rows = [np.flatnonzero(kept.blobs.camera == camera) for kept in since]
        seen = [kept.blobs.uv[r] for kept, r in zip(since, rows, strict=True)]
        found = resected(seen, places, latest.rig.select([camera]), np.random.default_rng(times))
        if found is None:
            return None
        fiducial = since[-1].blobs.fiducial.copy()
        fiducial[rows[-1]] = found.labels
        return replace(since[-1].blobs, fiducial=fiducial)

    def _completed(self, result: Calibration, window: Window) -> LiveCalibration:
        """Give cameras that are not in the window what was last known of them, and say what holds for each."""
        inside, now = _seen(result), _seen(result, -1)
        if self._fitted is not None and self._latest is not None and (left := _seen(self._fitted) - inside):
            std = flat_std(self._latest.estimate)
            self._last |= {c: _Last(self._latest.rig, std[c], _seen(self._fitted)) for c in left}
        states: dict[str, CameraState] = {}
        estimate, problem = result.estimate, result.estimate.problem
        rig, factory, prior_std = result.rig, problem.factory, problem.prior_std.clone()
        for camera, name in enumerate(self.rig.camera_names):
            if camera in self._lost:
                states[name] = "astray"
            elif camera in inside:
                states[name] = "seen" if camera in now else "recent"
            else:
                states[name] = "kept" if camera in self._last else "factory"
            if camera in inside or camera not in self._last:
                continue
            last = self._last[camera]
            there = aligned(last.rig, rig, _places(result), sorted(last.seen & inside))
            rig, factory = _with_camera(rig, there, camera), _with_camera(factory, there.expand(1), camera)
            prior_std[0, camera] = (
                torch.maximum(last.std, window.prior_std[camera]) if camera in self._lost else last.std
            )
        values = {entry.name: getattr(result, entry.name) for entry in fields(Calibration)}
        problem = replace(problem, factory=factory, prior_std=prior_std)
        values["estimate"] = replace(estimate, rig=rig, problem=problem)
        values["moved"] = self._moves(result, window)
        return LiveCalibration(**values, cameras=states, restarted=window.restarted)

    def _moves(self, result: Calibration, window: Window) -> tuple[MovedCamera, ...]:
        """Say which cameras moved, and how far where it can be told."""
        before, moves = self._latest, []
        for camera, first in window.moved.items():
            name = self.rig.camera_names[camera]
            if not first or before is None or self._fitted is None:
                moves.append(MovedCamera(name, first or window.kept[-1].snapshot.name, "unknown"))
                continue
            if camera in _seen(self._fitted):
                fitted = self._fitted
                known = information(series_of(fitted.estimate, fitted.observations, self.obj.radius))[camera]
            else:
                std = self._last[camera].std if camera in self._last else self._prior_std[camera]
                known = np.diag(std[:6].numpy() ** -2.0)
            move, surely = measured_move(before.rig, known, result, camera, first, window.prior_std[camera, :6])
            if surely > SIGNIFICANT:
                moves.append(move)
        return tuple(moves)


def _seen(result: Calibration, snapshot: int | None = None) -> frozenset[int]:
    """Cameras whose labels take part in a fit, or in one snapshot of it."""
    seen = result.observations.seen if snapshot is None else result.observations.seen[[snapshot]]
    return frozenset(seen.any(-1).any(0).nonzero().flatten().tolist())


def _all_out(blobs: Detections, result: Calibration) -> set[int]:
    """Cameras in which the newest labels do not fit, or hardly any."""
    given = np.bincount(blobs.camera[blobs.fiducial >= 0], minlength=result.rig.num_cameras)
    fit = result.observations.seen[-1].sum(-1).numpy()
    return set(np.flatnonzero((given >= 3) & (fit < LEAST_EXPLAINED * given)).tolist())


def _places(result: Calibration) -> Tensor:
    """Where fiducials were while the window was filled: (M, 3) mm, some dozens."""
    points = result.rig_from_object.apply(result.points_object).reshape(-1, 3)
    return points[:: max(1, len(points) // 60)]


def _with_camera(rig: CameraRig, other: CameraRig, camera: int) -> CameraRig:
    """Replace the values of a camera by those that it has in another rig (of the same batch axes)."""
    chosen = torch.arange(rig.num_cameras) == camera

    def put(tensor: Tensor, source: Tensor, axes: int) -> Tensor:
        return torch.where(chosen.reshape(-1, *(1,) * (axes - 1)), source, tensor)

    return replace(
        rig,
        focal_length=put(rig.focal_length, other.focal_length, 2),
        principal_point=put(rig.principal_point, other.principal_point, 2),
        distortion=put(rig.distortion, other.distortion, 2),
        cam_from_rig=RigidTransform(
            put(rig.cam_from_rig.rotation, other.cam_from_rig.rotation, 3),
            put(rig.cam_from_rig.translation, other.cam_from_rig.translation, 2),
        ),
    )

"""`Calibration`: a recalibrated rig and the data behind it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from imgcal.association import Associations
from imgcal.estimation import (
    Estimate,
    FiducialOffset,
    PredictedError,
    estimate,
    predicted_error,
)
from imgcal.geometry import RigidTransform
from imgcal.monitoring import make_posterior
from imgcal.pipeline.clock_offset import LEAST_BETTER, LateCamera, timing_motion
from imgcal.pipeline.doubtful_cameras import DoubtfulCamera, doubtful_at_end
from imgcal.pipeline.exposure_delays import Delays
from imgcal.pipeline.initialization import Initialization
from imgcal.pipeline.label_counts import LabelCounts, count_labels
from imgcal.pipeline.lights import FoundLights
from imgcal.pipeline.object_checks import CERTAIN, find_displaced, find_lost_fiducials
from imgcal.pipeline.repeats import Repeats
from imgcal.pipeline.rests import Rests
from imgcal.pipeline.scale import KnownDistance, Scale, find_scale, remaining_tolerance
from imgcal.pipeline.synchronization import Unsynchronized
from imgcal.types import (
    BlobFlag,
    CalibrationObject,
    CameraRig,
    Detections,
    MovedCamera,
    Observations,
    RigPosterior,
)


@dataclass(frozen=True)
class Bend:
    """Deflection of a printed board's middle along x and y: mm, positive = away from the viewer."""

    x: float
    y: float
    x_sigma: float
    y_sigma: float

    @property
    def is_certain(self) -> bool:
        """Tell whether the board is certainly bent."""
        return max(abs(self.x) / self.x_sigma, abs(self.y) / self.y_sigma) > CERTAIN

    def __str__(self) -> str:
        """Describe it in words."""
        how = "bent" if self.is_certain else "flat, as far as can be told"
        return (
            f"the board is {how}: its middle is off by {self.x:+.2g} +- {self.x_sigma:.1g} mm along x and "
            f"{self.y:+.2g} +- {self.y_sigma:.1g} mm along y"
        )


@dataclass(frozen=True)
class Calibration:
    """A recalibrated rig and the data behind it. Snapshots are those used, in order.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> result = imgcal.calibrate(true_detections(truth), factory, obj)
        >>> float(result.before.rms) > 5, float(result.rms) < 0.01
        (True, True)
        >>> result.outliers, result.displaced, result.moved
        (0, (), ())
    """

    estimate: Estimate  # without batch axes: the rig, the poses, and their uncertainty
    labelled: Associations
    observations: Observations  # (S, C, N) as used: outliers not seen, sigma with the additive noise
    additive_noise: float  # px, noise of the residuals beyond the blobs' own sigma
    outliers: int  # labelled blobs left out
    prior_scale: Mapping[str, float]  # by kind of value: factor by which the prior was too narrow, if it was
    factory: CameraRig
    obj: CalibrationObject  # as given
    shape: tuple[FiducialOffset, ...] = ()  # estimated offset of each fiducial; empty = the object was taken as exact
    scale_sigma: float | None = None  # of the object's scale, relative, by the factory positions; None = unknown
    bent_sigma: float | None = None  # significance of a deviation from the estimated object; None = not tested
    block_length: int = 0  # snapshots per block whose scatter scales the covariance; 0 = scaled by the noise
    initialization: Initialization | None = None  # a network's first guess, if one was used
    guess_used: bool = False  # its guess fitted the images better than the factory calibration
    seconds: Mapping[str, float] = field(default_factory=dict)  # by stage
    moved: tuple[MovedCamera, ...] = ()  # during the capture; only snapshots after the moves are used
    from_scratch: bool = False  # no factory calibration: `factory` is a first rig from the same data
    late: tuple[LateCamera, ...] = ()  # whose frames, from some snapshot on, are of other moments; those are not used
    delays: Delays | None = None  # constant or evenly changing differences of exposure times, corrected
    unsynchronized: Unsynchronized | None = None  # unsynchronized cameras; None = no sign of them
    repeats: Repeats = Repeats()  # exact copies of earlier images; not used
    distance: KnownDistance | None = None  # between two cameras: defines the scale if nothing else does
    lights: FoundLights | None = None  # unknown markers: each used snapshot is one marker at one moment

    def __repr__(self) -> str:
        """Summarize: the rig, its error before and after, how the fiducials were identified."""
        before, after = float(self.before.rms), float(self.rms)
        used = "{} of {} snapshots".format(*self.labelled.moment_counts)
        return (
            f"{type(self).__name__}({self.rig!r}, RMS {before:.4g} -> {after:.2g} px, chi2/dof "
            f"{float(self.chi2_per_dof):.2f}, identity {self.identity}, {used})"
        )

    @property
    def rests(self) -> Rests:
        """Snapshots averaged with others, because they show the object at rest."""
        return Rests.of(self.labelled)

    @cached_property
    def rig(self) -> CameraRig:
        """The recalibrated rig with its uncertainty: the start of a running rig (`RigKeeper`)."""
        return replace(self.estimate.rig, posterior=self.posterior)

    def posterior(self) -> RigPosterior:
        """The joint posterior of the rig's values and the object's shape.

        Raises:
            RefusedError: the observations do not determine the poses.
        """
        return make_posterior(self.estimate, self.obj)

    @property
    def rig_from_object(self) -> RigidTransform:
        """The object's pose in each snapshot: (S,); if a row has several objects, see `poses_by_object`."""
        return self.estimate.rig_from_object

    @property
    def poses_by_object(self) -> Mapping[str, Mapping[str, RigidTransform]]:
        """rig_from_object () by object name and snapshot name, mm, in the frame of the object's file."""
        parts = self.obj.each
        found: dict[str, dict[str, RigidTransform]] = {part.name: {} for part in parts}
        for snapshot, row in zip(self.labelled.snapshots, self.labelled.used_rows.tolist(), strict=True):
            if row < 0:
                continue
            rotation, translation = self.rig_from_object.rotation[row], self.rig_from_object.translation[row]
            origin = parts[snapshot.part].origin
            shift = translation if origin is None else translation - rotation @ origin.to(rotation)
            found[parts[snapshot.part].name][snapshot.name] = RigidTransform(rotation, shift)
        return found

    @property
    def points_object(self) -> Tensor:
        """The fiducials as estimated: (N, 3) mm; as given if the object is exact."""
        return self.estimate.points_object

    @property
    def residual(self) -> Tensor:
        """Predicted minus observed: (S, C, N, 2) pixels; zero where not seen."""
        return self.estimate.residual

    @property
    def rms(self) -> Tensor:
        """RMS length of the residuals of the seen fiducials, as OpenCV's calibrateCamera returns it: () pixels."""
        return self.estimate.rms

    @property
    def chi2_per_dof(self) -> Tensor:
        """About 1 if residuals match the noise and the prior: ()."""
        return self.estimate.chi2_per_dof

    @cached_property
    def before(self) -> Estimate:
        """The factory rig on the same observations: only the poses are fitted."""
        return estimate(
            self.observations,
            self.factory,
            self.obj.as_exact(),
            self.rig_from_object,
            prior_std=torch.zeros_like(self.estimate.problem.prior_std[0]),
        )

    @property
    def bend(self) -> Bend | None:
        """Deflection of a printed board; None = assumed to be as in its file."""
        board, modes = self.obj.board, self.estimate.modes
        if board is None or modes is None:
            return None
        std, known = board.warp_std, self.estimate.mode_covariance(modes).diagonal().sqrt().numpy()
        (x, y), (dx, dy), (sx, sy) = board.bend, (std * modes.offset).tolist(), (std * known).tolist()
        return Bend(x + dx, y + dy, sx, sy)

    @cached_property
    def object(self) -> CalibrationObject:
        """The object as estimated, with the tolerances that remain: what a later calibration starts from."""
        board, bend = self.obj.board, self.bend
        if board is not None and bend is not None:
            board = replace(board, bend=(bend.x, bend.y), warp=max(bend.x_sigma, bend.y_sigma))
        tolerance = remaining_tolerance(self.estimate, self.shape)
        return replace(self.obj.as_exact(), points=self.points_object.detach(), board=board, tolerance=tolerance)

    @property
    def displaced(self) -> tuple[FiducialOffset, ...]:
        """Fiducials that are certainly displaced, except lost ones, whose estimates rest on a few odd labels."""
        return tuple(d for d in find_displaced(self.shape, self.obj) if d.fiducial not in self.lost)

    @cached_property
    def lost(self) -> tuple[int, ...]:
        """Fiducials that were hardly found although the others were."""
        points = self.rig_from_object.apply(self.points_object)
        visible = self.rig.expand(len(points)).project(points, self.obj.radius).visible
        return find_lost_fiducials(self.observations.seen.numpy(), visible.numpy() & self.labelled.columns(self.obj))

    @property
    def untimed(self) -> tuple[str, ...]:
        """Cameras with too little motion in view to detect frames of other moments.

        Empty for several unknown markers: held-out snapshots have checked every camera, and no marker can be tracked
        from one snapshot to the next.
        """
        if self.lights is not None and len(self.labelled.used) > self.labelled.moment_counts[0]:
            return ()
        seen = self.observations.seen
        moved = timing_motion(self.observations.uv, seen, self.labelled.before_rows)
        shown = seen.any(0).any(-1)
        names = zip(self.rig.camera_names, moved.tolist(), shown.tolist(), strict=True)
        return tuple(name for name, motion, is_shown in names if is_shown and motion < LEAST_BETTER)

    @cached_property
    def tally(self) -> LabelCounts:
        """What each camera saw in each snapshot, those of a rest included, and how much of it is explained."""
        labelled, seen, poses = self.labelled, self.observations.seen.numpy(), self.rig_from_object
        if labelled.rests_with:
            row, detections = labelled.used_rows, labelled.detections
            shown = np.zeros((len(row), *seen.shape[1:]), dtype=np.bool_)
            named = np.flatnonzero(detections.fiducial >= 0)
            shown[detections.snapshot[named], detections.camera[named], detections.fiducial[named]] = True
            frames = row >= 0
            seen, poses = shown[frames] & seen[row[frames]], poses[row[frames]]
            labelled = replace(labelled, rests_with={})
        return count_labels(labelled, seen, poses, self.factory, self.object, self.estimate.rig)

    @cached_property
    def doubtful(self) -> tuple[DoubtfulCamera, ...]:
        """Cameras that stop fitting at the end: if they were bumped there, the present rig differs from this one."""
        names = tuple(snapshot.name for snapshot in self.labelled.snapshots)
        return doubtful_at_end(self.tally, self.rig.camera_names, names)

    @property
    def labelled_detections(self) -> Detections:
        """All blobs with their labels; outliers have the flag `BlobFlag.OUTLIER`.

        The label of an unknown marker holds at its moment only; beside known objects it has none.
        """
        detections, used = self.labelled.detections, self.labelled.used
        row = np.full(len(self.labelled.snapshots), -1)
        row[used] = np.arange(len(used))
        s, c, n = row[detections.snapshot], detections.camera, detections.fiducial
        outlier = (s >= 0) & (n >= 0)
        outlier[outlier] = ~self.observations.seen.numpy()[s[outlier], c[outlier], n[outlier]]
        marked = detections.flags | np.where(outlier, int(BlobFlag.OUTLIER), 0).astype(np.uint8)
        found = replace(detections, flags=marked)
        if self.lights is not None:
            return self.lights.to_moments(found)
        if self.obj.has_lights:
            found = replace(found, fiducial=np.where(n == self.obj.num_fiducials - 1, -1, n))
        return replace(self.labelled, detections=found).by_moment()

    @cached_property
    def predicted_error(self) -> PredictedError:
        """Predicted error of the rig over the working volume."""
        return predicted_error(self.estimate)

    @cached_property
    def scale(self) -> Scale:
        """What the rig's scale is based on, and the effect of an error in the object's file."""
        if self.distance is not None:
            return self.distance.scale
        return find_scale(self.estimate, self.obj, self.scale_sigma, self.predicted_error.volume)

    @property
    def detectors(self) -> Mapping[str, int]:
        """Number of used snapshots by the detector of their fiducials: `classical` (blobs), or a proposer's name."""
        return Counter(self.labelled.snapshots[s].found_by for s in self.labelled.used)

    @property
    def identity(self) -> str:
        """coded | unique | by_prior | by_tracking | ambiguous."""
        return self.labelled.identity

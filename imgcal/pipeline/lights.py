"""Unknown markers: any blob may be one. Find which blobs belong together, and verify the result.

It proves nothing that labels fit the rig made from them: dense markers fit many rigs. The proof is in held-out moments
and cameras: the markers found by the other cameras must coincide with blobs of the camera far more often than by
chance, and near misses must be rare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import (
    Associations,
    Lights,
    SnapshotIdentity,
    align_camera,
    align_rig,
    associate_lights,
    background_rows,
    image_error,
    predicted_misses,
)
from imgcal.errors import RefusedError
from imgcal.estimation import Estimate, EstimationOptions, estimate, robust_std
from imgcal.geometry import RigidTransform
from imgcal.messages import name_cameras
from imgcal.pipeline.light_motion import require_steady_cameras
from imgcal.pipeline.turned_images import compare_turns
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations, RigPrior

HELD_OUT = 4
"""Number of moments of which one is held out from the trial rig."""
MOST_ROWS = 500
"""Maximum number of markers in an intermediate fit: those that most cameras see, evenly over the moments."""
LEAST_ROWS = 12
"""Minimum number of markers for an intermediate fit."""
FINEST = 0.4
"""px: final error of rig and blobs in the association."""
AFTER_ALIGNMENT = 3.0
"""px: the same after the rig has been aligned to unlabelled blobs."""
NARROWER = 0.55
"""Maximum ratio of this error between successive rounds."""
JOINED, LOST = 3, 0.6
"""Number of times that lost cameras are realigned, and the share of the usual number of markers that defines them."""
SPREAD = (0.0, 0.0, 0.5, 0.5)
"""Spread of the rigs at which the search starts, in standard deviations of the factory's prior; each start uses other
moments."""
STARTS = len(SPREAD)
NEAR, FAR = 4.0, 24.0
"""Standard deviations within which a blob is at a predicted marker, and within which it is a near miss."""
LEAST_PREDICTED = 10
"""Minimum number of predicted markers for judging a camera."""
LEAST_SHARE = 0.25
"""Minimum share of a camera's predicted markers with a blob in place, corrected for chance ..."""
HIDDEN_SHARE, LEAST_FOUND = 0.12, 8.0
"""... or this share, if it is at least this many markers: a body hides the markers on its other side."""
LEAST_NEAR = 0.8
"""Minimum share, among blobs near predicted markers, of those in place; corrected for chance."""
LEAST_MARGIN = 5.0
"""Log odds of a marker beside known objects against the best other one that takes one of its blobs."""
MOST_TESTED = 40
"""Maximum number of held-out moments to test, camera by camera."""


@dataclass(frozen=True)
class Agreement:
    """How well markers found by the other cameras coincide with each camera's blobs, in held-out moments."""

    predicted: NDArray[np.int64]  # (C,) markers in view of the camera, found by the others
    found: NDArray[np.float64]  # (C,) share of these with a blob in place, corrected for chance
    near_misses: NDArray[np.float64]  # (C,) share of these with a blob nearby, corrected for chance

    def __add__(self, other: Agreement) -> Agreement:
        """Count both."""
        predicted = self.predicted + other.predicted
        share = self.predicted / np.maximum(predicted, 1)
        found = share * self.found + (1 - share) * other.found
        return Agreement(predicted, found, share * self.near_misses + (1 - share) * other.near_misses)

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Which cameras can be judged: (C,)."""
        return self.predicted >= LEAST_PREDICTED

    @property
    def agrees(self) -> NDArray[np.bool_]:
        """Which cameras agree with the others: (C,)."""
        near = self.found >= LEAST_NEAR * (self.found + np.maximum(self.near_misses, 0))
        many = (self.found >= HIDDEN_SHARE) & (self.found * self.predicted >= LEAST_FOUND)
        return self.judged & ((self.found >= LEAST_SHARE) | many) & near

    @property
    def score(self) -> float:
        """One number for comparing rigs: mean share found over the cameras; 0 for those that cannot be judged."""
        return float(np.where(self.judged, self.found - np.maximum(self.near_misses, 0), 0.0).mean())


@dataclass(frozen=True)
class FoundLights:
    """Unknown markers of some moments as the estimate needs them: a row is one marker at one moment."""

    labelled: Associations  # its snapshots are the rows, each named after its moment
    detections: Detections  # all blobs of all moments
    blob: NDArray[np.int64]  # (K,) index, in `detections`, of each blob of `labelled`
    background: NDArray[np.bool_]  # (M,) blobs that never move in their image
    agreement: Agreement
    starts: int  # number of starts tried; 0 = the given rig was right

    @property
    def background_of(self) -> NDArray[np.int64]:
        """Number of blobs of each camera that never move: (C,)."""
        return self._count(self.background)

    @property
    def left_over(self) -> NDArray[np.int64]:
        """Number of blobs of each camera that move and are in no marker: (C,)."""
        free = self.detections.usable & ~self.background
        free[self.blob] = False
        return self._count(free)

    @property
    def note(self) -> str:
        """Describe what is left out as background; empty if nothing is."""
        counts = self.background_of
        parts = [f"{counts[c]} in {name}" for c, name in enumerate(self.detections.camera_names) if counts[c]]
        return f"blobs that never move are taken for background and left out: {', '.join(parts)}" if parts else ""

    def to_moments(self, rows: Detections) -> Detections:
        """Merge the blobs of rows, possibly without labels, with all others.

        A label is the number of a marker at its moment: the same number at another moment is not the same marker.
        """
        fiducial, flags = np.full(len(self.detections), -1), self.detections.flags.copy()
        names = [snapshot.name for snapshot in self.labelled.snapshots]
        number = np.zeros(len(names), dtype=np.int64)
        for row in range(1, len(names)):
            number[row] = number[row - 1] + 1 if names[row] == names[row - 1] else 0
        fiducial[self.blob] = np.where(rows.fiducial >= 0, number[rows.snapshot], -1)
        flags[self.blob] = rows.flags
        return replace(self.detections, fiducial=fiducial, flags=flags)

    def _count(self, rows: NDArray[np.bool_]) -> NDArray[np.int64]:
        return np.bincount(self.detections.camera[rows], minlength=len(self.detections.camera_names))


def find_lights(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> FoundLights:
    """Find the markers of each moment with a factory rig that may be off by more than the spacing of the markers.

    Args:
        detections: blobs of all moments; labels are ignored.
        rig: the factory rig, float64.
        obj: one point.

    Raises:
        RefusedError: the blobs cannot be associated.
    """
    background = background_rows(detections)
    moving = detections.select(~background)
    verified, agreement, starts = _verified_rig(moving, rig, obj)
    found = associate_lights(moving, verified, even_error(rig))
    if not len(found):
        raise RefusedError(NOTHING)
    blob = np.flatnonzero(~background)[found.row[found.row >= 0]]
    labelled = replace(rows_of_lights(found, moving), rig=verified)
    return FoundLights(labelled, detections, blob, background, agreement, starts)


def rows_of_lights(lights: Lights, detections: Detections) -> Associations:
    """Make a row of each marker at each moment; it has the name of the moment, and only the marker's blobs.

    A moment without a marker becomes a refused row.
    """
    empty = np.setdiff1d(np.arange(len(detections.snapshot_names)), lights.moment)
    moments = np.concatenate((lights.moment, empty))
    order = np.argsort(moments, kind="stable")
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    marker, camera = np.nonzero(lights.row >= 0)
    blobs = detections.select(lights.row[marker, camera])
    names = tuple(detections.snapshot_names[moment] for moment in moments[order])
    labels = np.zeros(len(marker), dtype=np.int64)
    blobs = replace(blobs, snapshot=number[marker], fiducial=labels, snapshot_names=names)
    found = _rows_of_found(lights, detections.snapshot_names)
    snapshots = tuple(
        found[k] if k < len(lights) else SnapshotIdentity(name, "refused", NO_MARKER, 0, None, moment=moment)
        for name, k, moment in zip(names, order.tolist(), moments[order].tolist(), strict=True)
    )
    return Associations(blobs, snapshots)


def add_lights(labelled: Associations, rig: CameraRig, obj: CalibrationObject) -> Associations | None:
    """Add a row for each unknown marker beside known objects, by the rig that these have calibrated.

    Args:
        labelled: rows of the known objects.
        rig: as they have it; no unknown marker took part in it.
        obj: several objects, the last of them unknown markers.

    Returns:
        All rows; None where no marker is found, or some camera does not agree with the others on them.
    """
    blobs = labelled.by_moment()
    free = np.flatnonzero(blobs.usable & (blobs.fiducial < 0))
    free = free[~background_rows(blobs.select(free))]
    left = blobs.select(free)
    agreement = measure_agreement(left, rig)
    lights = associate_lights(left, rig, even_error(rig))
    lights = lights.select(lights.margin >= LEAST_MARGIN)
    if not len(lights) or bool((agreement.judged & ~agreement.agrees).any()):
        return None
    moments, part = labelled.moments, len(obj.parts) - 1
    order = np.argsort(np.concatenate((moments, lights.moment)), kind="stable")  # known objects first
    number = np.argsort(order)
    fiducial, row = blobs.fiducial.copy(), number[labelled.detections.snapshot]
    light, camera = np.nonzero(lights.row >= 0)
    own = free[lights.row[light, camera]]
    row[own], fiducial[own] = number[len(moments) + light], obj.num_fiducials - 1
    snapshots = [*labelled.snapshots]
    snapshots += _rows_of_found(lights, blobs.snapshot_names, part)
    names = tuple(snapshots[at].name for at in order)
    table = replace(blobs, snapshot=row, fiducial=fiducial, snapshot_names=names)
    return Associations(table, tuple(snapshots[at] for at in order))


def _rows_of_found(lights: Lights, names: Sequence[str], part: int = 0) -> list[SnapshotIdentity]:
    """What is known of each marker at its moment."""
    eye, points = torch.eye(3, dtype=torch.float64), torch.from_numpy(lights.point).double()
    return [
        SnapshotIdentity(
            names[moment], "unique", f"{cameras} cameras agree", 1, RigidTransform(eye, point), moment=moment, part=part
        )
        for moment, cameras, point in zip(lights.moment.tolist(), lights.cameras.tolist(), points, strict=True)
    ]


def even_error(rig: CameraRig, pixels: float = FINEST) -> NDArray[np.float64]:
    """Assume the same error for every camera, px: (C,)."""
    return np.full(rig.num_cameras, pixels)


def _verified_rig(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> tuple[CameraRig, Agreement, int]:
    """Find the rig on which held-out moments and cameras agree.

    Raises:
        RefusedError: there is none, or another one explains the blobs equally well.
        MovedError: a camera moved, so that none is right for all moments.
    """
    std = (rig.prior or RigPrior()).std(rig)
    generator = torch.Generator().manual_seed(0)
    factory = measure_agreement(detections, rig)  # no moment took part in it
    if bool(factory.agrees.all()):
        return rig, factory, 0
    best, best_rig = factory if factory.judged.any() else None, rig
    for start in range(STARTS):
        random = torch.randn(std.shape, generator=generator, dtype=std.dtype)
        trial, agreement = _try_start(detections, rig, rig.retract(SPREAD[start] * random * std), obj, start)
        if trial is not None and agreement is not None and bool(agreement.agrees.all()):
            return trial, agreement, start + 1
        if agreement is not None and (best is None or agreement.score > best.score):
            best, best_rig = agreement, trial or rig
    if best is not None:
        _require_upright_images(best, detections, rig, best_rig)
        found = associate_lights(detections, best_rig, even_error(rig))
        require_steady_cameras(detections, found.moment, found.point, found.row >= 0, best_rig)
    fewer, carry = "show fewer markers at once, or one light alone; ", "carry one light around and "
    if _is_one_light(detections):
        fewer = carry = ""
    wider = f"{fewer}if cameras may have moved farther than the rig's prior says, "
    raise _refusal(
        best,
        rig,
        python=f"{wider}widen it: replace(rig, prior=RigPrior(...))",
        command=f"{wider}write larger values under `prior` in the rig file, or {carry}use --cameras",
    )


def _is_one_light(detections: Detections) -> bool:
    """Tell whether most images that show anything show one blob."""
    count = np.unique(detections.snapshot * len(detections.camera_names) + detections.camera, return_counts=True)[1]
    return len(count) > 0 and float(np.median(count)) <= 1


def _require_upright_images(agreement: Agreement, detections: Detections, factory: CameraRig, rig: CameraRig) -> None:
    """Refuse if a camera that does not agree with the others would do so if its image were turned.

    Raises:
        RefusedError: names the camera.
    """
    bad = np.flatnonzero(agreement.judged & ~agreement.agrees).tolist()
    for camera in bad if len(bad) <= agreement.agrees.sum() else []:
        others = detections.select(detections.camera != camera)
        lights = associate_lights(others, rig, even_error(rig), least_cameras=min(3, rig.num_cameras - 1))
        image = factory.project(torch.from_numpy(lights.point))
        seen = image.visible[camera].numpy()
        turned = compare_turns(detections, factory, camera, lights.moment[seen], image.uv[camera].numpy()[seen])
        if turned is not None and not turned.upright:
            raise turned.refusal()


def _try_start(
    detections: Detections, factory: CameraRig, first: CameraRig, obj: CalibrationObject, seed: int
) -> tuple[CameraRig | None, Agreement | None]:
    """Follow one start, and judge it by the moments that took no part.

    Where these show too little of some camera, others are held out in turn, each time from a rig of their own.

    Returns:
        The first of these rigs, and how well all of them agree with what they did not see; None = there is none.
    """
    rig: CameraRig | None = None
    agreement: Agreement | None = None
    for turn in range(HELD_OUT):
        learnt, tested = split_moments(detections, turn)
        trial = _refine_start(learnt, factory, first, obj, seed)
        if trial is None:
            return None, agreement
        part = measure_agreement(tested, trial)
        rig, agreement = rig or trial, part if agreement is None else agreement + part
        if agreement.judged.all() or (agreement.judged & ~agreement.agrees).any():
            break
    return rig, agreement


NO_MARKER = "no moving blobs of three cameras agree on a place"
"""Why a moment has no marker."""
NOTHING = (
    "unknown markers: no blobs of three cameras agree on places: the rig is farther off than its prior allows, or the "
    "markers are too many or too few"
)


def split_moments(detections: Detections, turn: int = 0) -> tuple[Detections, Detections]:
    """Part blobs by moments: those from which a rig is made, and those that take no part, other ones in each turn.

    Raises:
        RefusedError: there are too few moments.
    """
    held = (np.arange(len(detections.snapshot_names)) + turn) % HELD_OUT == HELD_OUT - 1
    if held.sum() < 2:
        raise RefusedError(
            f"unknown markers: found {len(held)} snapshots, expected at least {2 * HELD_OUT}: some are held out "
            "to verify the result"
        )
    return detections.select(~held[detections.snapshot]), detections.select(held[detections.snapshot])


def require_agreement(agreement: Agreement, rig: CameraRig) -> None:
    """Refuse if held-out moments and cameras do not agree.

    Raises:
        RefusedError: names the cameras, and how far they are from agreement.
    """
    if not bool(agreement.agrees.all()):
        advice = "carry one light alone through the view of all cameras"
        raise _refusal(agreement, rig, python=advice, command=advice)


def _refusal(agreement: Agreement | None, rig: CameraRig, *, python: str, command: str) -> RefusedError:
    """Name the cameras that do not agree with the others, or cannot be judged; the advice is for the former."""
    if agreement is None:
        return RefusedError(NOTHING, python=python, command=command)
    unjudged = [rig.camera_names[c] for c in np.flatnonzero(~agreement.judged)]
    if unjudged and not (agreement.judged & ~agreement.agrees).any():
        return RefusedError(
            f"unknown markers: {name_cameras(unjudged)}: in the held-out snapshots, the other "
            "cameras find "
            f"too few markers in its view to judge it by (expected {LEAST_PREDICTED}): capture more, or leave it out"
        )
    bad = np.flatnonzero(agreement.judged & ~agreement.agrees)
    worst = int(bad[np.argmin(agreement.found[bad])])
    return RefusedError(
        f"unknown markers: {name_cameras(rig.camera_names[c] for c in bad)}: of {agreement.predicted[worst]} "
        f"markers that the other cameras find in view of {rig.camera_names[worst]}, in held-out snapshots, "
        f"{100 * max(agreement.found[worst], 0):.0f} % have a blob in their place and "
        f"{100 * max(agreement.near_misses[worst], 0):.0f} % one beside it: which blobs belong together cannot be "
        "decided",
        python=python,
        command=command,
    )


def _refine_start(
    detections: Detections, factory: CameraRig, first: CameraRig, obj: CalibrationObject, seed: int
) -> CameraRig | None:
    """Refine one start: align the rig without labels, then alternate labelling and fitting with a shrinking error."""
    std = (factory.prior or RigPrior()).std(factory)
    now, _ = align_rig(detections, factory, std, first, seed)
    error = min(AFTER_ALIGNMENT, float(np.median(image_error(factory, std))))
    return narrow(detections, factory, std, now, obj, error, JOINED)


def narrow(
    detections: Detections,
    factory: CameraRig,
    std: Tensor,
    now: CameraRig,
    obj: CalibrationObject,
    error: float,
    joined: int,
) -> CameraRig | None:
    """Alternate labelling and fitting with a shrinking error.

    Args:
        detections: blobs of many moments.
        factory: the rig that the prior is about.
        std: (C, K) the prior.
        now: the initial rig.
        obj: one point.
        error: px, error of the initial rig.
        joined: number of times that cameras which show few of the markers are realigned.

    Returns:
        The rig; None = too few markers are found.
    """
    while True:
        found = associate_lights(detections, now, even_error(factory, error))
        lost = _find_lost_cameras(found, now) if joined > 0 else []
        joined -= 1
        if lost:
            for camera in lost:
                now = align_camera(detections, factory, std, now, camera, found)
            continue
        fit = _fit(found, detections, factory, std, now, obj)
        if fit is None or error == FINEST:
            return None if fit is None else fit.rig
        now = fit.rig
        spread = robust_std(fit.residual[fit.problem.root_weight[0] > 0])
        error = max(FINEST, min(NARROWER * error, 3 * spread))


def _find_lost_cameras(lights: Lights, rig: CameraRig) -> list[int]:
    """Cameras that show few of the markers in their view."""
    visible = rig.project(torch.from_numpy(lights.point)).visible.numpy()  # (C, R)
    shown = (lights.row >= 0).T & visible
    share = shown.sum(1) / np.maximum(visible.sum(1), 1)
    usual = float(np.median(share))
    return np.flatnonzero(share < LOST * usual).tolist()


def _fit(
    lights: Lights,
    detections: Detections,
    factory: CameraRig,
    std: Tensor,
    first: CameraRig,
    obj: CalibrationObject,
) -> Estimate | None:
    """Fit a rig to the markers that most cameras see; None = too few."""
    if len(lights) < LEAST_ROWS:
        return None
    turn = np.random.default_rng(0).random(len(lights))
    order = np.lexsort((turn, -np.minimum(lights.cameras, 5)))
    chosen = lights.select(np.sort(order[:MOST_ROWS]))
    seen = chosen.row >= 0
    uv = np.where(seen[..., None], detections.uv[np.maximum(chosen.row, 0)], 0.0)
    sigma = np.hypot(detections.sigma[np.maximum(chosen.row, 0)], 0.3)
    observations = Observations(*(torch.from_numpy(a[:, :, None]) for a in (uv, sigma, seen)))
    points = torch.from_numpy(chosen.point)
    poses = RigidTransform(torch.eye(3, dtype=points.dtype).expand(len(points), 3, 3), points)
    options = EstimationOptions(loss="cauchy", max_iterations=40)
    return estimate(observations, factory, obj, poses, prior_std=std, initial_rig=first, options=options)


def measure_agreement(detections: Detections, rig: CameraRig) -> Agreement:
    """Compare each camera's blobs with the markers found by all the others.

    Args:
        detections: blobs of held-out moments.
        rig: the rig to judge.
    """
    moments = np.unique(detections.snapshot)
    some = moments[np.linspace(0, len(moments) - 1, min(len(moments), MOST_TESTED)).astype(int)]
    blobs = detections.select(np.isin(detections.snapshot, some))
    error = even_error(rig)
    predicted = np.zeros(rig.num_cameras, dtype=np.int64)
    found, missed = np.zeros(rig.num_cameras), np.zeros(rig.num_cameras)
    for camera in range(rig.num_cameras):
        others = blobs.select(blobs.camera != camera)
        lights = associate_lights(others, rig, error, least_cameras=min(3, rig.num_cameras - 1))
        counts = predicted_misses(lights, blobs, rig, camera, error, NEAR, FAR)
        predicted[camera], found[camera], missed[camera] = counts
    return Agreement(predicted, found, missed)

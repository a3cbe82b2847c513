"""Turns a calibration, or a refusal, into what the report shows."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import imgcal
from imgcal.association import Associations, match_to_rig
from imgcal.cli.outcome import Findings
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.io import Frame
from imgcal.pipeline import EARLIER, Calibration, rms_length
from imgcal.report import NOT_IDENTIFIED, UNKNOWN_MARKERS, ReportContent, SnapshotSummary
from imgcal.types import CalibrationObject, CameraRig, Detections, MovedError

Pictures = Mapping[str, Frame | None]


def describe_refusal(
    refusal: RefusedError,
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    pictures: Pictures,
    seconds: dict[str, float],
) -> ReportContent:
    """Say why there is no calibration, beside what was seen."""
    moves: tuple[str, ...] = ()
    count, reason = len(detections.snapshot_names), refusal.for_command
    rejected = [reason if reason.startswith(NOT_IDENTIFIED) else ""] * count
    if isinstance(refusal, MovedError):
        moves = tuple(map(str, refusal.moved))
        rejected = [EARLIER] * (count - refusal.since) + [""] * refusal.since
        if refusal.labelled is not None:
            detections = refusal.labelled
    detections = match_to_rig(detections, rig)
    found = np.bincount(detections.snapshot, minlength=len(detections.snapshot_names))
    return ReportContent(
        title=f"Recalibration of {rig.name}",
        status="refused",
        reason=reason,
        identity="refused",
        factory=rig,
        detections=detections,
        labels=detections.fiducial,
        snapshots=tuple(
            SnapshotSummary(name, int(blobs), 0, why)
            for name, blobs, why in zip(detections.snapshot_names, found, rejected, strict=True)
        ),
        moves=moves,
        object_points=obj.points.double().numpy(),
        frames=tuple(pictures.get(name) for name in rig.camera_names) if pictures else (),
        seconds=seconds,
        command=_command(),
        versions=_versions(),
    )


def describe(
    calibration: Calibration,
    found: Findings,
    rig: CameraRig,
    pictures: Pictures,
    seconds: dict[str, float],
) -> ReportContent:
    """Lay a calibration out blob by blob, compared with the factory rig as the gauge of its motion says."""
    gauge = found.motion.gauge
    labelled, detections = calibration.labelled, calibration.labelled.detections
    before, sigma = _blob_residuals(calibration, calibration.before.residual)
    after, _ = _blob_residuals(calibration, calibration.residual)
    used = np.asarray(np.isfinite(after).all(1))
    seen = calibration.observations.seen
    return ReportContent(
        title=f"{'Calibration' if calibration.from_scratch else 'Recalibration'} of {rig.name}",
        status="ok",
        reason=_about_object(calibration),
        identity=calibration.identity if calibration.lights is None else UNKNOWN_MARKERS,
        factory=rig,
        detections=detections,
        labels=detections.fiducial,
        snapshots=summarize_snapshots(labelled, used),
        recalibrated=calibration.rig,
        predicted_before=before + detections.uv,
        predicted_after=after + detections.uv,
        sigma=sigma,
        std=found.motion.std.numpy(),
        prior_std=gauge.prior_std(rig.to(torch.float64), calibration.estimate.problem.prior_std[0]).numpy(),
        gauge=gauge,
        predicted=calibration.predicted_error,
        scale=str(calibration.scale),
        moves=tuple(map(str, calibration.moved)),
        late=tuple(map(str, calibration.late)),
        timing=tuple(str(one) for one in (calibration.delays, calibration.unsynchronized) if one is not None),
        rests=str(calibration.rests),
        doubtful=tuple(map(str, calibration.doubtful)),
        unknown=found.knowledge.sentences,
        advice=found.knowledge.advice,
        unexplained=calibration.tally.unexplained.sum(0),
        object_points=calibration.points_object.double().numpy(),
        rig_from_object=_poses(calibration),
        frames=tuple(pictures.get(name) for name in rig.camera_names) if pictures else (),
        frame_snapshots=tuple(np.flatnonzero(labelled.moments == labelled.moments[0]).tolist()),
        chi2_per_dof=float(calibration.chi2_per_dof),
        rms_before=(not calibration.from_scratch and rms_length(calibration.before.residual, seen)) or float("nan"),
        from_scratch=calibration.from_scratch,
        rms_after=rms_length(calibration.residual, seen) or float("nan"),
        seconds=seconds,
        command=_command(),
        versions=_versions(),
    )


def summarize_snapshots(labelled: Associations, used: NDArray[np.bool_]) -> tuple[SnapshotSummary, ...]:
    """Count the blobs of each snapshot of the input, in all its rows; `used`: those of the estimate (M,)."""
    _, first, number = np.unique(labelled.moments, return_index=True, return_inverse=True)
    row = labelled.detections.snapshot
    found, taken = (np.bincount(number[rows], minlength=len(first)) for rows in (row, row[used]))
    kept = set(number[labelled.used_rows >= 0].tolist())
    return tuple(
        SnapshotSummary(
            labelled.snapshots[at].name,
            int(found[i]),
            int(taken[i]),
            "" if i in kept else labelled.snapshots[at].reason,
        )
        for i, at in enumerate(first)
    )


def _about_object(calibration: Calibration) -> str:
    """Name the fiducials that are not in their places, and those that were not found."""
    words = []
    if calibration.from_scratch:
        words.append(
            "There was no factory calibration: what this page calls the factory calibration is a first rig made from "
            "the same data."
        )
    if calibration.displaced:
        parts = [f"fiducial {d.fiducial} is {d.distance:.3g} ± {d.sigma:.1g} mm off" for d in calibration.displaced]
        words.append(
            f"The object differs from its file: {', '.join(parts)}. It was estimated with the rig; "
            "object.csv beside this page holds it."
        )
    if calibration.lost:
        which = ", ".join(map(str, calibration.lost))
        words.append(
            f"Fiducial {which} was rarely found where the others were: missing, hidden, or not where the object file "
            "puts it."
        )
    return " ".join(words)


def _blob_residuals(calibration: Calibration, residual: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Residual (M, 2) and sigma (M,) of each blob, nan where it was not used; residual is (S, C, N, 2)."""
    detections, seen = calibration.labelled.detections, calibration.observations.seen.numpy()
    s, c, n = calibration.labelled.used_rows[detections.snapshot], detections.camera, detections.fiducial
    valid = (s >= 0) & (n >= 0)
    valid[valid] = seen[s[valid], c[valid], n[valid]]
    where = s[valid], c[valid], n[valid]
    by_blob, sigma = np.full((len(detections), 2), np.nan), detections.sigma.copy()
    # The estimate has the average of a rest; the residual of each of its blobs is its own.
    by_blob[valid] = residual.numpy()[where] + (calibration.observations.uv.numpy()[where] - detections.uv[valid])
    sigma[valid] = calibration.observations.sigma.numpy()[where]
    return by_blob, sigma


def _poses(calibration: Calibration) -> RigidTransform:
    rows = calibration.labelled.used_rows
    used, poses = np.flatnonzero(rows >= 0), calibration.rig_from_object[rows[rows >= 0]]
    rotation, translation = torch.full((len(rows), 3, 3), torch.nan), torch.full((len(rows), 3), torch.nan)
    rotation[used], translation[used] = poses.rotation.float(), poses.translation.float()
    return RigidTransform(rotation.double(), translation.double())


def _command() -> str:
    return " ".join(["imgcal", *sys.argv[1:]])


def _versions() -> dict[str, str]:
    return {"imgcal": imgcal.__version__, "PyTorch": torch.__version__, "Python": platform.python_version()}

"""The result in plain words: what was found, whether to trust it, what to do next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from imgcal.messages import list_names
from imgcal.pipeline import DOUBTFUL, MOVED
from imgcal.report.accuracy import advice, length, sentences
from imgcal.report.charts import duration
from imgcal.report.content import NOT_IDENTIFIED, UNKNOWN_MARKERS, ReportContent
from imgcal.report.svg import group_digits, pixels

CROWDED = 1.0
"""Blobs without a label, as a share of the used ones, from which the report mentions them."""
GOOD_CHI2 = 1.5  # above, the residuals are larger than the stated noise
SMALL_CHI2 = 0.5  # below, the noise was overstated
MOST_FIGURES = 6  # at the top of the page: one row
FEW_OBSERVATIONS = 15  # of a camera: fewer than its parameters
ABOUT_OBJECT = ("object:", "estimation: the object", "estimation: fiducial")
"""Refusals that begin so found that the object is not what its file says."""
IDENTITY = {
    "coded": "The fiducials came labelled with the input.",
    "unique": "Every fiducial was recognized, and only one labelling explains what the cameras saw.",
    "by_prior": "The given pose decided between look-alike orientations of the object.",
    "by_tracking": "The labels were carried from snapshot to snapshot; the motion excluded look-alike positions.",
    UNKNOWN_MARKERS: "Nothing was known about the markers; held-out snapshots confirm the rig that they gave.",
    "ambiguous": (
        "The object is symmetric, so its absolute orientation is unknown. All cameras use the same "
        "choice, so the rig is valid."
    ),
}
_CHECK = "Check the new rig on snapshots that took no part here: imgcal score CAPTURE --rig rig.yaml --object OBJECT."
_FIRST = "Then use rig.yaml as the factory file from now on."
_KEEP = "Then use rig.yaml in place of the factory file; keep the factory file for the next recalibration."


def unexplained_sentences(content: ReportContent) -> list[tuple[str, str]]:
    """Reasons for doubt, each with a remedy."""
    notes = [
        (
            f"During the capture {move}: only the snapshots since the last move are used.",
            "Fasten what has moved. For a better known rig, capture more snapshots now.",
        )
        for move in content.moves
    ]
    notes += [
        (
            f"{words[:1].upper()}{words[1:]}.",
            "Trigger the cameras together, or hold the object still for each snapshot.",
        )
        for words in content.timing
    ]
    notes += [
        (f"{words[:1].upper()}{words[1:]}; these took no part.", "Export all frames of that camera again.")
        for words in content.late
    ]
    notes += [
        (
            f"{words[:1].upper()}{words[1:]}.",
            "Capture some more snapshots and calibrate again: a camera that was bumped will be off in all of them.",
        )
        for words in content.doubtful
    ]
    used = content.observations
    blobs = content.detections.count_by_camera()
    if content.unexplained is not None:
        for camera in np.flatnonzero(content.unexplained > DOUBTFUL * np.maximum(content.unexplained + used, 1)):
            name = content.cameras[camera]
            notes.append((
                f"{name}: {content.unexplained[camera]} blobs may be fiducials but are not where fiducials should be; "
                f"{used[camera]} are.",
                f"Look at the overlay of {name}: reflections where the object is hidden are harmless; a pattern beside "
                "its place means that the camera has moved, or is late.",
            ))  # fmt: skip
    crowded = [content.cameras[i] for i in np.flatnonzero(blobs - used > CROWDED * np.maximum(used, 10))]
    if crowded:
        notes.append((
            f"More blobs without a label than with one in {list_names(crowded)}.",
            "Cover or mask reflections there.",
        ))  # fmt: skip
    return notes


@dataclass(frozen=True)
class KeyFigure:
    """One number at the top of the page."""

    value: str
    name: str
    note: str = ""


@dataclass(frozen=True)
class Verdict:
    """The top of the page."""

    level: Literal["good", "caution", "refused"]
    headline: str
    found: tuple[str, ...]
    reservations: tuple[str, ...]
    unknown: tuple[str, ...]
    next_steps: tuple[str, ...]
    figures: tuple[KeyFigure, ...]


def judge(content: ReportContent) -> Verdict:
    """Summarize the result in words."""
    if content.status == "refused" or content.recalibrated is None:
        return _refused_verdict(content)
    reservations = _reservations(content)
    identity = IDENTITY.get(content.identity, f"Identity: {content.identity}.")
    found = (_improvement(content), *sentences(content), *_movement(content), identity)
    if content.rests:
        found = (*found, f"{content.rests}.")
    if content.reason:
        found = (*found, content.reason)
    further = (*advice(content), *([content.advice] if content.advice else []))
    if reservations:
        return Verdict(
            "caution", "Recalibrated, with reservations", found, tuple(r for r, _ in reservations), content.unknown,
            (*dict.fromkeys(step for _, step in reservations if step), *further, _CHECK), _figures(content),
        )  # fmt: skip
    where = " where the object was seen" if content.unknown else ""
    done = "Calibrated" if content.from_scratch else "Recalibrated"
    headline = f"{done}{where}: the result explains the images as well as the measurement noise allows"
    keep = _FIRST if content.from_scratch else _KEEP
    return Verdict("good", headline, found, (), content.unknown, (*further, _CHECK, keep), _figures(content))


def _improvement(content: ReportContent) -> str:
    after = f"{pixels(content.rms_after)} px"
    if not math.isfinite(content.rms_before):
        return f"The reprojection error is {after} (RMS)."
    return f"The reprojection error went from {pixels(content.rms_before)} px to {after} (RMS)."


def _movement(content: ReportContent) -> tuple[str, ...]:
    """Name the cameras that moved most."""
    if content.change is None or content.std is None or content.from_scratch:
        return ()
    if len(content.cameras) == 1:
        return ("One camera: only its own lens and sensor values can have changed.",)
    angle = np.degrees(np.linalg.norm(content.change[:, :3], axis=1))
    shift = np.linalg.norm(content.change[:, 3:6], axis=1)
    moved = content.moved[:, :6].any(axis=1)
    reference = content.reference
    since = "since the factory calibration" if reference is None else f"relative to {content.cameras[reference]}"
    if not moved.any():
        return (f"No camera moved measurably {since} (within {MOVED:g} standard deviations).",)
    by_size = np.argsort(-np.where(moved, angle + shift / 10, -1))[: min(3, int(moved.sum()))]
    parts = [f"{content.cameras[i]} ({angle[i]:.2f}°, {shift[i]:.1f} mm)" for i in by_size]
    count = len(content.cameras) - (reference is not None)
    words = f"{int(moved.sum())} of {count} cameras moved {since}"
    return (f"{words}, most of all {', '.join(parts)}.",)


def _reservations(content: ReportContent) -> list[tuple[str, str]]:
    """Reasons for doubt, each with a remedy."""
    notes = unexplained_sentences(content)
    if content.chi2_per_dof > GOOD_CHI2:
        larger = math.sqrt(content.chi2_per_dof)
        notes.append((
            f"The errors are about {larger:.1f} times as large as the noise of the detections (chi² per degree of "
            f"freedom {content.chi2_per_dof:.2f}): the model lacks something, or some labels are wrong, and the true "
            "uncertainties are larger than those stated below.",
            "Look at the residuals and overlays below: one bad camera, fiducial or snapshot stands out. Check the "
            "object's measurements and the factory file.",
        ))  # fmt: skip
    elif content.chi2_per_dof < SMALL_CHI2:
        notes.append((
            f"The errors are smaller than the stated noise (chi² per degree of freedom {content.chi2_per_dof:.2f}): "
            "the uncertainties below are too cautious.",
            "",
        ))  # fmt: skip
    if content.rms_after > content.rms_before:
        notes.append(("The error did not fall.", "Check that factory file, object file and capture belong together."))
    blind = [name for name, n in zip(content.cameras, content.observations, strict=True) if n == 0]
    if blind:
        notes.append((
            f"No usable observations in {list_names(blind)}: not recalibrated, factory values kept.",
            f"Bring the object into the view of {list_names(blind)} and check exposure and cabling.",
        ))  # fmt: skip
    few = [name for name, n in zip(content.cameras, content.observations, strict=True) if 0 < n < FEW_OBSERVATIONS]
    if few:
        notes.append((f"Few observations in {list_names(few)}.", "Capture more snapshots, seen by all cameras."))
    rejected = sum(bool(s.reason) for s in content.snapshots)
    if rejected > 0.2 * max(len(content.snapshots), 1):
        notes.append((
            f"{rejected} of {len(content.snapshots)} snapshots were rejected.",
            "Read the reasons under “Snapshots”; often reflections, blur or an object half out of view.",
        ))  # fmt: skip
    share = _undetermined_share(content)
    given = "what was assumed" if content.from_scratch else "the factory's value"
    if share > 0.25:
        notes.append((
            f"{100 * share:.0f} % of the parameters are not determined by these data (see “How well known”): there, "
            f"the result is {given}.",
            "Capture more snapshots, with the object near the image corners, tilted, and at several distances.",
        ))  # fmt: skip
    return notes


def _undetermined_share(content: ReportContent) -> float:
    free = int((~content.fixed).sum())
    return int(content.undetermined.sum()) / free if free else 0.0


def _figures(content: ReportContent) -> tuple[KeyFigure, ...]:
    total, used = len(content.snapshots), sum(not s.reason for s in content.snapshots)
    moved, count = int(content.moved[:, :6].any(axis=1).sum()), len(content.cameras) - (content.reference is not None)
    before = f"{pixels(content.rms_before)} → " if math.isfinite(content.rms_before) else ""
    note = "RMS, before → after" if before else "RMS"
    figures = [
        KeyFigure(f"{before}{pixels(content.rms_after)} px", "reprojection error", note),
        KeyFigure(f"{content.chi2_per_dof:.2f}", "chi² per dof", "1: as expected from the noise"),
        KeyFigure(f"{used} / {total}", "snapshots used"),
        KeyFigure(f"{group_digits(int(content.used.sum()))} / {group_digits(len(content.detections))}", "blobs used"),
    ]
    predicted = content.predicted
    if predicted is not None and math.isfinite(predicted.median_mm):
        note = f"predicted; 95 %: {length(predicted.p95_mm)}"
        figures.insert(1, KeyFigure(length(predicted.median_mm), "error in the volume", note))
    if len(content.cameras) > 1 and not content.from_scratch:
        figures.append(KeyFigure(f"{moved} / {count}", "cameras moved", f"beyond {MOVED:g} std"))
    if content.seconds and len(figures) < MOST_FIGURES:
        figures.append(KeyFigure(duration(sum(content.seconds.values())), "computing time"))
    return tuple(figures)


def _refused_verdict(content: ReportContent) -> Verdict:
    d = content.detections
    blobs = d.count_by_camera()
    labelled = int((content.labels >= 0).sum())
    total = len(content.snapshots)
    used = sum(not s.reason for s in content.snapshots)
    about_all = not content.moves and not content.reason.startswith(NOT_IDENTIFIED)
    figures = [
        KeyFigure(group_digits(total), "snapshots")
        if about_all
        else KeyFigure(f"{used} / {total}", f"snapshots {'since the last move' if content.moves else 'accepted'}"),
        KeyFigure(group_digits(len(d)), "blobs found"),
        *([KeyFigure(group_digits(labelled), "blobs labelled")] if content.reason.startswith(NOT_IDENTIFIED) else []),
        KeyFigure(f"{int((blobs > 0).sum())} / {len(blobs)}", "cameras with blobs"),
    ]
    if content.seconds:
        figures.append(KeyFigure(duration(sum(content.seconds.values())), "computing time"))
    headline = "Refused: the data cannot decide the calibration"
    reason = content.reason or "The data do not decide between several answers."
    found = (reason, "No calibration was written; keep the one in use.")
    return Verdict("refused", headline, found, (), (), tuple(_helpful(content)), tuple(figures))


def _helpful(content: ReportContent) -> list[str]:
    """Advise what would help a refused run, as far as the detections show."""
    if content.moves:
        return [
            "Fasten what has moved, and capture again.",
            "Look at the frames of that camera before and after: a hand or a reflection in front of it, or a frame of "
            "another moment, can look like a motion.",
        ]
    blobs = content.detections.count_by_camera()
    total, labelled = len(content.detections), int((content.labels >= 0).sum())
    blind = [name for name, n in zip(content.cameras, blobs, strict=True) if n == 0]
    steps = []
    if total == 0:
        steps.append("No blob was found: check exposure, infrared light, and the polarity (bright or dark markers).")
    elif blind:
        steps.append(f"Nothing was found in {list_names(blind)}: check exposure, cabling and the view.")
    if labelled < 0.5 * total and content.reason.startswith(NOT_IDENTIFIED):
        steps.append(
            f"{group_digits(total - labelled)} of {group_digits(total)} blobs could not be labelled: cover or "
            "mask reflections, "
            "and check that the object file is that of the object in the images."
        )
    if content.reason.startswith(ABOUT_OBJECT):
        return [
            *steps,
            "Check that the object file is that of the object in the images, and that it was the same object "
            "throughout; measure it again.",
        ]
    steps.append("Check that the factory file belongs to this rig and that no camera was exchanged.")
    steps.append("Capture more snapshots, the whole object in view of as many cameras as possible, in varied poses.")
    return steps

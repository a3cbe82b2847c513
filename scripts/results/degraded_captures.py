"""Compare detectors on real frames, original and degraded.

    IMGCAL_CAPTURES=... python -m scripts.results.degraded_captures

Every detector calibrates from the same degraded frames. The result is scored on points of the original frames that were
not used for the factory rig. It is wrong if its RMS error there is more than a pixel and more than five times that of
`classical` on the original frames. Earlier measurements stay in the JSON: another call adds or replaces detectors, sets
and kinds, and resumes a call that was stopped. The table is in docs/results/tables.md.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

import imgcal
from imgcal.errors import InputError, RefusedError
from imgcal.fleet import StoredResults, workers
from imgcal.pipeline import DETECTORS
from imgcal.types import CalibrationObject, CameraRig, Detections
from scripts.output import RESULTS, ROOT, WORK, command, fill, markdown, read_json, surroundings, write_json
from scripts.results import degradations
from scripts.results.degradations import DEGRADATIONS, Frame, Look
from tests.captures.conftest import disturbed
from tests.captures.sets import RealSet, cavity_two_cameras, dot_grid, nominal, three_cameras_dots

JSON, PAGE = RESULTS / "degraded_captures.json", ROOT / "docs" / "results" / "tables.md"
SETS = {"dots": "three-cameras-dots", "cavity": "cavity-two-cameras", "grid": "dot-grid-10x10"}
OFF = {"dots": 9.0, "cavity": 8.0}  # px RMS, perturbation of the factory rig; the grid's rig is nominal
CALIBRATE = 8  # views of the grid; the others are held out
WRONG_PX, WRONG_RATIO = 1.0, 5.0
"""Held-out RMS beyond which a calibration is wrong: pixels, and multiple of `classical` on the original frames."""


@dataclass(frozen=True)
class Task:
    """One set, with everything needed to calibrate from it and to score the result."""

    frames: dict[str, list[Frame]]  # camera -> (H, W) of each snapshot
    obj: CalibrationObject
    rig: CameraRig  # the factory rig
    held_out: Detections  # with labels
    look: Look
    detection: imgcal.DetectionOptions = imgcal.DetectionOptions()

    def degraded(self, kind: str, level: float, seed: int) -> dict[str, list[Frame]]:
        """Degrade all frames, each with its own random draws."""
        made, number = DEGRADATIONS[kind], list(DEGRADATIONS).index(kind)
        return {
            name: [
                made.apply(frame, level, self.look, np.random.default_rng((seed, number, camera, snapshot)))
                for snapshot, frame in enumerate(frames)
            ]
            for camera, (name, frames) in enumerate(self.frames.items())
        }

    def off(self, rig: CameraRig) -> float:
        """RMS error (px) of all held-out points; infinite if no pose fits them."""
        try:
            return float(imgcal.score(self.held_out, rig, self.obj).distances.square().mean().sqrt())
        except RefusedError:
            return float("inf")


@dataclass(frozen=True)
class Case:
    """One calibration."""

    captures: str
    kind: str
    level: float
    seed: int
    detector: str

    @property
    def key(self) -> str:
        """Everything that the result depends on."""
        return f"{self.captures}, {self.kind} {self.level:g}, seed {self.seed}, {self.detector}"


@cache
def task(name: str, captures: Path) -> Task:
    """Prepare a set."""
    if name == "grid":
        return _grid_task(captures)
    real = three_cameras_dots(captures) if name == "dots" else cavity_two_cameras(captures)
    rig = disturbed(real.factory, real.points, OFF[name], 0)
    return Task(real.frames, real.obj, rig, real.held_out, _look_of_published(real))


def _look_of_published(real: RealSet) -> Look:
    blobs, points = imgcal.detect(real.frames), real.points
    distance = np.linalg.norm(blobs.uv[:, None] - points.uv, axis=-1) + 1e9 * (blobs.camera[:, None] != points.camera)
    return look_of(real.frames, blobs.select(distance.min(1) < 2), real.obj)


def _grid_task(captures: Path) -> Task:
    frames, obj = dot_grid(captures)
    dark = imgcal.DetectionOptions(polarity="dark")
    # The grid looks the same in any turn, so label all views with the rig that is calibrated from all of them.
    blobs = imgcal.detect({"cam": frames}, dark)
    reference = imgcal.calibrate(blobs, nominal(), obj)
    others = imgcal.score(imgcal.detect({"cam": frames[CALIBRATE:]}, dark), reference.rig, obj).labelled
    look = look_of({"cam": frames}, reference.labelled_detections, obj)
    return Task({"cam": frames[:CALIBRATE]}, obj, nominal(), others.detections, look, dark)


def look_of(frames: dict[str, list[Frame]], blobs: Detections, obj: CalibrationObject) -> Look:
    """Measure how dots look, from blobs that are dots."""
    levels = []
    for camera, name in enumerate(blobs.camera_names):
        for snapshot, frame in enumerate(frames[name]):
            mine = blobs.uv[(blobs.camera == camera) & (blobs.snapshot == snapshot)]
            column, row = np.rint(mine).astype(int).T
            levels.append(frame[row, column])
    ground = float(np.median([np.median(frame) for of_camera in frames.values() for frame in of_camera]))
    return Look(float(np.nanmedian(blobs.radius)), float(np.median(np.concatenate(levels))), ground, obj.num_fiducials)


def measured(case: Case) -> dict[str, Any]:
    """Calibrate, and score the result."""
    given = task(case.captures, captures_folder())
    frames = given.degraded(case.kind, case.level, case.seed)
    result: dict[str, Any] = {**asdict(case), "reason": "", "off_px": None, "labels": 0}
    began = time.process_time()
    try:
        found = imgcal.calibrate(frames, given.rig, given.obj, detection=given.detection, detector=case.detector)
    except RefusedError as error:
        return {**result, "reason": str(error), "seconds": time.process_time() - began}
    seconds = time.process_time() - began
    labels = int(found.observations.seen.sum())
    return {**result, "off_px": given.off(found.rig), "labels": labels, "seconds": seconds,
            "found_by": dict(found.detectors)}  # fmt: skip


def captures_folder() -> Path:
    """Folder of the real frames.

    Raises:
        InputError: IMGCAL_CAPTURES is not set.
    """
    if not os.environ.get("IMGCAL_CAPTURES"):
        raise InputError("IMGCAL_CAPTURES: found nothing, expected the folder of the captures")
    return Path(os.environ["IMGCAL_CAPTURES"])


def status(row: dict[str, Any], references: dict[str, float]) -> Literal["calibrated", "refused", "wrong"]:
    """Classify the outcome of a case, given the RMS (px) of `classical` on the original frames of its set."""
    if row["reason"]:
        return "refused"
    off, limit = row["off_px"], max(WRONG_PX, WRONG_RATIO * references[row["captures"]])
    return "wrong" if off is None or not off <= limit else "calibrated"


def references_of(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Held-out RMS (px) of `classical` on the original frames of each set."""
    return {
        row["captures"]: row["off_px"]
        for row in rows
        if (row["kind"], row["detector"]) == ("clean", "classical") and row["off_px"] is not None
    }


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Make a summary, and one table per set."""
    references = references_of(rows)
    names = [name for name in DETECTORS if any(row["detector"] == name for row in rows)]
    by_case = {(row["captures"], row["kind"], row["level"], row["seed"], row["detector"]): row for row in rows}

    def cell(key: tuple[Any, ...]) -> str:
        row = by_case.get(key)
        if row is None:
            return ""
        said, seconds = status(row, references), f"{row['seconds']:.1f} s"
        if said == "refused":
            return f"refused, {seconds}"
        off = "no pose" if row["off_px"] is None else f"{row['off_px']:.2f} px"
        return f"**wrong**, {off}, {seconds}" if said == "wrong" else f"{off}, {seconds}"

    def total(name: str, captures: str) -> str:
        mine = [status(row, references) for row in rows if (row["captures"], row["detector"]) == (captures, name)]
        return " / ".join(str(mine.count(kind)) for kind in ("calibrated", "refused", "wrong")) if mine else ""

    sets = [name for name in SETS if name in references]
    parts = [markdown(["calibrated / refused / wrong", *(SETS[name] for name in sets)],
                      [[name, *(total(name, captures) for captures in sets)] for name in names])]  # fmt: skip
    for captures in sets:
        keys = sorted({key[:4] for key in by_case if key[0] == captures}, key=_place)
        lines = [[f"{key[1]} {key[2]:g}" if key[1] != "clean" else "clean", *(cell((*key, name)) for name in names)]
                 for key in keys]  # fmt: skip
        parts.append(markdown([SETS[captures], *names], lines))
    levels = [f"*{kind}*: {made.meaning}" for kind, made in DEGRADATIONS.items() if kind != "clean"]
    return "\n\n".join([*parts, "Levels: " + "; ".join(levels) + "."])


def _place(key: tuple[Any, ...]) -> tuple[int, int, int]:
    """Sort key: kinds and levels in the order in which they are listed."""
    kind, level, seed = key[1:]
    levels = DEGRADATIONS[kind].levels
    return list(DEGRADATIONS).index(kind), levels.index(level) if level in levels else len(levels), seed


def main(
    detectors: tuple[str, ...] = DETECTORS,
    sets: tuple[str, ...] = tuple(SETS),
    kinds: tuple[str, ...] = tuple(DEGRADATIONS),
    seed: int = 0,
    results: Path = JSON,
    page: bool = False,
) -> None:
    """Calibrate, score, and write the JSON and, if it is the committed one, the table.

    Args:
        detectors: values of `imgcal calibrate --detector`.
        sets: names of the sets.
        kinds: kinds of degradation.
        seed: of the random degradations.
        results: the JSON.
        page: only rewrite the table.
    """
    known = read_json(results)["outcomes"] if results.is_file() else []
    if not page:
        captures_folder()
        cases = [
            Case(captures, kind, level, seed, detector)
            for captures in sets
            for kind in kinds
            for level in DEGRADATIONS[kind].levels
            for detector in detectors
        ]
        kept = StoredResults(WORK / "degraded_captures", Path(degradations.__file__).read_text())
        rows = []
        with workers(cores=1, kept=kept) as mapped:
            for case, row in zip(cases, mapped(measured, cases), strict=True):
                rows.append(row)
                said = row["reason"] or f"{row['off_px']:.3f} px"
                print(f"{len(rows)} of {len(cases)}: {case.key}: {said[:150]}, {row['seconds']:.1f} s", flush=True)
        fresh = {_identity(row) for row in rows}
        known = [row for row in known if _identity(row) not in fresh] + rows
        write_json(results, surroundings() | {"outcomes": known})
    if results == JSON:
        fill(PAGE, {"degraded captures": tables(read_json(results)["outcomes"])})


def _identity(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("captures", "kind", "level", "seed", "detector"))


if __name__ == "__main__":
    torch.set_num_threads(1)
    command(lambda: tyro.cli(main, args=sys.argv[1:], description=__doc__))

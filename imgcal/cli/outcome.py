"""What comes of a calibration: in the form of result.json, and in the words of the terminal.

Blobs, labels and labels that do not fit are counted; the findings say which cameras have moved, what is not known, and
where to take the object next.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import imgcal
from imgcal.errors import RefusedError
from imgcal.estimation import Gauge
from imgcal.io import RigCovariance
from imgcal.messages import list_names, plural, plus_minus
from imgcal.pipeline import (
    DOUBTFUL,
    Calibration,
    Coverage,
    LabelCounts,
    Motion,
    measure_coverage,
    motion_since_factory,
    rms_length,
    unit_doubt,
)
from imgcal.types import CalibrationObject, CameraRig, Detections, MovedCamera, MovedError


@dataclass(frozen=True)
class Findings:
    """What printed lines, result.json and the report share."""

    motion: Motion
    knowledge: Coverage
    from_scratch: bool = False  # there was no factory calibration since which a camera could have moved
    moved: tuple[MovedCamera, ...] = ()  # during the capture
    untimed: tuple[str, ...] = ()  # cameras without evidence that their frames show the same moments

    @property
    def values(self) -> dict[str, Any]:
        """Plain values for result.json."""
        motion, known = self.motion, self.knowledge
        reference = motion.gauge.reference
        since_factory = () if self.from_scratch else motion.moves
        return {
            "moved": [move.as_values() for move in (*since_factory, *self.moved)],
            "motion": None
            if self.from_scratch
            else {
                "relative_to": "most cameras" if reference is None else motion.camera_names[reference],
                "cameras_moved": [motion.camera_names[c] for c in motion.moved],
                "per_camera": {
                    name: {"rotation_deg": float(motion.rotation_deg[c]), "position_mm": float(motion.position_mm[c])}
                    for c, name in enumerate(motion.camera_names)
                },
            },
            "timing_untested": list(self.untimed),
            "knowledge": {
                "coverage": dict(zip(known.camera_names, known.coverage, strict=True)),
                "undetermined": {name: list(cameras) for name, cameras in known.undetermined.items()},
                "move_object_to_mm": [list(place.rig_from_centre) for place in known.places],
            },
        }

    @property
    def lines(self) -> list[str]:
        """What is printed."""
        lines = [self.motion.sentence] if self.motion.sentence and not self.from_scratch else []
        if self.knowledge.sentences:
            lines.append(" ".join(self.knowledge.sentences))
        if self.untimed:
            which = "all cameras" if len(self.untimed) == len(self.knowledge.camera_names) else list_names(self.untimed)
            lines.append(
                f"timing of {which} not tested: the object moved too little, or too evenly, between snapshots to show "
                "a camera that is late"
            )
        if self.knowledge.advice:
            lines.append(self.knowledge.advice)
        return lines


def findings(calibration: Calibration, gauge: Gauge, covariance: RigCovariance) -> Findings:
    """Derive motion and coverage from a calibration."""
    motion, knowledge = motion_since_factory(calibration, gauge), measure_coverage(calibration, covariance.std)
    return Findings(motion, knowledge, calibration.from_scratch, calibration.moved, calibration.untimed)


def counts_by_camera(calibration: Calibration, camera: int) -> dict[str, int]:
    """Count over all snapshots."""
    blobs = int((calibration.labelled_detections.camera == camera).sum())
    return {"blobs": blobs, **_counts(calibration.tally, np.s_[:, camera])}


def counts_by_snapshot(calibration: Calibration) -> dict[str, dict[str, int]]:
    """Count over all cameras: snapshot name -> numbers."""
    detections = calibration.labelled_detections
    blobs = np.bincount(detections.snapshot, minlength=len(detections.snapshot_names)).tolist()
    found = {
        name: {"blobs": count, "labelled": 0, "outliers": 0}
        for name, count in zip(detections.snapshot_names, blobs, strict=True)
    }
    for row, snapshot in enumerate(calibration.labelled.snapshots):  # several rows may be of one snapshot
        for key, count in _counts(calibration.tally, np.s_[row]).items():
            found[snapshot.name][key] += count
    return found


def blobs_by_camera(detections: Detections, rig: CameraRig) -> dict[str, dict[str, Any]]:
    """Count the blobs of each camera of a refused capture."""
    found = detections.count_by_camera().tolist()
    blobs = dict(zip(detections.camera_names, found, strict=True))
    return {name: {"blobs": blobs.get(name, 0), "labelled": None, "outliers": None} for name in rig.camera_names}


def doubtful_cameras(calibration: Calibration) -> list[str]:
    """Name the cameras that see a part of the object in the wrong place."""
    kept, unexplained = calibration.tally.kept.sum(0), calibration.tally.unexplained.sum(0)
    doubtful = np.flatnonzero(unexplained > DOUBTFUL * np.maximum(kept + unexplained, 1))
    stopped = [str(camera) for camera in calibration.doubtful]
    return [f"{late}; these took no part" for late in calibration.late] or stopped + [
        f"camera {calibration.rig.camera_names[c]}: {unexplained[c]} blobs may be fiducials but are not where "
        f"fiducials should be; {kept[c]} are"
        for c in doubtful
    ]


def _counts(counts: LabelCounts, part: Any) -> dict[str, int]:
    return {name: int(getattr(counts, name)[part].sum()) for name in ("labelled", "outliers")}


def summary(calibration: Calibration, seconds: dict[str, float]) -> dict[str, Any]:
    """Summarize a calibration as plain values for result.json."""
    labelled, snapshots = calibration.labelled, calibration.labelled.snapshots
    used, total = labelled.moment_counts
    seen = calibration.observations.seen
    per_camera = {}
    for camera, name in enumerate(calibration.rig.camera_names):
        points = int(seen[:, camera].sum())
        per_camera[name] = {
            "points": points,
            "rms_px_before": rms_length(calibration.before.residual[:, camera], seen[:, camera]),
            "rms_px_after": rms_length(calibration.residual[:, camera], seen[:, camera]),
            **counts_by_camera(calibration, camera),
        }
    alternatives = max(snapshots[s].alternatives for s in labelled.used)
    names = {snapshots[s].name for s in np.flatnonzero(labelled.used_rows >= 0)}
    return {
        "version": imgcal.__version__,
        "status": "ok",
        "reason": "",
        "identity": calibration.identity,
        "identity_alternatives": alternatives,
        "detector": dict(calibration.detectors),
        "from_scratch": calibration.from_scratch,
        "rms_px_before": None if calibration.from_scratch else rms_length(calibration.before.residual, seen),
        "rms_px_after": rms_length(calibration.residual, seen),
        "first_guess": _guess_summary(calibration),
        "chi2_per_dof": float(calibration.chi2_per_dof),
        "model_error_px": calibration.additive_noise,
        "outliers": calibration.outliers,
        "prior_too_narrow": dict(calibration.prior_scale),
        "snapshots_used": used,
        "snapshots_rejected": total - used,
        "lights": _lights_summary(calibration),
        "rejected": {s.name: s.reason for s in snapshots if s.name not in names},
        "late": [vars(late) for late in calibration.late],
        "doubtful": [camera.as_values() for camera in calibration.doubtful],
        "delays": None if calibration.delays is None else calibration.delays.values,
        "unsynchronized": None if calibration.unsynchronized is None else calibration.unsynchronized.values,
        "per_camera": per_camera,
        "per_snapshot": counts_by_snapshot(calibration),
        "object": _object_summary(calibration),
        "object_displaced": [_fiducial_name(calibration.obj, offset.fiducial) for offset in calibration.displaced],
        "object_lost": [_fiducial_name(calibration.obj, fiducial) for fiducial in calibration.lost],
        "object_scale_sigma": calibration.scale_sigma,
        "object_bent_sigma": calibration.bent_sigma,
        "board_bend": None if calibration.bend is None else vars(calibration.bend) | {"note": str(calibration.bend)},
        "covariance": {
            "from": "scatter between blocks of snapshots" if calibration.block_length else "noise of the blobs",
            "block_length": calibration.block_length,
            "inflation": calibration.estimate.mean_inflation,
        },
        "predicted_error": calibration.predicted_error.summary(),
        "scale": calibration.scale.values,
        "repeats": calibration.repeats.values,
        "rests": calibration.rests.values,
        "unit_doubt": unit_doubt(calibration.factory, calibration.obj, calibration.from_scratch) or None,
        "seconds": seconds,
    }


def _lights_summary(calibration: Calibration) -> dict[str, Any] | None:
    lights = calibration.lights
    if lights is None:
        return None
    names, agreement = calibration.rig.camera_names, lights.agreement
    return {
        "markers": len(calibration.labelled.used),  # one at each moment
        "background_blobs": dict(zip(names, lights.background_of.tolist(), strict=True)),
        "blobs_left_over": dict(zip(names, lights.left_over.tolist(), strict=True)),
        "held_out": {
            name: {"predicted": predicted, "found": round(found, 4), "beside": round(beside, 4)}
            for name, predicted, found, beside in zip(
                names,
                agreement.predicted.tolist(),
                agreement.found.tolist(),
                agreement.near_misses.tolist(),
                strict=True,
            )
        },
        "starts": lights.starts,
        "note": lights.note,
    }


def _object_summary(calibration: Calibration) -> list[dict[str, Any]]:
    """Say where fiducials are; with several objects, of each, with the number of snapshots in which it was seen."""
    obj, columns = calibration.obj, calibration.obj.part_of
    first = np.searchsorted(columns, np.arange(len(obj.each)))
    offsets: list[list[dict[str, Any]]] = [[] for _ in obj.each]
    for offset in calibration.shape:
        part = int(columns[offset.fiducial])
        values = {"fiducial": int(offset.fiducial - first[part]), "offset_mm": offset.distance}
        offsets[part].append(values | {"sigma_mm": offset.sigma})
    if not obj.parts:
        return offsets[0]
    moments, part_of = calibration.labelled.moments[calibration.labelled.used], calibration.labelled.part_of_rows
    seen = [len(np.unique(moments[part_of == part])) for part in range(len(obj.parts))]
    return [
        {"name": part.name, "snapshots_used": count, "fiducials": found}
        for part, count, found in zip(obj.parts, seen, offsets, strict=True)
    ]


def _fiducial_name(obj: CalibrationObject, fiducial: int) -> int | str:
    """Name a fiducial by its row; with several objects, by the object and its row there."""
    if not obj.parts:
        return fiducial
    part = int(obj.part_of[fiducial])
    return f"{obj.parts[part].name} {fiducial - int(np.searchsorted(obj.part_of, part))}"


def _guess_summary(calibration: Calibration) -> dict[str, Any] | None:
    guess = calibration.initialization
    if guess is None:
        return None
    rms = rms_length(guess.residual, calibration.observations.seen)
    known = rms is not None and math.isfinite(rms)  # a network may say anything
    return {"network": guess.name, "rms_px": rms if known else None, "used": calibration.guess_used}


def refused_summary(
    refusal: RefusedError, detections: Detections, rig: CameraRig, seconds: dict[str, float]
) -> dict[str, Any]:
    """Summarize a refusal under the same keys."""
    moved = refusal.moved if isinstance(refusal, MovedError) else ()
    return {
        "version": imgcal.__version__, "status": "refused", "reason": refusal.for_command,
        "identity": None, "identity_alternatives": None, "detector": {}, "from_scratch": None,
        "rms_px_before": None, "rms_px_after": None, "first_guess": None,
        "chi2_per_dof": None, "model_error_px": None, "outliers": None, "prior_too_narrow": {},
        "snapshots_used": 0, "snapshots_rejected": len(detections.snapshot_names), "lights": None, "rejected": {},
        "moved": [move.as_values() for move in moved], "late": [], "doubtful": [],
        "delays": None, "unsynchronized": None,
        "per_camera": blobs_by_camera(detections, rig), "per_snapshot": {},
        "object": [], "object_displaced": [], "object_lost": [], "object_scale_sigma": None, "object_bent_sigma": None,
        "board_bend": None, "covariance": None, "predicted_error": None, "scale": None, "repeats": None, "rests": None,
        "unit_doubt": None,
        "motion": None, "timing_untested": None, "knowledge": None, "seconds": seconds,
    }  # fmt: skip


def predicted_line(predicted: dict[str, Any]) -> str:
    """Describe in one line the predicted error where the rig is used."""
    lengths = [
        f"{value:.2g} {unit} (95 %: {p95:.2g})"
        for unit in ("mm", "px")
        if (value := predicted[f"median_{unit}"]) is not None and (p95 := predicted[f"p95_{unit}"]) is not None
    ]
    worst = predicted["worst_camera_px"]
    words = f"predicted error in the working volume {', '.join(lengths) or 'unknown'}"
    return words if worst is None else f"{words}, worst camera {predicted['worst_camera']} {worst:.2g} px"


def _offsets(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Offsets of fiducials, of several objects with the object's name in front."""
    found = []
    for entry in result["object"]:
        if "name" not in entry:
            found.append(entry)
        found += [each | {"fiducial": f"{entry['name']} {each['fiducial']}"} for each in entry.get("fiducials", ())]
    return found


def print_outcome(result: dict[str, Any], found: Findings, out: Path, report: bool) -> None:
    """Print what was found and where it was written; notes go to standard error."""
    guess = result["first_guess"]
    alone = None if guess is None else guess["rms_px"]
    network = "" if alone is None else f"network alone {alone:.3f} px, "
    before, after = result["rms_px_before"], result["rms_px_after"]
    earlier = "without a factory calibration " if before is None else f"before {before:.3f} px, {network}after "
    print(f"reprojection error {earlier}{after:.4f} px (RMS)")
    if guess is not None and not guess["used"]:
        said = "one rig from all of the network's guesses fits no better than the factory calibration: not used"
        print(f"note: {said}", file=sys.stderr)
    print("; ".join(filter(None, (predicted_line(result["predicted_error"]), result["scale"]["note"]))))
    print(
        f"identity {result['identity']}, {plural(result['snapshots_used'], 'snapshot')} used, "
        f"{result['snapshots_rejected']} rejected"
    )
    if result["lights"]:
        lights = result["lights"]
        shares = [camera["found"] for camera in lights["held_out"].values()]
        share = f"{100 * min(shares):.0f} to {100 * max(shares):.0f} %"
        print(
            f"{plural(lights['markers'], 'marker')} used; in held-out snapshots, each camera sees {share} of the "
            "markers that the other cameras find in its view, without matches by chance"
        )
        if lights["note"]:
            print(f"note: {lights['note']}", file=sys.stderr)
    for line in found.lines:
        print(line)
    for timing in (result["delays"], result["unsynchronized"]):
        if timing:
            print(f"note: {timing['note']}", file=sys.stderr)
    if result["unit_doubt"]:
        print(f"note: {result['unit_doubt']}", file=sys.stderr)
    for left_out in (result["repeats"], result["rests"]):
        if left_out["note"]:
            print(f"note: {left_out['note']}", file=sys.stderr)
    for kind, factor in result["prior_too_narrow"].items():
        kind = kind.replace("_", " ")
        print(f"note: {kind} drifted {factor:.1f} times as far as the rig's prior allows: widened", file=sys.stderr)
    for offset in _offsets(result):
        if offset["fiducial"] in result["object_displaced"]:
            print(
                f"note: fiducial {offset['fiducial']} of the object is "
                f"{plus_minus(offset['offset_mm'], offset['sigma_mm'])} mm from its place in the object file",
                file=sys.stderr,
            )
    for fiducial in result["object_lost"]:
        print(
            f"note: fiducial {fiducial} of the object was rarely found where the others were: missing, hidden, or not "
            "where the object file puts it",
            file=sys.stderr,
        )
    if result["board_bend"]:
        print(result["board_bend"]["note"])
    print(f"rig     {out / 'rig.yaml'}")
    several = [entry for entry in result["object"] if "name" in entry]
    for entry in several:
        print(f"object  {entry['name']} seen in {plural(entry['snapshots_used'], 'snapshot')}")
    if result["object"] and not several:
        print(f"object  {out / 'object.csv'}")
    if result["board_bend"]:
        print(f"board   {out / 'board.yaml'}")
    print(f"result  {out / 'result.json'}")
    if report:
        print(f"report  {out / 'report.html'}")

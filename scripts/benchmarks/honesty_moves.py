"""Are cameras that move or have a wrong image identified, without false reports of steady ones?

Run as `python -m scripts.benchmarks.honesty_moves`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from imgcal import Calibration, PipelineOptions, RefusedError, calibrate
from imgcal.association import associate
from imgcal.fleet import Mapper, StoredResults, workers
from imgcal.pipeline.motion_check import list_moves
from imgcal.types import Detections, MovedError
from scripts.benchmarks import camera_faults as faults
from scripts.output import ROOT, WORK, command, fill, markdown, read_json, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "honesty_moves.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
CAMERA = 3
OUTCOMES = {
    "found": "identified",
    "refused": "refused for another reason",
    "doubted": "accepted, the camera named as doubtful",
    "accepted": "accepted in silence",
}
SNAPSHOTS = 20  # of a capture with a fault
LENGTHS = (5, 8, 12, 20, 35, 60, 100)  # snapshots of steady captures
DEGREES = (0.02, 0.05, 0.1, 1.0)
SHARES = (0.5, 0.9)  # share of the capture before the camera is rotated
IMAGES = ("u", "v", "both", "turned", "lens", "late", "swapped")

SCENES: dict[str, Callable[[int, int], faults.Scene]] = {
    "wand in room10": faults.wand_in_a_room,
    "O10": faults.object_before_a_ring,
    "T4": lambda snapshots, seed: faults.object_before_a_ring(snapshots, seed, "T4"),
}
STEADY = ("noise as stated", "heavy tails", "10 % outliers", "noise misstated", "lens errors", "lens errors, one way")


def steady(kind: str, fault: str, seed: int) -> bool:
    """Tell whether a camera is reported as moved in a capture without motion; labels are given."""
    draw = np.random.default_rng(seed)
    rig, obj, truth = SCENES[kind](int(draw.choice(LENGTHS)), seed)
    if fault.startswith("lens errors"):
        truth = faults.with_lens_errors(truth, seed)
    if fault.endswith("one way"):
        truth = faults.from_one_end_to_the_other(truth)
    table = faults.blobs(truth, seed, labelled=True)
    if fault == "heavy tails":
        table.uv[:] += 0.15 * draw.standard_t(2.5, table.uv.shape)
    elif fault == "10 % outliers":
        table.uv[:] += (draw.random((len(table), 1)) < 0.1) * draw.normal(0, 8, table.uv.shape)
    elif fault == "noise misstated":
        table = replace(table, sigma=table.sigma * draw.uniform(0.2, 5))
    return bool(list_moves(associate(table, rig, obj), rig, obj, PipelineOptions()))


def bumped(kind: str, degrees: float, share: float, seed: int) -> str:
    """Outcome of a capture in which a camera is rotated: found, refused for another reason, doubted, or accepted."""
    first = round(SNAPSHOTS * share)
    rig, obj, truth = SCENES[kind](SNAPSHOTS, seed)
    truth = faults.changed_from(truth, obj, CAMERA, first, lambda r: faults.turned(r, CAMERA, degrees, seed % 2))
    try:
        result = calibrate(faults.blobs(truth, seed), rig, obj)
    except MovedError as error:
        right = [(m.camera, m.snapshot) for m in error.moved] == [(rig.camera_names[CAMERA], f"{first:05d}")]
        return "found" if right else "refused"
    except RefusedError:
        return "refused"
    return _judge_accepted(result, rig)


def _judge_accepted(result: Calibration, rig: faults.CameraRig) -> str:
    """Tell whether an accepted result at least names the camera as doubtful."""
    named = rig.camera_names[CAMERA] in {camera.camera for camera in result.doubtful}
    return "doubted" if named else "accepted"


def wrong_image(kind: str, how: str, seed: int) -> str:
    """Outcome of a capture with a camera whose image is wrong."""
    rig, obj, truth = SCENES[kind](8, seed)
    if how == "lens":
        truth = faults.with_camera(truth, obj, CAMERA, lambda r: faults.longer_lens(r, CAMERA))
    table = _damaged(faults.blobs(truth, seed), rig, how)
    try:
        result = calibrate(table, rig, obj, PipelineOptions(blind_cameras=True))
    except RefusedError as error:
        return "found" if rig.camera_names[CAMERA] in str(error) else "refused"
    return _judge_accepted(result, rig)


def _damaged(table: Detections, rig: faults.CameraRig, how: str) -> Detections:
    if how == "late":
        return faults.late(table, CAMERA)
    if how == "swapped":
        return faults.swapped(table, CAMERA, 0)
    return table if how == "lens" else faults.mirrored(table, rig, CAMERA, how)


def measure(captures: int, steady_captures: int, mapped: Mapper = map) -> dict[str, Any]:
    """Run everything: `captures` of each fault in a camera, `steady_captures` of each kind of steady ones."""
    items: list[tuple[Any, ...]] = []
    for fault in STEADY:
        # A correlation of position and time needs a volume; poses in front of a ring are drawn independently.
        kinds = list(SCENES)[:1] if fault.endswith("one way") else list(SCENES)
        items += [("steady", kinds[seed % len(kinds)], fault, seed) for seed in range(steady_captures)]
    for kind in SCENES:
        cases: list[tuple[Any, ...]] = [("moves", kind, degrees, share) for degrees in DEGREES for share in SHARES]
        cases += [("images", kind, how) for how in IMAGES]
        items += [(*case, seed) for case in cases for seed in range(captures)]
    found: dict[str, dict[str, list[Any]]] = {"steady": {}, "moves": {}, "images": {}}
    for item, outcome in zip(items, mapped(_outcome, items), strict=True):
        outcomes = found[item[0]].setdefault(_name(item), [])
        outcomes.append(outcome)
        if len(outcomes) == (steady_captures if item[0] == "steady" else captures):
            print(_name(item), sum(outcomes) if item[0] == "steady" else outcomes, file=sys.stderr, flush=True)
    alarms = {name: {"captures": len(told), "alarms": sum(told)} for name, told in found["steady"].items()}
    moves, images = ({name: _counted(told) for name, told in found[part].items()} for part in ("moves", "images"))
    return {"noise_px": faults.NOISE, "snapshots": SNAPSHOTS, "steady": alarms, "moves": moves, "images": images}


def _outcome(item: tuple[Any, ...]) -> bool | str:
    what, *case = item
    if what == "steady":
        return steady(*case)
    return bumped(*case) if what == "moves" else wrong_image(*case)


def _name(item: tuple[Any, ...]) -> str:
    """Table row of a work item."""
    what, kind, *rest = item
    if what == "steady":
        return str(rest[0])
    return f"{kind}, {rest[0]:g} deg after {100 * rest[1]:.0f} %" if what == "moves" else f"{kind}, {rest[0]}"


def _counted(found: list[str]) -> dict[str, int]:
    return {name: found.count(name) for name in OUTCOMES}


def steady_table(result: Mapping[str, Any]) -> str:
    """Markdown."""
    return markdown(
        ["steady captures", "number", "camera reported as moved"],
        [[name, str(row["captures"]), str(row["alarms"])] for name, row in result["steady"].items()],
    )


def faults_table(result: Mapping[str, Any], part: str) -> str:
    """Markdown."""
    rows = [[name, *(str(row[key]) for key in OUTCOMES)] for name, row in result[part].items()]
    return markdown(["capture", *OUTCOMES.values()], rows)


@dataclass(frozen=True)
class Options:
    """Count simulated captures that are identified, refused and accepted."""

    captures: int = 10
    steady_captures: int = 300
    address: str | None = None  #: running Ray cluster to run on; None = this machine
    cores: int | None = None  #: of this machine; 1 = this process alone; None = all
    out: Path = RESULT  #: only this path also rewrites the tables in docs/benchmarks/tables.md


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    began, before, kept = (
        time.monotonic(),
        surroundings(),
        StoredResults(WORK / "honesty_moves", Path(__file__).read_text("utf-8")),
    )
    with workers(options.address, options.cores, kept) as mapped:
        result = measure(options.captures, options.steady_captures, mapped)
    write_json(options.out, before | {"seconds": round(time.monotonic() - began)} | result)
    kept.clear()
    tables = {
        "honesty steady": steady_table(result),
        "honesty moves": faults_table(result, "moves"),
        "honesty images": faults_table(result, "images"),
    }
    if options.out.resolve() == RESULT:
        read_json(RESULT)
        fill(PAGE, tables)
    print("\n\n".join(tables.values()))


if __name__ == "__main__":
    command(main)

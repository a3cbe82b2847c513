"""Wands whose markers merge: is a steady camera reported as moved, and is a bumped one found?

Run as `python -m scripts.benchmarks.merging_wands`. Rings, domes and rows of cameras see a wand, carried by hand or at
random poses. Where the discs of two markers touch, a camera has one round and sharp blob between them, with the sigma
of one marker and no flag, like a detector's output. In steady captures nothing moves; in the others one camera is
rotated by 0.1 to 1 degree before a random snapshot. Finished items of the same code are not run again
(`out/work/merging_wands`).
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

import imgcal
from imgcal import RefusedError
from imgcal.fleet import StoredResults, workers
from imgcal.synthesis import HandHeld, PhysicalDrift, Truth, arrange_rig, simulate_volume
from imgcal.types import CalibrationObject, CameraRig, Detections, MovedError
from scripts.output import ROOT, WORK, command, markdown, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "merging_wands.json"
SHAPES: tuple[Literal["ring", "dome", "row"], ...] = ("ring", "dome", "row")
CAMERAS = (4, 6, 8, 10)
LENGTHS = (20, 20, 30, 30, 50, 50, 80, 120, 200)
"""Range of the number of snapshots; most captures are short."""
RATES = (5.0, 15.0, 30.0)
"""Snapshots per second of a carried wand: the slower it moves between them, the more similar they are."""
BY_HAND = 0.7
"""Share of captures in which the wand is carried; in the others its poses are random."""
MARKER = 6.0  # mm, radius of a marker
EDGES = 1.0  # px, largest gap between two discs that merge
NOISE, CLAIMED = 0.014, 0.012  # px, noise of a centre, and sigma of its blob
MISSED, CLUTTER = 0.01, 0.1  # share of missed markers; false blobs per frame
DEGREES = (0.1, 1.0)
AT_EITHER_END = 2
"""Least number of snapshots before and after a bump in which the camera sees the wand; fewer with `--last`."""
WANDS = {
    "wand4": [(-120.0, 0.0, 0.0), (-30.0, 0.0, 0.0), (150.0, 0.0, 0.0), (0.0, -350.0, 0.0)],
    "T5": [(-200.0, 0.0, 0.0), (-80.0, 0.0, 0.0), (0.0, 0.0, 0.0), (200.0, 0.0, 0.0), (0.0, -380.0, 0.0)],
    "bent5": [(-150.0, 0.0, 0.0), (0.0, 0.0, 20.0), (120.0, 0.0, 0.0), (20.0, -250.0, 0.0), (0.0, -400.0, 15.0)],
}


@dataclass(frozen=True)
class Capture:
    """Detections of a capture, and the ground truth."""

    detections: Detections
    factory: CameraRig
    obj: CalibrationObject
    truth: Truth
    merged: int  # blobs of more than one marker


@dataclass(frozen=True)
class Bump:
    """A rotation of a camera before a snapshot."""

    camera: int
    snapshot: int
    degrees: float


def scene(seed: int) -> tuple[CameraRig, CalibrationObject, Truth, np.random.Generator]:
    """Draw a rig, a wand and its poses."""
    draw = np.random.default_rng((seed, 1))
    shape, cameras = SHAPES[seed % 3], int(draw.choice(CAMERAS))
    height = 2500.0 if shape != "dome" else 500.0
    target = (0.0, 0.0, 1000.0) if shape != "row" else (0.0, 3500.0, 1200.0)
    rig = arrange_rig(shape, cameras, float(draw.uniform(2500, 5000)), height=height, target=target)
    name = str(draw.choice(list(WANDS)))
    points = torch.tensor(WANDS[name], dtype=torch.float64)
    obj = CalibrationObject(points, torch.zeros_like(points), name=name)
    speed, rate = float(draw.uniform(200, 1500)), float(draw.choice(RATES))
    hand = HandHeld(speed=speed, turning=float(draw.uniform(20, 120)), rate=rate) if draw.random() < BY_HAND else None
    count = int(draw.choice(LENGTHS))
    generator = torch.Generator().manual_seed(seed)
    return rig, obj, simulate_volume(rig, obj, count, generator, PhysicalDrift(), hand=hand), draw


def turned(truth: Truth, obj: CalibrationObject, bump: Bump, draw: np.random.Generator) -> Truth:
    """Rotate a camera about a random axis before a snapshot; the true rig is the one before."""
    axis = torch.from_numpy(draw.standard_normal(3))
    step = torch.zeros(truth.rig.num_cameras, truth.rig.num_parameters, dtype=torch.float64)
    step[bump.camera, :3] = axis / axis.norm() * math.radians(bump.degrees)
    after = truth.rig.retract(step).expand(len(truth.uv)).project(truth.rig_from_object.apply(obj.points), obj.radius)
    uv, visible = truth.uv.clone(), shown(truth).clone()
    later = slice(bump.snapshot, None)
    uv[later, bump.camera], visible[later, bump.camera] = (
        after.uv[later, bump.camera],
        after.visible[later, bump.camera],
    )
    return replace(truth, uv=uv, visible=visible)


def shown(truth: Truth) -> torch.Tensor:
    """Fiducials that are in view: (S, C, N) bool."""
    return torch.ones_like(truth.uv[..., 0], dtype=torch.bool) if truth.visible is None else truth.visible


def images(truth: Truth, obj: CalibrationObject, draw: np.random.Generator) -> tuple[Detections, int]:
    """Simulate detections: unlabelled blobs, and the number of merged ones."""
    points = truth.rig_from_object.apply(obj.points)
    depth = truth.rig.expand(len(points)).project(points).depth.numpy()
    focal = truth.rig.focal_length.mean(-1).numpy()[:, None]
    uv, radius = truth.uv.numpy(), MARKER * focal / np.maximum(depth, 1.0)
    seen = shown(truth).numpy() & (draw.random(uv.shape[:3]) >= MISSED)
    size = truth.rig.image_size.numpy()
    rows: list[tuple[float, float, float, int, int]] = []
    merged = 0
    for s, c in np.ndindex(seen.shape[:2]):
        left = list(np.flatnonzero(seen[s, c]))
        while left:
            group = [left.pop(0)]
            for member in group:
                away = np.linalg.norm(uv[s, c] - uv[s, c, member], axis=-1)
                near = [k for k in left if away[k] < radius[s, c, k] + radius[s, c, member] + EDGES]
                group += near
                left = [k for k in left if k not in near]
            area = radius[s, c, group] ** 2
            place = (uv[s, c, group] * area[:, None]).sum(0) / area.sum() + NOISE * draw.standard_normal(2)
            spread = np.ptp(uv[s, c, group], axis=0).max() / 2
            rows.append((*place, math.sqrt(radius[s, c, group].max() * (radius[s, c, group].max() + spread)), s, c))
            merged += len(group) > 1
        for _ in range(draw.poisson(CLUTTER)):
            rows.append((*(draw.random(2) * (size[c] - 1)), 3.0, s, c))
    table: NDArray[np.float64] = np.array(rows)
    table = table[((table[:, :2] > 0) & (table[:, :2] < size[table[:, 4].astype(int)] - 1)).all(1)]
    table = table[np.lexsort((draw.random(len(table)), table[:, 3]))]
    count = len(table)
    return Detections(
        uv=table[:, :2].copy(),
        sigma=np.full(count, CLAIMED),
        camera=table[:, 4].astype(np.int64),
        snapshot=table[:, 3].astype(np.int64),
        fiducial=np.full(count, -1, dtype=np.int64),
        radius=table[:, 2].copy(),
        flags=np.zeros(count, dtype=np.uint8),
        camera_names=truth.rig.camera_names,
        snapshot_names=tuple(f"{s:05d}" for s in range(len(seen))),
    ), merged


def capture(seed: int, moving: bool = False, last: int | None = None) -> tuple[Capture, Bump | None]:
    """Simulate a capture.

    Args:
        seed: of all random values.
        moving: bump a camera.
        last: the bump is before this many of the last snapshots; None = at random.
    """
    rig, obj, truth, draw = scene(seed)
    bump = None
    if moving:
        bump = drawn_bump(truth, draw, last)
        truth = turned(truth, obj, bump, draw)
    detections, merged = images(truth, obj, draw)
    return Capture(detections, rig, obj, truth, merged), bump


def drawn_bump(truth: Truth, draw: np.random.Generator, last: int | None) -> Bump:
    """Draw a camera that sees the wand, and the snapshot and size of its rotation."""
    whole = shown(truth).all(-1).numpy()
    degrees = math.exp(draw.uniform(math.log(DEGREES[0]), math.log(DEGREES[1])))
    cameras = np.flatnonzero(whole.sum(0) >= 4 * AT_EITHER_END)
    if last is not None:  # cameras that see it at the end
        cameras = np.intersect1d(cameras, np.flatnonzero(whole[-last:].all(0)))
    camera = int(draw.choice(cameras if len(cameras) else np.arange(whole.shape[1])))
    rows = np.flatnonzero(whole[:, camera])
    places = rows[AT_EITHER_END : max(len(rows) - AT_EITHER_END + 1, AT_EITHER_END + 1)]
    return Bump(camera, len(whole) - last if last is not None else int(draw.choice(places)), degrees)


@dataclass(frozen=True)
class Item:
    """One capture to calibrate."""

    seed: int
    moving: bool
    last: int | None = None


def run(item: Item) -> dict[str, Any]:
    """Calibrate a capture, and describe the outcome."""
    made, bump = capture(item.seed, item.moving, item.last)
    began = time.process_time()
    said: dict[str, Any] = {
        "seed": item.seed, "rig": made.factory.name, "wand": made.obj.name, "merged": made.merged,
        "snapshots": len(made.detections.snapshot_names), "blobs": len(made.detections),
    }  # fmt: skip
    if bump is not None:
        said |= {"camera": made.factory.camera_names[bump.camera], "before": bump.snapshot, "degrees": bump.degrees}
        said["last"] = item.last
    try:
        result = imgcal.calibrate(made.detections, made.factory, made.obj)
    except MovedError as error:
        said |= {"outcome": "moved", "moved": [[m.camera, m.snapshot, m.kind] for m in error.moved]}
    except RefusedError as error:
        said |= {"outcome": "refused", "reason": str(error)[:200]}
    else:
        doubtful = [[d.camera, d.snapshots[0]] for d in getattr(result, "doubtful", ())]
        said |= {"outcome": "accepted", "rms_px": float(result.rms), "doubtful": doubtful}
    if bump is not None:
        said["outcome"] = _judged(said, bump, made)
    return said | {"cpu_s": time.process_time() - began}


def _judged(said: dict[str, Any], bump: Bump, made: Capture) -> str:
    """Judge the report of a bump: `right` camera and snapshot, `other` (camera or snapshot), else the outcome."""
    if said["outcome"] == "accepted":
        named = any(camera == said["camera"] for camera, _ in said["doubtful"])
        return "doubted" if named else "accepted"
    if said["outcome"] != "moved":
        return str(said["outcome"])
    # A move is invisible until the camera sees the wand again, and too small to detect for some snapshots more.
    seeing = np.flatnonzero(shown(made.truth).sum(-1).numpy()[:, bump.camera] >= 3)
    first = np.searchsorted(seeing, bump.snapshot)
    near = {f"{s:05d}" for s in seeing[max(first - 1, 0) : first + 2]} | {f"{bump.snapshot:05d}"}
    ((camera, snapshot, _), *others) = said["moved"]
    return "right" if camera == said["camera"] and snapshot in near and not others else "other"


def measure(seeds: int, moved: int, last: int, cores: int | None) -> dict[str, Any]:
    """Run all captures."""
    items = [Item(seed, False) for seed in range(seeds)] + [Item(1000 + seed, True) for seed in range(moved)]
    items += [Item(2000 + seed, True, 1 + seed % 2) for seed in range(last)]
    rows = []
    kept = StoredResults(WORK / "merging_wands", Path(__file__).read_text("utf-8"))
    with workers(None, cores, kept) as mapped:
        for row in mapped(run, items):
            rows.append(row)
            print(_brief(row), flush=True)
    steady = [row for row in rows if "camera" not in row]
    bumped = [row for row in rows if "camera" in row and row["last"] is None]
    ends = [row for row in rows if row.get("last")]
    return {"summary": dict(_summaries(steady, bumped, ends)), "steady": steady, "bumped": bumped, "last": ends}


def _summaries(*groups: list[dict[str, Any]]) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, rows in zip(("steady", "bumped", "bumped before the last one or two"), groups, strict=True):
        counts = Counter(row["outcome"] for row in rows)
        notes = sum(row["outcome"] == "accepted" and bool(row["doubtful"]) for row in rows)
        yield name, {"captures": len(rows), **dict(counts), "false_notes": notes}


def _brief(row: dict[str, Any]) -> str:
    keys = ("seed", "rig", "wand", "snapshots", "merged", "outcome", "camera", "before", "degrees", "moved", "doubtful",
            "reason", "cpu_s")  # fmt: skip
    return ", ".join(f"{key} {row[key]:.3g}" if isinstance(row[key], float) else f"{key} {row[key]}" for key in keys
                     if row.get(key) is not None)  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """Make the table, as Markdown."""
    kinds = ("accepted", "moved", "right", "other", "doubted", "refused", "false_notes")
    rows = [[n, str(row["captures"]), *(str(row.get(kind, 0)) for kind in kinds)] for n, row in result.items()]
    return markdown(["captures", "number", *(kind.replace("_", " ") for kind in kinds)], rows)


@dataclass(frozen=True)
class Options:
    """Calibrate captures of wands whose markers merge, with and without a bump."""

    seeds: int = 200  #: steady captures
    moved: int = 60  #: captures with a bump at a random snapshot
    last: int = 40  #: captures with a bump before the last snapshot or the last two
    cores: int | None = 1
    out: Path = RESULT


def main() -> None:
    """Run the captures, then count, write and print the outcomes."""
    options = tyro.cli(Options, description=__doc__)
    before, began = surroundings(), time.monotonic()
    result = measure(options.seeds, options.moved, options.last, options.cores)
    write_json(options.out, before | {"seconds": round(time.monotonic() - began)} | result)
    print(table(result["summary"]))


if __name__ == "__main__":
    command(main)

"""Single calibrations with the noise of a recording: steady cameras that are called moved, and moved ones that are not.

Run as `python -m scripts.benchmarks.replayed_captures`. Each capture simulates 27 seconds of a room with the residuals
of the recorded wand, people, merged blobs and wrong labels (`replayed_stream`), and is calibrated from every eighth
snapshot. Needs IMGCAL_CAPTURES. What has been run with the same code is not run again
(`out/work/replayed_captures`).
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from imgcal.errors import RefusedError
from imgcal.fleet import StoredResults, workers
from imgcal.types import MovedError
from scripts.benchmarks import replayed_stream
from scripts.benchmarks.replayed_stream import TEACHING, calibrated_stream
from scripts.benchmarks.rig_streams import Bump
from scripts.output import ROOT, WORK, command, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "replayed_captures.json"
ROOMS = ("room10", "ring8")
BUMPS = {"rotation": math.radians(0.06), "position": 4.0, "focal_length": 4.0}
"""Rad, mm, px: each some pixel in the images of a room."""
MOMENTS = (TEACHING // 2, TEACHING - 120)
"""Snapshots before which a camera is bumped: in the middle, and two seconds before the end."""
FOLLOWED = 480
"""Snapshots that the stream goes on for; they are not calibrated, but change what is drawn."""


@dataclass(frozen=True)
class Capture:
    """One capture."""

    room: str
    seed: int
    moment: int | None = None  # snapshot of a bump; None = nothing moves

    @property
    def kind(self) -> str:
        """Kind of the bump."""
        return tuple(BUMPS)[self.seed % len(BUMPS)]

    @property
    def camera(self) -> int:
        """Index of the camera that is bumped."""
        return self.seed % 8


def run(capture: Capture) -> dict[str, Any]:
    """Simulate and calibrate one capture."""
    began = time.process_time()
    bumps: tuple[Bump, ...] = ()
    row: dict[str, Any] = {"room": capture.room, "seed": capture.seed, "moment": capture.moment}
    if capture.moment is not None:
        bumps = (Bump(capture.moment, capture.camera, capture.kind, BUMPS[capture.kind]),)
        row |= {"camera": f"cam{capture.camera + 1:02d}", "kind": capture.kind}
    try:
        _, calibration = calibrated_stream(capture.room, capture.seed, FOLLOWED, bumps)
    except MovedError as error:
        row |= {"status": "moved", "moved": sorted({move.camera for move in error.moved}), "reason": str(error)}
    except RefusedError as error:
        row |= {"status": "refused", "reason": str(error)}
    else:
        row |= {"status": "calibrated", "rms_px": float(calibration.rms)}
        row["doubtful"] = [doubt.camera for doubt in calibration.doubtful]
    return row | {"cpu_s": time.process_time() - began}


def summarize(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Count."""
    steady, moved = [r for r in rows if r["moment"] is None], [r for r in rows if r["moment"] is not None]
    return {
        "steady": len(steady),
        "steady_by_status": dict(Counter(row["status"] for row in steady)),
        "steady_doubtful": sum(bool(row.get("doubtful")) for row in steady),
        "bumped": len(moved),
        "named": sum(row.get("moved") == [row["camera"]] for row in moved),
        "missed": sum(row["status"] == "calibrated" for row in moved),
        "another_named": sum(any(row["camera"] not in name for name in row.get("moved", ())) for row in moved),
    }


@dataclass(frozen=True)
class Options:
    """Calibrate captures with replayed noise."""

    steady: int = 80  #: captures of each room in which nothing moves
    bumped: int = 12  #: seeds of captures with a bump, each at two moments, in each room
    cores: int = 1
    out: Path = RESULT


def main() -> None:
    """Measure, and write the figures."""
    options = tyro.cli(Options, description=__doc__)
    captures = [Capture(room, seed) for seed in range(options.steady) for room in ROOMS]
    captures += [Capture(room, seed, at) for seed in range(options.bumped) for room in ROOMS for at in MOMENTS]
    scope = "\n".join(Path(str(name)).read_text("utf-8") for name in (__file__, replayed_stream.__file__))
    with workers(None, options.cores, StoredResults(WORK / "replayed_captures", scope)) as mapped:
        rows = []
        for row in mapped(run, captures):
            rows.append(row)
            print(row, flush=True)
    result = {**surroundings(), "found": summarize(rows), "captures": rows}
    write_json(options.out, result)
    print(result["found"])


if __name__ == "__main__":
    command(main)

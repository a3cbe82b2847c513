"""Targets for a running rig on the real stream: untouched, and with one camera rotated.

Run as `python -m scripts.benchmarks.real_stream`. A calibration uses every eighth of frames 0-2399; the keeper starts
from it and follows frames 2400-4799. Nothing moved in this recording, so every event except a loss of the wand is
false. A rotation can only be detected while the camera sees the wand, so delays count only that time. Finished runs of
the same code are not repeated (`out/work/real_stream`). The result is written after each case.

Other arrangements of the recording, whose results `--out` must name: `--calibrate 2400:4800 --follow 0:2400` turns its
halves round, `--follow 4800:2400` plays frames backwards, `--only cam01 cam04 cam08` leaves out all other cameras.

With `--lights`, the wand is unknown: its markers are separate lights at unknown positions. With `--stick 0 1 2`, the
distances of these markers are known, and the others are lights.
"""

from __future__ import annotations

import math
import tempfile
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import tyro

import imgcal
from imgcal.errors import InputError
from imgcal.fleet import StoredResults, workers
from imgcal.types import CalibrationObject
from scripts.benchmarks import wand_recording
from scripts.benchmarks.lights import part_of
from scripts.benchmarks.wand_recording import RATE, SEEN, Arrangement, calibrated, recording, turned
from scripts.output import ROOT, WORK, command, markdown, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "real_stream.json"
LIGHTS_RESULT = RESULT.with_name("real_stream_lights.json")
QUIET = ("camera_lost", "camera_back")
"""True events: cameras lose the wand. Each should be reported once."""
BUMPED = 600
"""Followed frames before a camera is rotated."""
AFTER = 6.0
"""Seconds of seeing the wand for which a rotated camera is followed, unless the recording ends before."""
LIMITS = {0.1: 5.0}
"""Seconds of seeing the wand within which a rotation (degrees) must be reported; default: `LIMIT`."""
LIMIT, LIGHTS_LIMIT = 1.0, 2.0
SCORE_EVERY = 100
"""Frames between scores."""
WORST_FINAL, WORST_ON_THE_WAY = 1.0, 1.2
"""Targets: error of the final rig relative to the calibration, and of any rig on the way relative to the first."""


def start(calibration: imgcal.Calibration, lights: bool = False, stick: tuple[int, ...] = ()) -> imgcal.RigKeeper:
    """Start a keeper from a new calibration.

    Args:
        calibration: its rig, and its object unless `lights`.
        lights: the markers are unknown.
        stick: those with known distances.
    """
    if not lights:
        return imgcal.RigKeeper(calibration.rig, calibration.obj)
    known = [part_of(calibration.object.as_exact(), stick)] if stick else []  # lengths in its file are up to 0.4 % off
    return imgcal.RigKeeper(calibration.rig, CalibrationObject.of_several([*known, CalibrationObject.unknown()]))


@dataclass(frozen=True)
class Case:
    """One run through the stream."""

    stride: int  # step between frames
    camera: int | None = None  # rotated camera; None = untouched
    degrees: float = 0.0
    lights: bool = False  # the wand is unknown
    stick: tuple[int, ...] = ()  # markers whose distances are known
    arrangement: Arrangement = Arrangement()

    @property
    def key(self) -> str:
        """Identify the result of the run."""
        seen = f"lights{''.join(f' {marker}' for marker in self.stick)}, " if self.lights else ""
        seen += "" if self.arrangement == Arrangement() else f"{self.arrangement}, "
        return f"{seen}stride {self.stride}, camera {self.camera}, {self.degrees} degrees"

    @property
    def frames(self) -> list[int]:
        """Followed frames."""
        return self.arrangement.followed[:: self.stride]

    @property
    def bumped_at(self) -> int:
        """First frame after a camera is rotated."""
        return self.arrangement.followed[BUMPED]


def run(case: Case) -> dict[str, Any]:
    """Run one case."""
    return untouched(case) if case.camera is None else bumped(case)


def untouched(case: Case) -> dict[str, Any]:
    """Follow the original stream; list all events, and score the rig on the way."""
    given, known, stride = recording(case.arrangement), calibrated(arrangement=case.arrangement), case.stride
    batch, batch_median = known.score(known.calibration.rig)
    events, scores, refused, began = [], [], Counter[str](), time.process_time()
    with start(known.calibration, case.lights, case.stick) as keeper:
        for count, number in enumerate(case.frames):
            state = keeper.update(given.frame(number), time=number / RATE)
            events += [plain(event, number) for event in state.events]
            if state.refused is not None:
                refused[state.refused.partition(":")[0]] += 1
            if count % max(SCORE_EVERY // stride, 1) == 0:
                scores.append([number, *known.score(state.rig)])
    seconds = time.process_time() - began
    final, final_median = known.score(state.rig)
    false = [event for event in events if event["event"] not in QUIET]
    return {
        "stride": stride,
        "frames": count + 1,
        "false": len(false),
        "false_by_kind": dict(Counter(event["event"] for event in false)),
        "lost": sum(event["event"] == "camera_lost" for event in events),
        "lost_twice": _lost_twice(events),
        "batch_px": [batch, batch_median],
        "final_px": [final, final_median],
        "final_to_batch": final / batch,
        "worst_to_start": max(score[1] for score in scores) / batch,
        "scale_percent": [100 * part for part in state.scale],
        "at_end": dict(Counter(state.cameras.values())),
        "refused": dict(refused),
        "scores_px": scores,
        "events": events,
        "ms_a_frame": 1000 * seconds / (count + 1),
    }


def bumped(case: Case) -> dict[str, Any]:
    """Rotate one camera, and follow the stream until it has seen the wand for a while."""
    given, known = recording(case.arrangement), calibrated(arrangement=case.arrangement)
    assert case.camera is not None
    name, since = given.factory.camera_names[case.camera], case.bumped_at
    seeing = [n for n in case.frames if n >= since and given.counts[n, case.camera] >= SEEN]
    last = seeing[: math.ceil(AFTER * RATE / case.stride)][-1]
    events, saved = kept_until_bump(replace(case, camera=None, degrees=0.0))
    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / "keeper.json").write_bytes(saved)
        keeper = imgcal.RigKeeper.restore(path)
    with keeper:
        for number in (n for n in case.frames if since <= n <= last):
            blobs = turned(given.frame(number), known.calibration.rig, case.camera, case.degrees)
            events = [*events, *(plain(e, number) for e in keeper.update(blobs, time=number / RATE).events)]
    limit = LIGHTS_LIMIT if case.lights else LIMITS.get(case.degrees, LIMIT)
    return {
        "stride": case.stride,
        "degrees": case.degrees,
        **judge(events, name, "rotation", since, seeing, limit, case.stride),
    }


@lru_cache(maxsize=1)
def kept_until_bump(case: Case) -> tuple[list[dict[str, Any]], bytes]:
    """Follow the stream until a camera is rotated; return all events, and the state of the keeper."""
    given, events = recording(case.arrangement), []
    calibration = calibrated(arrangement=case.arrangement).calibration
    with start(calibration, case.lights, case.stick) as keeper, tempfile.TemporaryDirectory() as folder:
        for number in (n for n in case.frames if n < case.bumped_at):
            events += [plain(e, number) for e in keeper.update(given.frame(number), time=number / RATE).events]
        keeper.save(path := Path(folder) / "keeper.json")
        return events, path.read_bytes()


def judge(
    events: list[dict[str, Any]],
    camera: str,
    kind: str,
    since: int,
    seeing: Sequence[int],
    limit: float,
    stride: int = 1,
) -> dict[str, Any]:
    """Judge whether a bump was reported in time, and count other events.

    Args:
        events: from `plain`.
        camera: the bumped camera.
        kind: of the bump.
        since: first frame after the bump.
        seeing: frames after the bump in which that camera sees the object, in ascending order.
        limit: seconds of seeing the object.
        stride: step between frames.

    Returns:
        Among others `delay_s`, the time from the first frame in `seeing`, and `seen_s`, how long the camera saw the
        object in that time.
    """
    loud = [event for event in events if event["event"] not in QUIET]
    before, after = ([e for e in loud if (e["frame"] >= since) is late] for late in (False, True))
    moves = [e for e in after if e["event"] == "moved"]
    own = [e for e in moves if e["camera"] == camera]
    sized = [e for e in own if e["size"] is not None]
    delay = (own[0]["frame"] - seeing[0]) / RATE if own else None
    seen = (bisect_right(seeing, own[0]["frame"]) - 1) * stride / RATE if own else None
    found = sized[-1]["change"] if sized else None
    return {
        "camera": camera,
        "seen_frame": seeing[0],
        "delay_s": delay,
        "seen_s": seen,
        "in_time": seen is not None and seen <= limit,
        "kind": found,
        "right_kind": found == kind,
        "size": [sized[-1]["size"], sized[-1]["sigma"]] if sized else None,
        "others_blamed": sorted({e["camera"] for e in moves} - {camera}),
        "other_events": dict(Counter(e["event"] for e in after if e["event"] not in ("moved", "relearnt"))),
        "false_before": len(before),
        "events": after,
    }


def plain(event: imgcal.Event, frame: int) -> dict[str, Any]:
    """Convert an event into plain values."""
    return {
        "frame": frame, "event": event.kind, "camera": event.camera, "change": event.change, "size": event.size,
        "sigma": event.sigma, "unit": event.unit, "message": event.message,
    }  # fmt: skip


def _lost_twice(events: list[dict[str, Any]]) -> int:
    """Count repeated losses of cameras that had not come back in between."""
    gone, twice = set(), 0
    for event in events:
        if event["event"] == "camera_lost":
            twice += event["camera"] in gone
            gone.add(event["camera"])
        if event["event"] == "camera_back":
            gone.discard(event["camera"])
    return twice


def summarize(bumps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Count the outcomes of bumps, by size and stride."""
    groups: dict[tuple[int, float], list[dict[str, Any]]] = {}
    for bump in bumps:
        groups.setdefault((bump["stride"], bump["degrees"]), []).append(bump)
    rows = []
    for (stride, degrees), group in sorted(groups.items()):
        delays = sorted(bump["seen_s"] for bump in group if bump["in_time"])
        rows.append(
            {
                "stride": stride,
                "degrees": degrees,
                "bumps": len(group),
                "in_time": len(delays),
                "right": sum(b["in_time"] and b["right_kind"] and not b["others_blamed"] for b in group),
                "others_blamed": sum(bool(bump["others_blamed"]) for bump in group),
                "median_seen_s": delays[len(delays) // 2] if delays else None,
                "false_before": sum(bump["false_before"] for bump in group),
            }
        )
    return rows


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Make the tables, by name."""
    quiet = [
        [
            str(row["stride"]), str(row["false"]), ", ".join(f"{n} {k}" for k, n in row["false_by_kind"].items()),
            f"{row['lost']} ({row['lost_twice']})", f"{row['final_px'][0]:.3f}", f"{row['final_to_batch']:.2f}",
            f"{row['worst_to_start']:.2f}", f"{row['ms_a_frame']:.1f}",
        ]
        for row in result["untouched"]
    ]  # fmt: skip
    turns = [
        [
            str(row["stride"]), f"{row['degrees']:g}", f"{row['in_time']} of {row['bumps']}",
            f"{row['right']} of {row['bumps']}", str(row["others_blamed"]),
            "-" if row["median_seen_s"] is None else f"{row['median_seen_s']:.2f}", str(row["false_before"]),
        ]
        for row in result["bumps"]
    ]  # fmt: skip
    head = ["every", "false events", "which", "losses (reported twice)", "final px", "to calibration", "worst to start",
            "ms per frame"]  # fmt: skip
    turn = [
        "every",
        "degrees",
        "in time",
        "right kind",
        "other cameras blamed",
        "time in view, s (median)",
        "false events before",
    ]
    return {"real stream untouched": markdown(head, quiet), "real stream bumps": markdown(turn, turns)}


@dataclass(frozen=True)
class Options:
    """Follow the recorded wand, untouched and with one camera rotated."""

    strides: tuple[int, ...] = (1, 2, 3, 4, 8)  #: steps between frames, untouched
    bumps: tuple[float, ...] = (0.1, 0.3, 1.0)  #: degrees
    bump_strides: tuple[int, ...] = (1,)  #: steps between frames, with a rotated camera
    cameras: tuple[int, ...] = tuple(range(10))  #: cameras to rotate, each in a separate run
    cores: int = 1  #: processes over the cases; the result is the same
    fresh: bool = False  #: calibrate again instead of using the cached calibration
    lights: bool = False  #: follow the markers as unknown lights
    stick: tuple[int, ...] = ()  #: markers of the wand whose distances are known; the others are lights
    arrangement: tyro.conf.OmitArgPrefixes[Arrangement] = Arrangement()
    out: Path | None = None  #: default: docs/benchmarks/real_stream.json, ..._lights.json or ..._stick_0_1_2.json


def main() -> None:
    """Run the cases, then count, write and print the results."""
    options = tyro.cli(Options, description=__doc__)
    arrangement = options.arrangement
    if arrangement != Arrangement() and options.out is None:
        raise InputError("out: found nothing, expected the file for the result of another arrangement")
    known = calibrated(options.fresh, arrangement)
    texts = [Path(str(module)).read_text("utf-8") for module in (__file__, wand_recording.__file__)]
    rms = float(known.calibration.rms)
    lights = options.lights or bool(options.stick)
    cases = [
        Case(stride, lights=lights, stick=options.stick, arrangement=arrangement) for stride in options.strides
    ] + [
        Case(stride, camera, degrees, lights, options.stick, arrangement)
        for stride in options.bump_strides
        for degrees in options.bumps
        for camera in options.cameras
        if not arrangement.only or camera < len(arrangement.only)
    ]
    name = f"real_stream_stick_{'_'.join(map(str, options.stick))}.json"
    usual = RESULT.with_name(name) if options.stick else LIGHTS_RESULT if lights else RESULT
    out = options.out or usual
    with workers(None, options.cores, StoredResults(WORK / "real_stream", f"{rms!r}\n" + "\n".join(texts))) as mapped:
        found = []
        for case, row in zip(cases, mapped(run, cases), strict=True):
            found.append(row)
            print(case.key, _brief(row), flush=True)
            result = collect(found, rms)
            write_json(out, result)  # after each case: what is done is kept if the rest is not
    print("\n\n".join(tables(result).values()))


def collect(found: Sequence[dict[str, Any]], rms: float) -> dict[str, Any]:
    """Collect the rows of finished cases; `rms`: residual of the calibration in pixels."""
    runs = [row for row in found if "degrees" in row]
    return {
        **surroundings(),
        "calibration_rms_px": rms,
        "gates": {"final_to_batch": WORST_FINAL, "worst_to_start": WORST_ON_THE_WAY, "false": 0},
        "untouched": [row for row in found if "degrees" not in row],
        "bumps": summarize(runs),
        "bump_runs": runs,
    }


def _brief(row: dict[str, Any]) -> str:
    keys = ("false", "lost", "final_px", "final_to_batch", "worst_to_start", "delay_s", "seen_s", "in_time", "kind",
            "size", "others_blamed", "other_events", "false_before")  # fmt: skip
    return ", ".join(f"{key} {row[key]}" for key in keys if key in row)


if __name__ == "__main__":
    from scripts.benchmarks import real_stream  # workers find its functions by this name

    command(real_stream.main)

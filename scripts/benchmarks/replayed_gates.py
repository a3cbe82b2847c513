"""Targets for a running rig with replayed noise: untouched for hours, and with bumped cameras.

Run as `python -m scripts.benchmarks.replayed_gates`. Each item simulates a place with the noise of the recorded wand
(`replayed_stream`), calibrates it, and keeps it calibrated from there on. Finished items of the same code are not run
again (`out/work/replayed_gates`); the result contains the items that were run within `--minutes`, with `--add` also
those that it contained before. Each states its commit.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from imgcal.errors import RefusedError
from imgcal.fleet import StoredResults, workers
from scripts.benchmarks import real_stream, replayed_noise, replayed_stream
from scripts.benchmarks.followed_streams import SURELY, distance
from scripts.benchmarks.real_stream import LIMIT, QUIET, RATE, SEEN, judge, plain, start
from scripts.benchmarks.replayed_noise import recorded_residuals, recorded_series, statistics
from scripts.benchmarks.replayed_stream import PLACES, TEACHING, calibrated_stream
from scripts.benchmarks.rig_streams import Bump
from scripts.benchmarks.wand_recording import calibrated
from scripts.output import ROOT, WORK, command, commit, markdown, read_json, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "replayed_noise.json"
LONG = 6000
"""Snapshots in an item without a bump."""
BEFORE, AFTER = 300, 480
"""Snapshots before a bump, and those in which the camera sees the object after it."""
BUMPS = {"rotation": math.radians(0.3), "position": 20.0, "focal_length": 20.0, "principal_point": 5.0}
"""Rad, mm, px: each about five pixels in the rigs of a room."""
LOOK_EVERY = 60
"""Snapshots between evaluations of the belief, and the first evaluation."""
EIGHT_HOURS = 1_728_000
VALUES = 10
"""Parameters of a camera in `distance`."""


@dataclass(frozen=True)
class Item:
    """One work item."""

    place: str
    seed: int
    kind: str | None = None  # of the bump; None = no bump
    snapshots: int = LONG

    @property
    def key(self) -> str:
        """Identify the result of the item."""
        return f"{self.place} {self.seed} {self.kind} {self.snapshots}"


def run(item: Item) -> dict[str, Any]:
    """Run one item."""
    bumps: tuple[Bump, ...] = ()
    count = item.snapshots
    if item.kind is not None:
        camera = item.seed % (8 if item.place == "ring8" else 10)
        bumps = (Bump(TEACHING + BEFORE, camera, item.kind, BUMPS[item.kind]),)
        count = BEFORE + 4 * AFTER
    began = time.process_time()
    said = {"place": item.place, "seed": item.seed, "bump": item.kind, "commit": commit()}
    try:
        stream, calibration = calibrated_stream(item.place, item.seed, count, bumps)
    except RefusedError as reason:
        return {**said, "refused": str(reason)}
    taught = time.process_time() - began
    events: list[dict[str, Any]] = []
    looks: list[list[float]] = []  # chi-squared of each camera that is reported as ok
    seeing, learnt = list[int](), 0  # numbers of the snapshots in which a bumped camera sees the object
    names = stream.factory.camera_names
    with start(calibration) as keeper:
        for number in range(TEACHING, TEACHING + count):
            blobs = stream.snapshot(number)
            state = keeper.update(blobs, time=number / RATE)
            learnt += state.refused is None
            events += [plain(event, number) for event in state.events]
            if number % LOOK_EVERY == 0:
                chi2 = distance(state.belief, stream.rig).tolist()
                looks.append([c for c, name in zip(chi2, names, strict=True) if state.cameras[name] == "ok"])
            if bumps and number >= bumps[0].snapshot and (blobs.camera == bumps[0].camera).sum() >= SEEN:
                seeing.append(number)
            if len(seeing) >= AFTER:
                break
    chi2s = np.array([c for look in looks for c in look])
    with start(calibration) as keeper:
        assert stream.place is not None
        at_first = distance(keeper.belief, stream.place.truth)
    found = {
        **said,
        "snapshots": number + 1 - TEACHING,
        "learnt": learnt,
        "looks": len(chi2s),
        "nees": float(chi2s.mean() / VALUES) if len(chi2s) else None,
        "nees_median": float(np.median(chi2s) / VALUES) if len(chi2s) else None,
        "beyond_3_sigma": int((chi2s > SURELY).sum()),
        "lost": sum(event["event"] == "camera_lost" for event in events),
        "calibration_rms_px": float(calibration.rms),
        "calibration_nees": float(at_first.mean() / VALUES),
        "calibration_beyond_3_sigma": float((at_first > SURELY).double().mean()),
        "s_to_calibrate": taught,
        "cpu_s": time.process_time() - began,
    }
    if bumps:
        if not seeing:
            return {**found, "unseen": True}
        name = names[bumps[0].camera]
        return {**found, **judge(events, name, bumps[0].kind, bumps[0].snapshot, seeing, LIMIT)}
    false = [event for event in events if event["event"] not in QUIET]
    return {**found, "false": len(false), "events": false}


def items(snapshots: int = LONG, bumped: int | None = None, first: int = 0) -> Iterator[Item]:
    """Yield endless items from number `first`: quiet ones, each below `bumped` (None = all) followed by two bumps."""
    kinds, number = tuple(BUMPS), first
    while True:
        place = PLACES[number % len(PLACES)]
        yield Item(place, number, snapshots=snapshots)
        if bumped is None or number < bumped:
            yield Item(place, 100_000 + 2 * number, kinds[2 * number % len(kinds)])
            yield Item(place, 100_001 + 2 * number, kinds[(2 * number + 1) % len(kinds)])
        number += 1


def summarize(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Count the results of each place."""
    done = [row for row in rows if "refused" not in row]
    quiet, bumps = [r for r in done if "false" in r], [r for r in done if "in_time" in r]
    looks = sum(row["looks"] for row in quiet)
    kinds = Counter(event["event"] for row in quiet for event in row["events"])
    delays = sorted(row["seen_s"] for row in bumps if row["in_time"])
    return {
        "calibrations_refused": [f"{r['place']} {r['seed']}: {r['refused']}" for r in rows if "refused" in r],
        "snapshots": sum(row["snapshots"] for row in quiet),
        "false": sum(row["false"] for row in quiet),
        "false_by_kind": dict(kinds),
        "false_in_8_hours": (
            EIGHT_HOURS * sum(r["false"] for r in quiet) / sum(r["snapshots"] for r in quiet) if quiet else None
        ),
        "lost": sum(row["lost"] for row in quiet),
        "looks": looks,
        "nees": sum(r["nees"] * r["looks"] for r in quiet if r["looks"]) / looks if looks else None,
        "nees_median": float(np.median([row["nees_median"] for row in quiet if row["looks"]])) if looks else None,
        "nees_deviation": _deviation([row["nees"] for row in quiet if row["looks"]]),
        "beyond_3_sigma": sum(row["beyond_3_sigma"] for row in quiet) / looks if looks else None,
        "calibrations": len(done),
        "calibration_nees": _mean([row["calibration_nees"] for row in done]),
        "calibration_nees_deviation": _deviation([row["calibration_nees"] for row in done]),
        "calibration_beyond_3_sigma": _mean([row["calibration_beyond_3_sigma"] for row in done]),
        "bumps": len(bumps),
        "in_time": len(delays),
        "right": sum(row["in_time"] and row["right_kind"] and not row["others_blamed"] for row in bumps),
        "others_blamed": sum(bool(row["others_blamed"]) for row in bumps),
        "median_seen_s": delays[len(delays) // 2] if delays else None,
    }


def compared() -> list[dict[str, Any]]:
    """Statistics of the recorded residuals of each camera, and of the replayed ones."""
    residual, series = recorded_residuals(), recorded_series()
    replay = replayed_noise.Replay(series, residual.shape[2], np.random.default_rng(1)).draw(12_000)
    found = []
    for camera in range(residual.shape[1]):
        row = {"camera": camera, "recorded": statistics(residual[:, camera])}
        if len(series) == residual.shape[1]:
            row["replayed"] = statistics(replay[:, camera])
        found.append(row)
    return found


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Make the tables, by name."""
    head = ["place", "snapshots", "false events", "in 8 hours", "NEES (median)", "beyond 3 sigma", "bumps in time",
            "right kind", "other cameras blamed"]  # fmt: skip
    rows = [
        [
            place, f"{part['snapshots']:,}", str(part["false"]), _figure(part["false_in_8_hours"], ".0f"),
            f"{_figure(part['nees'], '.2f')} ({_figure(part['nees_median'], '.2f')})",
            _figure(part["beyond_3_sigma"], ".1%"),
            f"{part['in_time']} of {part['bumps']}", f"{part['right']} of {part['bumps']}", str(part["others_blamed"]),
        ]
        for place, part in result["found"].items()
    ]  # fmt: skip
    noise = [
        [
            f"cam{row['camera']:02d}",
            *(
                " / ".join(f"{row[which][key]:.3f}" for which in ("recorded", "replayed") if which in row)
                for key in ("spread_px", "shift_px", "independent_px")
            ),
            *(
                " / ".join(
                    f"{row[which]['shift_correlation'][lag]:.2f}" for which in ("recorded", "replayed") if which in row
                )
                for lag in row["recorded"]["shift_correlation"]
            ),
        ]
        for row in result["noise"]
    ]
    lags = [f"lag {lag}" for lag in replayed_noise.LAGS]
    return {
        "replayed noise": markdown(head, rows),
        "replayed residuals": markdown(
            ["recorded / replayed", "spread px", "shared shift px", "if independent", *lags], noise
        ),
    }


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _deviation(values: list[float]) -> float | None:
    """Standard deviation of the mean of independent values."""
    return float(np.std(values, ddof=1) / len(values) ** 0.5) if len(values) > 1 else None


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


@dataclass(frozen=True)
class Options:
    """Keep simulated rigs under replayed noise."""

    minutes: float = 60.0  #: start no item later than this; the next run resumes
    count: int = 10_000  #: largest number of items
    snapshots: int = LONG  #: per item without a bump
    bumped: int | None = None  #: number of items without a bump that are followed by two with one; default: all
    cores: int = 1
    add: bool = False  #: keep the items in `--out`, and go on after the last of them
    fresh: bool = False  #: calibrate the recording again, instead of using cached residuals
    out: Path = RESULT


def main() -> None:
    """Run the items, then count, write and print the results."""
    options = tyro.cli(Options, description=__doc__)
    if options.fresh:
        calibrated(anew=True)
        replayed_noise.CACHE.unlink(missing_ok=True)
    noise = compared()
    rows: list[dict[str, Any]] = read_json(options.out)["items"] if options.add else []
    first = max((row["seed"] + 1 for row in rows if row["bump"] is None), default=0)
    modules = (__file__, real_stream.__file__, replayed_noise.__file__, replayed_stream.__file__)
    kept = StoredResults(WORK / "replayed_gates", "\n".join(Path(str(name)).read_text("utf-8") for name in modules))
    until = time.monotonic() + 60 * options.minutes
    some = takewhile(
        lambda pair: pair[0] < options.count and time.monotonic() < until,
        enumerate(items(options.snapshots, options.bumped, first)),
    )
    with workers(None, options.cores, kept) as mapped:
        for row in mapped(run, (item for _, item in some)):
            rows.append(row)
            shown = ("place", "seed", "bump", "refused", "false", "nees", "nees_median", "in_time", "seen_s", "cpu_s")
            print({key: row[key] for key in shown if key in row}, flush=True)
    places = {"all": rows} | {place: [r for r in rows if r["place"] == place] for place in PLACES}
    result = {
        **surroundings(),
        "found": {place: summarize(part) for place, part in places.items() if part},
        "noise": noise,
        "items": rows,
    }
    write_json(options.out, result)
    print("\n\n".join(tables(result).values()))


if __name__ == "__main__":
    command(main)

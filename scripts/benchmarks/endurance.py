"""A day of `imgcal watch`, accelerated: cameras fail, frames come late or are garbage, the process is killed.

Usage: python -m scripts.benchmarks.endurance [--hours 24] [--rate 1] [--steady 20000] [--seconds S] [--out FILE]

Two parts, both with blobs of a simulated rig and the same faults: a day in which the process is killed (SIGKILL) every
few simulated minutes and resumes from its files; and one undisturbed process, to measure its memory and latency. With
--seconds each part ends after that time; the result says how far it came.
"""

from __future__ import annotations

import argparse
import json
import math
import mmap
import os
import random
import shutil
import signal
import struct
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from imgcal.estimation import EstimationOptions, estimate
from imgcal.online import RigKeeper  # imported before processes are forked
from imgcal.types import Observations
from imgcal.watch import STATE, SourceReader, Timing, Watch
from scripts.benchmarks.endurance_world import EPOCH, SLOWED, Replay, World
from scripts.benchmarks.rig_streams import Bump
from scripts.output import ROOT, fill, surroundings, write_json

RESULT, PAGE = ROOT / "docs" / "benchmarks" / "endurance.json", ROOT / "docs" / "watch.md"
RECORDED_EVERY = 20  # snapshots
WARMING = 300  # snapshots before measurements begin
ALLOWED_PX = 0.5  # error in the image, at the object, of a camera that is reported as ok


def live(world: World, folder: Path, first: int, last: int, place: mmap.mmap) -> None:
    """Watch from a snapshot on, as `imgcal watch` does, and log each step."""
    path = folder / STATE
    keeper = RigKeeper.restore(path) if path.is_file() else RigKeeper(world.factory, world.obj)
    intake = SourceReader(Replay(world, first, last, place), world.factory, Timing())
    took: list[float] = []
    with keeper, Watch(keeper, folder) as loop, open(folder / "record.jsonl", "a", buffering=1) as record:
        done = 0

        def looked() -> None:
            nonlocal done
            tally = loop.tally
            if tally.latest is None or tally.snapshots < done + RECORDED_EVERY:
                return
            done = tally.snapshots
            state = tally.latest
            counts = {kind: count.total() for kind, count in intake.synchronizer.counts.items()}
            entry = {
                "number": round((state.time - EPOCH) * world.rate), "pid": os.getpid(), "snapshots": tally.snapshots,
                "learnt": tally.learnt, "seconds": tally.seconds, "cpu": took[-RECORDED_EVERY:],
                "resident": _resident(), "cameras": dict(state.cameras), "refused": state.refused,
                "step": state.rig.local(world.factory).tolist(), "counts": counts, "dropped": intake.dropped,
                "unreadable": intake.unreadable.total(),
            }  # fmt: skip
            took.clear()
            record.write(json.dumps(entry) + "\n")

        update = keeper.update

        def timed(*given: Any) -> Any:
            started = time.thread_time()
            result = update(*given)
            took.append(time.thread_time() - started)
            return result

        keeper.update = timed  # type: ignore[method-assign, assignment]
        with intake:
            loop.run(intake, threading.Event(), looked)


def _resident() -> int:
    """Resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


def forked(world: World, folder: Path, first: int, last: int, kill_at: int | None, ends: float) -> int:
    """Watch in a forked process that is killed at a snapshot or a time; return the last snapshot that it reached."""
    place = mmap.mmap(-1, 8)
    place[:8] = struct.pack("q", first)
    process = os.fork()
    if process == 0:
        try:
            live(world, folder, first, last, place)
            os._exit(0)
        finally:
            import traceback

            traceback.print_exc()
            os._exit(1)
    while True:
        ended, status = os.waitpid(process, os.WNOHANG)
        reached = int(struct.unpack("q", place[:8])[0])
        if ended:
            if status:
                raise SystemExit(f"endurance: the watching process ended with {status} at snapshot {reached}")
            return reached
        if (kill_at is not None and reached >= kill_at) or time.perf_counter() > ends:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            return int(struct.unpack("q", place[:8])[0])
        time.sleep(0.01)


def warm_up(world: World, folder: Path) -> None:
    """Watch briefly in this process, so that forked processes inherit the compiled code instead of loading it."""
    live(world, folder, 0, min(WARMING, world.snapshots), mmap.mmap(-1, 8))
    live(world, folder, 0, 1, mmap.mmap(-1, 8))  # resume from its file


def records(folder: Path) -> list[dict[str, Any]]:
    found = []
    for line in (folder / "record.jsonl").read_text().splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:  # the process was killed while it wrote this
            continue
    return found


def errors(world: World, step: Any, number: int) -> np.ndarray:
    """RMS error (px) of each camera at the object, whose pose is fitted to the reported rig: (C,)."""
    rig, found = world.rig(number), world.factory.retract(torch.tensor(step, dtype=torch.float64))
    pose = world.stream.pose_at(number / world.rate / SLOWED)
    seen = rig.expand(1).project(pose.apply(world.obj.points), world.obj.radius)
    observations = Observations(seen.uv, torch.full_like(seen.uv[..., 0], 0.3), seen.visible)
    held = torch.zeros(rig.num_cameras, 15, dtype=torch.float64)
    fit = estimate(observations, found, world.obj, pose, prior_std=held, options=EstimationOptions(loss="cauchy"))
    squared = fit.residual.square().sum(-1).sum((0, 2))
    rms: np.ndarray = (squared / seen.visible.sum((0, 2)).clamp_min(1)).sqrt().numpy()
    return rms


def killed_day(world: World, folder: Path, minutes: float, seconds: float) -> dict[str, Any]:
    """Part one: SIGKILL every few simulated minutes."""
    draw, at, lives = random.Random(1), 0, 0
    started = time.perf_counter()
    while at < world.snapshots and time.perf_counter() < started + seconds:
        kill_at = at + max(int(draw.expovariate(1 / (60 * minutes * world.rate))), RECORDED_EVERY)
        kill = kill_at if kill_at < world.snapshots else None
        at = forked(world, folder, at, world.snapshots, kill, started + seconds)
        lives += 1
    world = world.until(at)
    found = records(folder)
    told = [json.loads(line) for line in (folder / "events.jsonl").read_text().split("\n")[:-1]]
    checked, wrong, worst, waited = 0, [], 0.0, 0
    off: list[float] = []
    for entry in found:
        fits = errors(world, entry["step"], entry["number"])
        for camera, name in enumerate(world.factory.camera_names):
            if entry["cameras"][name] == "ok" and world.has_shown(entry["number"], camera):
                checked += 1
                off.append(float(fits[camera]))
                if fits[camera] > ALLOWED_PX:
                    wrong.append((entry["number"], name, round(float(fits[camera]), 3)))
                    worst = max(worst, float(fits[camera]))
    last: dict[int, dict[str, Any]] = {}
    longest = run = 0
    for entry in found:  # with the object in view, but nothing learned since the previous record
        before = last.get(entry["pid"])
        last[entry["pid"]] = entry
        idle = before is not None and entry["learnt"] == before["learnt"]
        there = not any(world.is_absent(n) for n in range(entry["number"] - RECORDED_EVERY, entry["number"]))
        run = run + RECORDED_EVERY if idle and there else (0 if not idle else run)
        longest = max(longest, run)
        waited += idle
    ends = list(last.values())
    moved = [event for event in told if event["event"] == "moved"]
    named = sum(any(_is_of(event, bump, world) for event in moved) for bump in world.bumps)
    false = [event for event in moved if not any(_is_of(event, bump, world) for bump in world.all_bumps)]
    return {
        "simulated_hours": world.snapshots / world.rate / 3600, "snapshots_per_second": world.rate,
        "snapshots": world.snapshots, "kills": lives - 1, "seconds": time.perf_counter() - started,
        "worked_on": sum(e["snapshots"] for e in ends), "learnt": sum(e["learnt"] for e in ends),
        "with_object": sum(not world.is_absent(n) for n in range(world.snapshots)),
        "late": sum(e["counts"]["late"] for e in ends), "duplicate": sum(e["counts"]["duplicate"] for e in ends),
        "astray": sum(e["counts"]["clock_off"] for e in ends), "missing": sum(e["counts"]["missing"] for e in ends),
        "unreadable": sum(e["unreadable"] for e in ends),
        "cameras_checked_while_ok": checked, "error_px_median": float(np.median(off)),
        "error_px_p99": float(np.quantile(off, 0.99)), "wrong_while_ok": len(wrong), "wrong": wrong[:20],
        "worst_px": worst, "longest_without_learning": longest,
        "bumps": len(world.bumps), "bumps_told": named, "moved_events_of_nothing": len(false),
        "image_events_of_nothing": sum(event["event"] in ("dirty", "defocused") for event in told),
        "clock_slips_of_nothing": sum(event["event"] == "clock_slip" for event in told),
        "restart_events": sum(event["event"] == "restart" for event in told),
    }  # fmt: skip


def _is_of(event: dict[str, Any], bump: Bump, world: World) -> bool:
    from datetime import datetime

    since = (datetime.fromisoformat(event["since"]).timestamp() - EPOCH) * world.rate
    near = bump.snapshot - 5 <= since <= bump.snapshot + 1800 * world.rate  # the camera or the object may be away
    return near and event["camera"] == world.factory.camera_names[bump.camera]


def steady_life(world: World, folder: Path, seconds: float) -> dict[str, Any]:
    """Part two: memory and latency of one process."""
    started = time.perf_counter()
    forked(world, folder, 0, world.snapshots, None, started + seconds)
    found = records(folder)
    tenth = len(found) // 10
    parts = [found[i * tenth : (i + 1) * tenth] for i in range(10)]
    resident = [float(np.median([entry["resident"] for entry in part])) / 2**20 for part in parts]
    p99 = [1e3 * float(np.quantile([s for entry in part for s in entry["cpu"]], 0.99)) for part in parts]
    p50 = [1e3 * float(np.quantile([s for entry in part for s in entry["cpu"]], 0.5)) for part in parts]
    return {
        "snapshots": found[-1]["snapshots"], "seconds": time.perf_counter() - started,
        "resident_mib_by_tenth": resident, "resident_growth": resident[-1] / resident[1] - 1,
        "update_cpu_ms_p99_by_tenth": p99, "update_cpu_ms_p50_by_tenth": p50,
    }  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """Make the table of the page."""
    day, steady = result["killed_day"], result["steady"]
    rows = [
        ("simulated", f"{day['simulated_hours']:.3g} h at {day['snapshots_per_second']:g} snapshots/s"),
        ("killed and restarted", f"{day['kills']} times"),
        ("snapshots / with the object / learned from",
         f"{day['snapshots']:,} / {day['with_object']:,} / {day['learnt']:,}"),
        ("exposures late / duplicated / with a wrong clock / unreadable",
         f"{day['late']:,} / {day['duplicate']:,} / {day['astray']:,} / {day['unreadable']:,}"),
        ("bumps of 0.3 degrees / reported with the right camera", f"{day['bumps']} / {day['bumps_told']}"),
        ("moves reported of steady cameras", f"{day['moved_events_of_nothing']}"),
        ("false reports of dirty or defocused cameras / of clock slips",
         f"{day['image_events_of_nothing']} / {day['clock_slips_of_nothing']}"),
        ("cameras reported as ok, with errors above 0.5 px",
         f"{day['wrong_while_ok']} of {day['cameras_checked_while_ok']:,}"),
        ("error of cameras reported as ok, median / 99 %",
         f"{day['error_px_median']:.3f} / {day['error_px_p99']:.3f} px"),
        ("longest time without learning while the object was there", f"{day['longest_without_learning']} snapshots"),
        ("one undisturbed process", f"{steady['snapshots']:,} snapshots"),
        ("its memory, last tenth relative to the second", f"{100 * steady['resident_growth']:+.2f} %"),
        ("its update (CPU), 99 %, second tenth / last",
         f"{steady['update_cpu_ms_p99_by_tenth'][1]:.1f} / {steady['update_cpu_ms_p99_by_tenth'][-1]:.1f} ms"),
    ]  # fmt: skip
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--rate", type=float, default=1.0, help="snapshots per simulated second")
    parser.add_argument("--minutes", type=float, default=5.0, help="simulated minutes between kills")
    parser.add_argument("--bumps", type=int, default=12)
    parser.add_argument("--steady", type=int, default=20_000, help="snapshots of the undisturbed process")
    parser.add_argument("--seconds", type=float, default=math.inf, help="time limit of each part")
    parser.add_argument("--out", type=Path, default=RESULT)
    given = parser.parse_args()
    words = " ".join(f"--{name} {value:g}" for name, value in vars(given).items() if name != "out")
    torch.set_num_threads(1)
    folder = Path(tempfile.mkdtemp(prefix="endurance-"))
    try:
        result = {}
        for name in ("warming", "killed_day", "steady"):
            (folder / name).mkdir()
        world = World(int(given.hours * 3600 * given.rate), given.rate, given.bumps)
        warm_up(World(WARMING, given.rate, 1), folder / "warming")
        result["killed_day"] = killed_day(world, folder / "killed_day", given.minutes, given.seconds)
        world = World(given.steady, given.rate, max(given.bumps * given.steady // world.snapshots, 1), seed=1)
        result["steady"] = steady_life(world, folder / "steady", given.seconds)
    finally:
        shutil.rmtree(folder)
    write_json(given.out, {**surroundings(), "command": f"python -m scripts.benchmarks.endurance {words}", **result})
    print(table(result))
    if given.out.resolve() == RESULT:
        fill(PAGE, {"endurance": table(result)})


if __name__ == "__main__":
    main()

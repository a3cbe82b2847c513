"""Can the alarms be trusted? Steady and drifting rigs without end, and rigs of which cameras are bumped.

Work is cut into items, each with its own seed, which cores or a cluster take; what is done is kept in a file, a line an
item, so that a run can be stopped and gone on with. `monitor` items feed labelled fiducials to `RigMonitor`, `keeper`
items unlabelled blobs among false ones to `RigKeeper`.
"""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

import imgcal
from imgcal.errors import RefusedError
from imgcal.estimation import (
    Change,
    Gauge,
    RigBelief,
    RigFilter,
    RigMonitor,
    estimate,
    initial_pose,
    pixel_changes,
    spread_of,
    widened,
)
from imgcal.fleet import Mapped, workers
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.types import CameraRig, DriftRate, Observations
from scripts.benchmarks.rig_streams import Bump, Conditions, Stream
from scripts.output import BLUE, GREEN, GREY, RED, ROOT, command, figure, fill, markdown, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "alarms.json"
PAGE = ROOT / "docs" / "benchmarks.md"
PLOT = ROOT / "docs" / "benchmarks" / "alarms.png"
ITEMS = ROOT / "out" / "alarms" / "items.jsonl"
RIGS = ("T4", "O6", "U7", "O10")
GATE = {"rotation": math.radians(0.1), "position": 1.0, "focal_length": 3.0, "principal_point": 1.0}
SWEPT = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Of the sizes of `GATE`; the last is those themselves."""
BEFORE, AFTER = 300, 300
"""Snapshots before and after a bump: at 60 a second."""
BLOCK = 100
"""Snapshots that are simulated at once; `BEFORE` is so many times as many."""
LONG = 6000
"""Snapshots of an item without a bump."""
GOAL = 1_730_000
"""Snapshots of eight hours."""
SURELY = 26.9
"""Chi-squared, ten degrees of freedom: what 3 sigma are of a single value."""
CREEP = math.radians(0.1) / 36000
"""Rad a snapshot: 0.1 degree in ten minutes."""


@dataclass(frozen=True)
class Item:
    """Something to run."""

    name: str
    seed: int

    @property
    def key(self) -> str:
        """What it is found by among what is done."""
        return f"{self.name} {self.seed}"


COUNTS = {
    "monitor steady": 145, "monitor drifting": 145, "monitor bump": 500, "monitor sweep": 240, "monitor two": 60,
    "monitor away": 60, "monitor half degree": 60, "monitor creep": 4, "monitor whole rig": 40,
    "keeper steady": 20, "keeper drifting": 20, "keeper bump": 120,
}  # fmt: skip
"""Items of each experiment: without a bump, `GOAL` snapshots together."""

PACE = {"monitor bump": 1.0, "monitor steady": 3.0, "monitor drifting": 3.0}
"""When the bumps are done, a third of the long ones is, and of the others a fifth."""
OTHERS = 5.0


class Followed:
    """A stream, and the monitor that follows it by labelled fiducials."""

    def __init__(self, stream: Stream, drift: DriftRate | None = None) -> None:
        self.stream, self.monitor = stream, RigMonitor(RigFilter(stream.factory, stream.obj, drift))
        self.pose: RigidTransform | None = None
        self.told: list[tuple[int, Change]] = []  # number of the snapshot in the stream
        self.numbers: list[int] = []  # of the stream, of each snapshot of the filter
        self.last = 0
        self._ahead: Observations | None = None  # snapshots (S,) that are simulated already ...
        self._rigs, self._labels = stream.rig.expand(1), list[int]()  # ... their true rigs, and how many labels
        self._first = self._row = 0

    def step(self, number: int) -> Observations | None:
        """Learn from a snapshot, each being asked for in turn; None = the object is not seen."""
        row = number - self._first
        if self._ahead is None or row >= len(self._ahead.uv):
            self._first, row = number, 0
            self._ahead, self._rigs = self.stream.labelled(number, number + BLOCK)
            self._labels = self._ahead.seen.sum((1, 2)).tolist()
        self._row = row
        if self._labels[row] < 6:
            return None
        observations = Observations(*(x[row : row + 1] for x in vars(self._ahead).values()))
        pose = self.pose
        if pose is None or number - self.last > 3:
            pose = initial_pose(observations, self.monitor.filter.belief.rig, self.stream.obj)
        seconds = (number - self.last) / self.stream.conditions.rate
        try:
            result, changes = self.monitor.update(observations, pose, seconds)
        except RefusedError:
            return None
        self.pose, self.last = result.rig_from_object, number
        self.numbers.append(number)
        self.told += [(number, change) for change in changes]
        return observations

    @property
    def truth(self) -> CameraRig:
        """The rig as it was at the last snapshot that was asked for."""
        return self._rigs[self._row]


def stream_of(seed: int, name: str, drifting: bool = False, bumps: tuple[Bump, ...] = (), **more: Any) -> Stream:
    """A labelled stream of a shipped rig and object."""
    drift = DriftRate() if drifting else DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)
    factory, obj = imgcal.load_rig(name), imgcal.load_object("asymmetric8")
    return Stream(factory, obj, seed, Conditions(drift=drift, labelled=True), bumps, **more)


def without_bumps(item: Item) -> dict[str, Any]:
    """Follow a rig that stands still, or wanders."""
    followed = Followed(stream_of(item.seed, RIGS[item.seed % len(RIGS)], item.name.endswith("drifting")))
    for number in range(LONG):
        followed.step(number)
    return {"snapshots": len(followed.numbers), "alarms": len([c for _, c in followed.told if not c.decided])}


def drawn(seed: int, number: int, size: float = 1.0) -> tuple[str, Bump]:
    """A rig, and a bump of one of its cameras."""
    generator = np.random.default_rng((seed, number))
    name = RIGS[seed % len(RIGS)]
    kind = tuple(GATE)[seed // len(RIGS) % len(GATE)]
    camera = int(generator.integers(imgcal.load_rig(name).num_cameras))
    return name, Bump(BEFORE + int(generator.integers(30)), camera, kind, size * GATE[kind])


def judged(told: list[tuple[int, Change]], numbers: list[int], bumps: tuple[Bump, ...]) -> dict[str, Any]:
    """Compare what was told with what happened."""
    bumped, at = {bump.camera: bump for bump in bumps}, min(bump.snapshot for bump in bumps)
    first = [(number, c) for number, c in told if not c.decided]
    found: dict[int, int] = {}
    for number, change in first:
        if change.camera in bumped and number >= at:
            found.setdefault(change.camera, number)
    kinds = {c.camera: c.kind for _, c in told if c.decided and c.camera in bumped}
    since = {c.camera: numbers[c.since] for _, c in first}
    return {
        "delay": [found[c] - bumped[c].snapshot if c in found else None for c in bumped],
        "wrong": sorted({c.camera for _, c in first} - bumped.keys()),
        "kind": [kinds.get(c) == bumped[c].kind for c in bumped],
        "undecided": [kinds.get(c, "unknown") == "unknown" for c in bumped],
        "late": [None if c not in since else since[c] - bumped[c].snapshot for c in bumped],
    }  # fmt: skip


def bumped(item: Item) -> dict[str, Any]:
    """Follow a rig of which one camera, or two at once, are bumped."""
    size = SWEPT[item.seed % (len(SWEPT) - 1)] if item.name.endswith("sweep") else 1.0
    name, bump = drawn(item.seed, 0, size)
    bumps: tuple[Bump, ...] = (bump,)
    if item.name.endswith("two"):
        other = drawn(item.seed + 4, 1)[1]
        cameras = imgcal.load_rig(name).num_cameras
        camera = other.camera if other.camera != bump.camera else (bump.camera + 1)
        bumps = (bump, Bump(bump.snapshot, camera % cameras, other.kind, other.size))
    absent = [(bump.snapshot - 30, bump.snapshot + 30)] if item.name.endswith("away") else []
    followed = Followed(stream_of(item.seed, name, bumps=bumps, absent=absent))
    for number in range(bump.snapshot + AFTER):
        followed.step(number)
    expected = tuple(Bump(b.snapshot + (30 if absent else 0), b.camera, b.kind, b.size) for b in bumps)
    told = judged(followed.told, followed.numbers, expected)
    return {"rig": name, "kind_of_bump": bump.kind, "size": size, **told}


def held_out(rig: CameraRig, truth: CameraRig, stream: Stream) -> float:
    """RMS residual (px) of exact points in poses that the filter has not seen, the poses being fitted."""
    poses = RigidTransform.cat([stream.pose_at(1000.0 + 0.37 * number) for number in range(30)])
    image = truth.expand(30).project(poses.apply(stream.obj.points), stream.obj.radius)
    exact = Observations(image.uv, torch.full(image.uv.shape[:-1], 0.1, dtype=torch.float64), image.visible)
    held = torch.zeros(rig.num_cameras, 15, dtype=torch.float64)
    fit = estimate(exact, rig, stream.obj, poses, prior_std=held)
    return float(fit.residual[image.visible].square().sum(-1).mean().sqrt())


def half_degree(item: Item) -> dict[str, Any]:
    """Turn a camera by half a degree; compare with a filter that is told."""
    name, bump = drawn(item.seed, 0)
    bump = Bump(bump.snapshot, bump.camera, "rotation", math.radians(0.5))
    stream = stream_of(item.seed, name, bumps=(bump,))
    followed, told = Followed(stream), RigFilter(stream.factory, stream.obj)
    errors, refused, sure, wrong, at_once = {}, 0, 0, 0, 0
    for number in range(bump.snapshot + 241):
        observations = followed.step(number)
        if observations is None or followed.pose is None:
            continue
        if number == bump.snapshot:
            spread = spread_of({bump.camera: bump.kind}, pixel_changes(told.belief.rig))
            told.belief = widened(told.belief, spread.square())
        try:
            told.update(observations, followed.pose, 1 / 60)
        except RefusedError:
            refused += 1
        after = number - bump.snapshot
        if after in (30, 60, 120, 240):
            rigs = (followed.monitor.filter.belief.rig, told.belief.rig)
            errors[str(after)] = [held_out(rig, followed.truth, stream) for rig in rigs]
        if after >= 0 and after % 5 == 0 and bump.camera not in followed.monitor.open:
            far = bool(distance(followed.monitor.filter.belief, followed.truth)[bump.camera] > SURELY)
            if after == 0:
                at_once += int(far)
            else:
                sure, wrong = sure + 1, wrong + int(far)
    return {
        "rig": name,
        "held_out": errors,
        "refused": refused,  # by the filter that was told
        "asked_ok": sure,
        "wrong_ok": wrong,
        "wrong_at_once": at_once,  # at the first snapshot after the bump: two must agree for an alarm
        **judged(followed.told, followed.numbers, (bump,)),
    }


def distance(belief: RigBelief, truth: CameraRig) -> Tensor:
    """Chi-squared (C,) of ten parameters of each camera, laid upon the truth."""
    gauge = Gauge(torch.full((truth.num_cameras,), 1 / truth.num_cameras, dtype=torch.float64))
    error, jacobian = gauge.difference(belief.rig, truth)[:, :10], gauge.jacobian(truth)
    covariance = jacobian @ belief.covariance() @ jacobian.mT
    blocks = covariance.unflatten(0, (-1, 15)).unflatten(-1, (-1, 15)).diagonal(dim1=0, dim2=2).movedim(-1, 0)
    return (error * torch.linalg.solve(blocks[:, :10, :10], error[..., None])[..., 0]).sum(-1)


def creeping(item: Item) -> dict[str, Any]:
    """Turn a camera slowly."""
    stream = stream_of(item.seed, RIGS[item.seed % len(RIGS)])
    followed, camera = Followed(stream), item.seed % 4
    step = torch.zeros(stream.factory.num_cameras, 15, dtype=torch.float64)
    step[camera, :3] = CREEP * torch.nn.functional.normalize(torch.randn(3, generator=stream.generator), dim=0)
    start, stream.creep, worst, wrong = stream.rig, step, 0.0, 0
    for number in range(600, 36600):
        followed.step(number)
        if number % 1200 == 0:
            found = float(distance(followed.monitor.filter.belief, followed.truth)[camera])
            worst, wrong = max(worst, found), wrong + int(found > SURELY)
    moved = Gauge.of_most(followed.monitor.filter.belief.rig, start).difference(
        followed.monitor.filter.belief.rig, start
    )
    return {"rig": stream.factory.name, "alarms": len(followed.told), "asked": 30, "wrong": wrong, "worst_chi2": worst,
            "found_degrees": math.degrees(float(moved[camera, :3].norm()))}  # fmt: skip


def whole_rig(item: Item) -> dict[str, Any]:
    """Carry the rig as a whole: no image shows it against the object's motion."""
    stream = stream_of(item.seed, RIGS[item.seed % len(RIGS)])
    followed = Followed(stream)
    for number in range(BEFORE + AFTER):
        if number == BEFORE:
            stream.middle = stream.middle + torch.tensor([8.0, -5.0, 6.0], dtype=torch.float64)
            turned = rotation_from_vector(torch.tensor([[0.01, -0.02, 0.01]], dtype=torch.float64))
            stream.pose = RigidTransform(turned @ stream.pose.rotation, stream.pose.translation)
        followed.step(number)
    return {"alarms": len(followed.told)}


def kept(item: Item) -> dict[str, Any]:
    """Follow blobs without labels among false ones."""
    bumps: tuple[Bump, ...] = ()
    name, bump = drawn(item.seed, 0)
    count = LONG // 10
    if item.name.endswith("bump"):
        bumps, count = (bump,), bump.snapshot + AFTER
    drift = DriftRate() if item.name.endswith("drifting") else DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)
    stream = Stream(imgcal.load_rig(name), imgcal.load_object("asymmetric8"), item.seed, Conditions(drift=drift), bumps)
    events, refused, sure, wrong = [], 0, 0, 0
    with imgcal.RigKeeper(stream.factory, stream.obj) as keeper:
        for seconds, blobs in stream.snapshots(count):
            state = keeper.update(blobs, seconds)
            refused += state.refused is not None
            events += [e for e in state.events if e.kind == "moved"]
            number = state.snapshot
            after = bool(bumps) and number >= bump.snapshot and number % 5 == 0
            if after and state.cameras[stream.factory.camera_names[bump.camera]] == "ok":
                sure += 1
                wrong += int(distance(state.belief, stream.rig)[bump.camera] > SURELY)
    values: dict[str, Any] = {"rig": name, "snapshots": count, "refused": refused, "asked_ok": sure, "wrong_ok": wrong}
    numbers, names = list(range(count)), stream.factory.camera_names
    told = []
    for event in events:
        since, kind = round((event.since or 0.0) * stream.conditions.rate), event.change or "unknown"
        change = Change(names.index(str(event.camera)), since, kind, 0.0, 0.0, kind != "unknown")
        told.append((event.snapshot, change))
    if not bumps:
        return {**values, "alarms": len(told)}
    return {**values, "kind_of_bump": bump.kind, "size": 1.0, **judged(told, numbers, bumps)}


RUNS = {
    "monitor steady": without_bumps, "monitor drifting": without_bumps, "monitor bump": bumped, "monitor sweep": bumped,
    "monitor two": bumped, "monitor away": bumped, "monitor half degree": half_degree, "monitor creep": creeping,
    "monitor whole rig": whole_rig, "keeper steady": kept, "keeper drifting": kept, "keeper bump": kept,
}  # fmt: skip


def run(item: Item) -> dict[str, Any]:
    """Do one item."""
    torch.set_num_threads(1)
    began = time.process_time()
    found = RUNS[item.name](item)
    return {"key": item.key, "name": item.name, **found, "cpu_s": round(time.process_time() - began, 2)}


def items(share: float, only: tuple[str, ...] = tuple(COUNTS)) -> list[Item]:
    """All of them, or a share; in an order in which all experiments go on together, each at its `PACE`."""
    wanted = {name: max(1, round(share * count)) for name, count in COUNTS.items() if name in only}
    every = [
        (seed / count * PACE.get(name, OTHERS), Item(name, seed))
        for name, count in wanted.items()
        for seed in range(count)
    ]
    return [item for _, item in sorted(every, key=lambda pair: pair[0])]


def done(path: Path) -> list[dict[str, Any]]:
    """What has been done; a line that was cut off is left out."""
    if not path.exists():
        return []
    lines = path.read_text("utf-8").splitlines()
    entries = [json.loads(line) for line in lines if line.endswith("}")]
    return list({entry["key"]: entry for entry in entries}.values())


def go_on(options: Options, mapped: Mapped = map) -> None:
    """Run what is not done yet."""
    path = options.items
    known = {entry["key"] for entry in done(path)}
    left = [item for item in items(options.share, options.only) if item.key not in known]
    path.parent.mkdir(parents=True, exist_ok=True)
    until = time.monotonic() + 60 * options.minutes
    in_time = takewhile(lambda item: time.monotonic() < until, left)
    with path.open("a", encoding="utf-8") as out:
        for found in mapped(run, in_time):
            out.write(json.dumps(found) + "\n")
            out.flush()
            print(found["key"], found["cpu_s"], "s", file=sys.stderr, flush=True)


def summarized(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Count."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for entry in entries:
        groups.setdefault(entry["name"], []).append(entry)
    found: dict[str, Any] = {}
    for name in COUNTS:
        group = groups.get(name, [])
        if not group:
            continue
        values: dict[str, Any] = {"items": len(group), "cpu_s": round(sum(e["cpu_s"] for e in group))}
        for key in ("snapshots", "alarms", "refused", "asked_ok", "wrong_ok", "wrong_at_once", "asked"):
            if key in group[0]:
                values[key] = sum(entry[key] for entry in group)
        if "delay" in group[0]:
            values |= _bumps(group)
        if "held_out" in group[0]:
            pairs = {after: [entry["held_out"][after] for entry in group] for after in group[0]["held_out"]}
            values["held_out_ratio"] = {after: _ratio(pair) for after, pair in pairs.items()}
        if "worst_chi2" in group[0]:
            values |= {"wrong": sum(e["wrong"] for e in group), "found_degrees": [e["found_degrees"] for e in group]}
        if name.endswith("sweep"):
            values["by_size"] = {str(size): _bumps([e for e in group if e["size"] == size]) for size in SWEPT
                                 if any(e["size"] == size for e in group)}  # fmt: skip
        if name.endswith("bump"):
            values["by_rig"] = {rig: _bumps([e for e in group if e["rig"] == rig]) for rig in RIGS
                                if any(e["rig"] == rig for e in group)}  # fmt: skip
            values["by_kind"] = {kind: _bumps([e for e in group if e["kind_of_bump"] == kind]) for kind in GATE
                                 if any(e["kind_of_bump"] == kind for e in group)}  # fmt: skip
        found[name] = values
    return found


def _ratio(pairs: list[list[float]]) -> float:
    """RMS of the first by that of the second."""
    squares = np.square(pairs).sum(0)
    return math.sqrt(squares[0] / squares[1])


def _bumps(group: list[dict[str, Any]]) -> dict[str, Any]:
    delays = [delay for entry in group for delay in entry["delay"]]
    within = [delay for delay in delays if delay is not None and delay < 60]
    late = [late for entry in group for late in entry["late"] if late is not None]
    return {
        "bumps": len(delays),
        "found": len([delay for delay in delays if delay is not None]),
        "within_1_s": len(within),
        "delay_median": float(np.median(within)) if within else None,
        "delay_max": max(within, default=None),
        "others_blamed": sum(bool(entry["wrong"]) for entry in group),
        "right_kind": sum(sum(entry["kind"]) for entry in group),
        "kind_not_told": sum(sum(entry["undecided"]) for entry in group),
        "time_within_3": sum(abs(value) <= 3 for value in late),
    }


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Markdown, by the marker in the page."""
    found: dict[str, Any] = result["found"]
    quiet = [name for name, group in found.items() if "snapshots" in group and "bumps" not in group]
    rows = []
    for name, group in found.items():
        parts = {name: group} | {f"{name}, {size} x": part for size, part in group.get("by_size", {}).items()}
        parts |= {f"{name}, {kind.replace('_', ' ')}": part for kind, part in group.get("by_kind", {}).items()}
        rows += [[label, *_cells(part)] for label, part in parts.items() if "bumps" in part]
    head = [
        "bumps", "number", "found within 1 s", "median delay", "others blamed", "right kind", "kind not told",
        "time within 3 snapshots",
    ]  # fmt: skip
    return {
        "alarms steady": markdown(
            ["no camera bumped", "snapshots", "false alarms"],
            [[name, f"{found[name]['snapshots']:,}", str(found[name]["alarms"])] for name in quiet],
        ),
        "alarms bumps": markdown(head, rows),
    }


def _cells(part: dict[str, Any]) -> list[str]:
    count = part["bumps"]
    shares = [f"{100 * part[key] / count:.1f} %" for key in ("right_kind", "kind_not_told", "time_within_3")]
    median = "-" if part["delay_median"] is None else f"{part['delay_median']:g}"
    return [str(count), f"{100 * part['within_1_s'] / count:.1f} %", median, str(part["others_blamed"]), *shares]


def draw(result: dict[str, Any], path: Path) -> None:
    """Delay against size and against the number of cameras; false alarms against what was run."""
    found = result["found"]
    with figure(path, panels=3, size=(11.0, 3.4)) as (by_size, by_cameras, false):
        sweep = found.get("monitor sweep", {}).get("by_size", {})
        sizes = [0.1 * float(size) for size in sweep]
        shares = [100 * part["within_1_s"] / part["bumps"] for part in sweep.values()]
        delays = [math.nan if part["delay_median"] is None else part["delay_median"] + 1 for part in sweep.values()]
        by_size.loglog(sizes, delays, "o-", color=BLUE)
        by_size.set(xlabel="turn of a camera (degrees), others alike", ylabel="snapshots until the alarm (median)")
        for size, delay, share in zip(sizes, delays, shares, strict=True):
            by_size.annotate(f"{share:.0f} %", (size, delay), textcoords="offset points", xytext=(3, 5), fontsize=8)
        rigs = found.get("monitor bump", {}).get("by_rig", {})
        for rig, part in rigs.items():
            if part["delay_median"] is not None:
                cameras = imgcal.load_rig(rig).num_cameras
                by_cameras.plot([cameras, cameras], [part["delay_median"] + 1, part["delay_max"] + 1], "o-", color=RED)
        by_cameras.set(xlabel="cameras", ylabel="snapshots until the alarm (median, longest)", ylim=(0, None))
        names = [name for name in found if "snapshots" in found[name] and "bumps" not in found[name]]
        false.barh(names, [found[name]["snapshots"] for name in names], color=GREY)
        for row, name in enumerate(names):
            false.annotate(f" {found[name]['alarms']} false", (found[name]["snapshots"], row), va="center", fontsize=8)
        false.axvline(GOAL, color=GREEN, linewidth=1)
        false.set(xscale="log", xlabel="snapshots run; line: eight hours", xlim=(1e3, 1e7))


@dataclass(frozen=True)
class Options:
    """Run what is not done yet, and write what has been found so far."""

    minutes: float = 60.0
    """Begin no item later than this; the next run goes on."""
    address: str | None = None  #: running Ray cluster that does the items; none = this machine
    cores: int | None = 1  #: of this machine; 1 = this process alone; none = all
    share: float = 1.0
    """Of the items of each experiment."""
    only: tuple[str, ...] = tuple(COUNTS)  #: experiments; the others stay as they were
    items: Path = ITEMS  #: a line for each that is done
    out: Path = RESULT  #: the page and the plot are rewritten with this one alone


def main() -> None:
    """Run, count, write, print."""
    options = tyro.cli(Options, description=__doc__)
    with workers(options.address, options.cores) as mapped:
        go_on(options, mapped)
    known = json.loads(RESULT.read_text("utf-8"))["found"] if options.out == RESULT and RESULT.exists() else {}
    anew = summarized([entry for entry in done(options.items) if entry["name"] in options.only])
    result: dict[str, Any] = {
        **surroundings(),
        "noise_px": Conditions().noise,
        "found": {name: (known | anew)[name] for name in COUNTS if name in known | anew},
    }
    write_json(options.out, result)
    written = tables(result)
    if options.out == RESULT:
        draw(result, PLOT)
        fill(PAGE, written)
    print("\n\n".join(written.values()))


if __name__ == "__main__":
    command(main)

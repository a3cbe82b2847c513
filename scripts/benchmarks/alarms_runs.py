"""Experiments on alarms: rigs that stand still, drift or creep, and rigs with bumped cameras."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.estimation import Gauge
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.monitoring import Change, RigFilter, change_std, pixel_changes, widen
from imgcal.types import DriftRate
from scripts.benchmarks.followed_streams import RIGS, SURELY, Followed, distance, held_out, stream_of
from scripts.benchmarks.rig_streams import Bump, Conditions, Stream

GATE = {"rotation": math.radians(0.1), "position": 1.0, "focal_length": 3.0, "principal_point": 1.0}
SWEPT = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Multiples of the sizes in `GATE`; the last is 1."""
BEFORE, AFTER = 300, 300
"""Snapshots before and after a bump, at 60 per second."""
LONG = 6000
"""Snapshots in an item without a bump."""
SHAKE = 0.15
"""Pixels, standard deviation of a shift that all points of an image share and that changes with every snapshot: 1.5
times a blob's noise."""
HARDER = {"shaking": Conditions(shake=SHAKE), "noisy": Conditions(noisy=0.3), "lens": Conditions(lens=0.05)}
"""Conditions that a word in an experiment's name stands for."""
KNOCK = 3.0
"""Multiple of `GATE` by which a camera moves in each step of a knock."""
CREEP = math.radians(0.1) / 36000
"""Rad per snapshot: 0.1 degree in ten minutes."""


@dataclass(frozen=True)
class Item:
    """One work item."""

    name: str
    seed: int

    @property
    def key(self) -> str:
        """Identify the item among the finished ones."""
        return f"{self.name} {self.seed}"


def without_bumps(item: Item) -> dict[str, Any]:
    """Follow a rig that stands still or drifts, or whose cameras shake."""
    shake = SHAKE if item.name.endswith("shaking") else 0.0
    followed = Followed(stream_of(item.seed, RIGS[item.seed % len(RIGS)], item.name.endswith("drifting"), shake=shake))
    for number in range(LONG):
        followed.step(number)
    return {"snapshots": len(followed.numbers), "alarms": len([c for _, c in followed.told if not c.decided])}


def drawn(seed: int, number: int, size: float = 1.0) -> tuple[str, Bump]:
    """Draw a rig, and a bump of one of its cameras."""
    generator = np.random.default_rng((seed, number))
    name = RIGS[seed % len(RIGS)]
    kind = tuple(GATE)[seed // len(RIGS) % len(GATE)]
    camera = int(generator.integers(imgcal.load_rig(name).num_cameras))
    return name, Bump(BEFORE + int(generator.integers(30)), camera, kind, size * GATE[kind])


def judged(told: list[tuple[int, Change]], numbers: list[int], bumps: tuple[Bump, ...]) -> dict[str, Any]:
    """Compare the reported changes with the true bumps."""
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
    """Follow a rig in which one camera, or two at once, are bumped."""
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


def half_degree(item: Item) -> dict[str, Any]:
    """Turn a camera by half a degree; compare with a filter that knows of the bump."""
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
            spread = change_std({bump.camera: bump.kind}, pixel_changes(told.belief.rig))
            told.belief = widen(told.belief, spread.square())
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
        "refused": refused,  # by the filter that knows of the bump
        "asked_ok": sure,
        "wrong_ok": wrong,
        "wrong_at_once": at_once,  # at the first snapshot after the bump; an alarm needs two that agree
        **judged(followed.told, followed.numbers, (bump,)),
    }


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
    moved = Gauge.from_majority(followed.monitor.filter.belief.rig, start).difference(
        followed.monitor.filter.belief.rig, start
    )
    return {"rig": stream.factory.name, "alarms": len(followed.told), "asked": 30, "wrong": wrong, "worst_chi2": worst,
            "found_degrees": math.degrees(float(moved[camera, :3].norm()))}  # fmt: skip


def whole_rig(item: Item) -> dict[str, Any]:
    """Move the whole rig: images cannot distinguish this from a motion of the object."""
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
    """Follow unlabelled blobs among false ones."""
    bumps: tuple[Bump, ...] = ()
    name, bump = drawn(item.seed, 0)
    count = LONG // 10
    if item.name.endswith("bump"):
        bumps, count = (bump,), bump.snapshot + AFTER
    steps = bumps
    if "knock" in item.name:  # lasts two to nine snapshots, one step each
        bump = replace(bump, size=KNOCK * bump.size)
        bumps, steps = (bump,), tuple(replace(bump, snapshot=bump.snapshot + n) for n in range(2 + item.seed % 8))
    drift = DriftRate() if item.name.endswith("drifting") else DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)
    conditions = replace(
        next((given for word, given in HARDER.items() if word in item.name), Conditions()), drift=drift
    )
    stream = Stream(imgcal.load_rig(name), imgcal.load_object("asymmetric8"), item.seed, conditions, steps)
    events, refused, sure, wrong = [], 0, 0, 0
    with imgcal.RigKeeper(stream.factory, stream.obj) as keeper:
        for seconds, blobs in stream.snapshots(count):
            state = keeper.update(blobs, seconds)
            refused += state.refused is not None
            events += [e for e in state.events if e.kind == "moved"]
            number = state.snapshot
            after = bool(bumps) and number >= steps[-1].snapshot and number % 5 == 0
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
    "monitor shaking": without_bumps, "keeper shaking": kept, "keeper shaking bump": kept, "keeper knock bump": kept,
    "keeper noisy": kept, "keeper lens": kept,
}  # fmt: skip


def run(item: Item) -> dict[str, Any]:
    """Run one item."""
    torch.set_num_threads(1)
    began = time.process_time()
    found = RUNS[item.name](item)
    return {"key": item.key, "name": item.name, **found, "cpu_s": round(time.process_time() - began, 2)}

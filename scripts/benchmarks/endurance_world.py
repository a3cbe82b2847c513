"""`World`: views and faults of the cameras at every moment of a day of endurance; and a source that replays it."""

from __future__ import annotations

import copy
import math
import mmap
import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from imgcal.io import load_object, read_rig
from imgcal.types import CameraRig
from imgcal.watch import CameraBlobs, Exposure, Item, Unreadable
from scripts.benchmarks.rig_streams import Bump, Conditions, Stream

EPOCH = 1.7e9  # s
SLOWED = 60.0  # the object moves between snapshots as if there were 60 per second
NOISE = 0.1  # px
LATE, TWICE, GARBAGE, WRONG_TIME = 0.01, 0.005, 0.005, 0.002  # shares of exposures
BUMP_DEG = 0.3
TELLING = 120  # snapshots within which a bump must be reported
SEEN = 60  # views of the object by a bumped camera before it must be known


@dataclass(frozen=True)
class Stretch:
    """An interval of snapshots."""

    first: int
    last: int  # excluded

    def holds(self, number: int) -> bool:
        return self.first <= number < self.last


class World:
    """Views of the cameras at any moment, reproducible after every restart."""

    def __init__(self, snapshots: int, rate: float, bumps: int, seed: int = 0) -> None:
        self.rate, self.snapshots = rate, snapshots
        self.factory, self.obj = read_rig("T4"), load_object("asymmetric8")
        draw = random.Random(seed)
        steps = [
            Bump(int((i + 0.5) * snapshots / bumps), draw.randrange(self.factory.num_cameras), "rotation",
                 math.radians(BUMP_DEG))
            for i in range(bumps)
        ]  # fmt: skip
        self.stream = Stream(self.factory, self.obj, seed, Conditions(noise=NOISE), steps)
        self.bumps = self.all_bumps = steps
        self._rigs = [self.stream.rig]
        for bump in steps:
            self.stream.rig = self.stream.changed(bump)
            self._rigs.append(self.stream.rig)
        self.absent = _stretches(draw, snapshots, 120 * rate, 120 * rate)
        self.out = [_stretches(draw, snapshots, 1200 * rate, 60 * rate) for _ in self.factory.camera_names]

    def until(self, snapshots: int) -> World:
        """Shorten the world; bumps so close to its end that they could not be reported are dropped."""
        shorter = copy.copy(self)
        shorter.snapshots = snapshots
        told_by = snapshots - TELLING if snapshots < self.snapshots else snapshots
        shorter.bumps = [bump for bump in self.bumps if bump.snapshot < told_by]
        return shorter

    def rig(self, number: int) -> CameraRig:
        return self._rigs[sum(bump.snapshot <= number for bump in self.all_bumps)]

    def has_shown(self, number: int, camera: int) -> bool:
        """Tell whether a camera has seen enough since its last bump to reveal it."""
        last = max((b.snapshot for b in self.all_bumps if b.camera == camera and b.snapshot <= number), default=None)
        if last is None:
            return True
        out = self.out[camera]
        return sum(not self.is_absent(n) and not any(s.holds(n) for s in out) for n in range(last, number)) >= SEEN

    def is_absent(self, number: int) -> bool:
        return any(stretch.holds(number) for stretch in self.absent)

    def exposures(self, number: int) -> list[tuple[int, Item]]:
        """Items sent for a snapshot, each with the snapshot with which it arrives."""
        noise, rig = np.random.default_rng([7, number]), self.rig(number)
        pose = self.stream.pose_at(number / self.rate / SLOWED)
        image = rig.expand(1).project_values(pose.apply(self.obj.points), self.obj.radius)
        uv = image.uv[0].numpy() + NOISE * noise.standard_normal(image.uv[0].shape)
        seen = image.visible[0].numpy() & (noise.random(image.visible[0].shape) > 0.1) & (not self.is_absent(number))
        sent: list[tuple[int, Item]] = []
        for camera, name in enumerate(rig.camera_names):
            if any(stretch.holds(number) for stretch in self.out[camera]):
                continue
            false = noise.random((noise.poisson(0.5), 2)) * (rig.image_size[camera].numpy() - 1)
            size = rig.image_size[camera].numpy() - 1
            places = np.clip(noise.permutation(np.concatenate((uv[camera][seen[camera]], false))), 0, size)
            time = EPOCH + number / self.rate + noise.uniform(-0.001, 0.001)
            luck = noise.random(4)
            if luck[0] < GARBAGE:
                sent.append((number, _garbage(noise, name, time)))
                continue
            if luck[1] < WRONG_TIME:
                time += float(noise.choice((-1e6, -30.0, -3.0, 3.0, 30.0, 1e6)))
            exposure = Exposure(name, time, CameraBlobs.of(places, NOISE))
            sent.append((number + int(noise.integers(1, 4)) * int(luck[2] < LATE), exposure))
            if luck[3] < TWICE:
                sent.append((number, exposure))
        return sent


def _stretches(draw: random.Random, snapshots: int, between: float, length: float) -> list[Stretch]:
    """Draw intervals of random length, with random pauses."""
    found, at = [], draw.expovariate(1 / between)
    while at < snapshots:
        last = at + max(draw.expovariate(1 / length), 1)
        found.append(Stretch(int(at), int(last)))
        at = last + draw.expovariate(1 / between)
    return found


def _garbage(noise: np.random.Generator, name: str, time: float) -> Item:
    """Make an item that is not an exposure of this rig, or one that shows only noise."""
    kind = int(noise.integers(5))
    if kind == 0:
        return Unreadable("junk", name)
    if kind == 1:
        return Exposure("cam99", time, CameraBlobs.of([]))
    if kind == 2:
        return Exposure(name, float("nan"), CameraBlobs.of([]))
    if kind == 3:
        return Exposure(name, time, CameraBlobs.of([[1e5, 1e5]]))
    return Exposure(name, time, CameraBlobs.of(noise.random((int(noise.integers(1, 200)), 2)) * 1000, NOISE))


class Replay:
    """The world as a source, from a snapshot on; records its progress where it survives a killed process."""

    live = False

    def __init__(self, world: World, first: int, last: int, place: mmap.mmap) -> None:
        self._world, self._first, self._last, self._place = world, first, last, place

    def items(self) -> Iterator[Item]:
        held: list[tuple[int, Item]] = []
        for number in range(self._first, self._last):
            sent = self._world.exposures(number)
            held = [*held, *sent]
            for due, item in held:
                if due <= number:
                    yield item
            held = [(due, item) for due, item in held if due > number]
            self._place[:8] = struct.pack("q", number + 1)

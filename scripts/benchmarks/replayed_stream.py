"""A simulated rig with the noise of real cameras: a hand-carried wand, people in the way, blobs that merge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.synthesis import HandHeld, PhysicalDrift, arrange_rig, sample_path
from imgcal.types import CalibrationObject, CameraRig, ConvexVolume, Detections
from scripts.benchmarks.replayed_noise import Replay, Series, recorded_series
from scripts.benchmarks.rig_streams import Blobs, Bump, Conditions, Stream
from scripts.benchmarks.wand_recording import calibrated, recording

AHEAD = 600
"""Snapshots per simulated block."""
PLACES = ("ring8", "room10", "wand10")
REPLAYED = Conditions(hidden=0.01, clutter=0.02, radius=math.nan, labelled=False)
"""Disturbances besides replayed noise; blobs have a sigma of 0.1 px, as in the recording."""
TEACHING, TEACH_EVERY = 1600, 8
"""Snapshots before the keeper starts, and the step between those that are calibrated."""


@dataclass(frozen=True)
class Disturbances:
    """Disturbances in a room besides noise."""

    merged: float = 5.0  # px between centres below which two markers are one blob, at their middle
    wrong: float = 0.002  # share of images in which one blob is displaced from its marker ...
    wrong_by: tuple[float, float] = (3.0, 30.0)  # px ... by this distance
    people_every: float = 10.0  # s, mean time between people in front of a camera ...
    people_for: tuple[float, float] = (0.5, 6.0)  # s ... and their stay
    whole: float = 0.5  # share of people who hide the whole image; others hide one side of a line
    away_every: float = 60.0  # s, mean time between absences of the object ...
    away_for: tuple[float, float] = (2.0, 10.0)  # s
    off: tuple[float, float] = (0.2, 0.6)  # mm, error of each marker's position in the object's file
    speed: float = 2500.0  # mm/s: about 9 px per frame, as in the recording
    turning: float = 150.0  # degrees/s


@dataclass(frozen=True)
class Place:
    """A rig, the volume in which a wand is carried, and the prior knowledge of both."""

    factory: CameraRig
    truth: CameraRig
    obj: CalibrationObject  # nominal
    volume: ConvexVolume


def place_of(name: str, seed: int) -> Place:
    """Make one of `PLACES`, with the recorded wand: a ring of eight, a room of ten, or the calibrated recorded rig.

    Each seed perturbs the first two differently.
    """
    wand = recording().obj
    if name == "wand10":
        calibration = calibrated().calibration
        where = calibration.rig_from_object.apply(calibration.points_object.mean(0, keepdim=True))[:, 0]
        ends = torch.tensor([0.05, 0.95], dtype=torch.float64)
        low, high = (tuple(row) for row in torch.quantile(where.detach(), ends, dim=0).tolist())
        return Place(recording().factory, calibration.rig, wand, ConvexVolume.box(low, high))
    factory = (
        arrange_rig("ring", 8, 4000.0, height=2500.0, target=(0.0, 0.0, 1000.0))
        if name == "ring8"
        else imgcal.load_rig(name)
    )
    assert factory.volume is not None
    truth = PhysicalDrift().apply(factory, torch.Generator().manual_seed(seed))
    return Place(factory, truth, wand, factory.volume)


@dataclass
class ReplayedStream(Stream):
    """Snapshots of a place; request them in order."""

    place: Place | None = None
    sources: Sequence[Series] = ()  # sources of noise; empty = the recorded ones
    length: int = 6000  # largest number of snapshots
    given: Disturbances = Disturbances()
    _first: int = field(default=0, init=False)
    _ahead: int = field(default=0, init=False)  # first snapshot that is not simulated yet
    _rigs_ahead: CameraRig = field(init=False, repr=False)  # (S,) true rigs of the simulated snapshots since `_first`

    def __post_init__(self) -> None:
        assert self.place is not None
        self.generator = torch.Generator().manual_seed(self.seed)
        self.noise = np.random.default_rng(self.seed)
        self.rig = self.place.truth
        count, cameras = self.obj.num_fiducials, self.rig.num_cameras
        way = torch.nn.functional.normalize(
            torch.randn(count, 3, generator=self.generator, dtype=torch.float64), dim=-1
        )
        near, far = self.given.off
        reach = near + (far - near) * torch.rand(count, 1, generator=self.generator, dtype=torch.float64)
        self.points = self.obj.points + reach * way
        hand = HandHeld(speed=self.given.speed, turning=self.given.turning, rate=self.conditions.rate)
        centres, _ = sample_path(hand, self.place.volume, self.length, self.generator)
        middle = self.points.mean(0)
        self.path = RigidTransform(centres.rotation, centres.translation - centres.rotation @ middle)
        every = self.sources or recorded_series()
        order = [self.noise.permutation(len(every)) for _ in range(-(-cameras // len(every)))]
        chosen = np.concatenate(order)[:cameras]
        self.replay = Replay([every[k] for k in chosen], count, np.random.default_rng((self.seed, 2)))
        self.away = self._intervals(self.given.away_every, self.given.away_for)
        self.people = [self._intervals(self.given.people_every, self.given.people_for) for _ in range(cameras)]

    def poses_at(self, seconds: Tensor) -> RigidTransform:
        """Poses of the object at times (S,), from the nearest snapshots."""
        return self.path[(seconds * self.conditions.rate).round().long()]

    def _intervals(self, every: float, lasting: tuple[float, float]) -> NDArray[np.float64]:
        """Draw intervals of a disturbance: (M, 5) first and last snapshot, and three random numbers from 0 to 1."""
        found, at = [], 0.0
        while math.isfinite(every) and (at := at + self.noise.exponential(every)) < self.length / self.conditions.rate:
            end = at + self.noise.uniform(*lasting)
            found.append([at * self.conditions.rate, end * self.conditions.rate, *self.noise.random(3)])
            at = end
        return np.array(found).reshape(-1, 5)

    def _blobs(self, number: int) -> Blobs:
        if number >= self._ahead or number < self._first:
            self._simulate(number)
        row = number - self._first
        self.rig = self._rigs_ahead[row]
        cameras, fiducials = np.nonzero(self._seen[row])
        spots = self._uv[row]
        if not self._close[row].any():
            return cameras, spots[cameras, fiducials], fiducials
        parts = [self._merged(camera, row) for camera in np.unique(cameras)]
        camera = np.repeat(np.unique(cameras), [len(labels) for _, labels in parts])
        return camera, np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    def _merged(self, camera: int, row: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Blobs (M, 2) of a camera, with close markers merged, and a label for each."""
        uv, left = self._uv[row, camera], list(np.flatnonzero(self._seen[row, camera]))
        spots, labels = [], []
        while left:
            group = [left.pop(0)]
            for member in group:
                near = [k for k in left if np.linalg.norm(uv[k] - uv[member]) < self.given.merged]
                group += near
                left = [k for k in left if k not in near]
            spots.append(uv[group].mean(0))
            labels.append(group[0])
        return np.array(spots), np.array(labels, dtype=np.int64)

    def _simulate(self, first: int) -> None:
        """Simulate the views from a snapshot on."""
        last = min(first + AHEAD, self.length)
        count, given, noise = last - first, self.given, self.noise
        if self._ahead:
            self.rig = self._rigs_ahead[-1]
        rigs = super()._rigs(first, last)
        image = rigs.project_values(self.path[first:last].apply(self.points), self.obj.radius)
        uv, seen = image.uv.numpy(), image.visible.numpy()
        seen = seen & (noise.random(seen.shape) >= self.conditions.hidden)
        for camera in range(rigs.num_cameras):
            for person in self.people[camera]:
                self._hide(person, camera, first, uv, seen)
        for begin, end, *_ in self.away:
            seen[max(int(begin) - first, 0) : max(int(end) - first, 0)] = False
        uv = uv + self.replay.draw(count)
        astray = noise.random((count, rigs.num_cameras)) < given.wrong
        for row, camera in zip(*np.nonzero(astray), strict=True):
            angle = noise.uniform(0, 2 * math.pi)
            marker = noise.integers(uv.shape[2])
            uv[row, camera, marker] += noise.uniform(*given.wrong_by) * np.array([math.cos(angle), math.sin(angle)])
        apart = np.linalg.norm(uv[:, :, :, None] - uv[:, :, None], axis=-1)
        both = seen[..., None] & seen[..., None, :] & ~np.eye(uv.shape[2], dtype=bool)
        self._close = ((apart < given.merged) & both).any((2, 3))
        size = rigs.image_size.numpy()[:, None]
        self._seen = seen & ((uv > 0) & (uv < size - 1)).all(-1)
        self._uv, self._rigs_ahead, self._first, self._ahead = uv, rigs, first, last

    def _hide(
        self,
        person: NDArray[np.float64],
        camera: int,
        first: int,
        uv: NDArray[np.float64],
        seen: NDArray[np.bool_],
    ) -> None:
        """Hide fiducials behind a person: in the whole image, or on one side of a fixed vertical line."""
        begin, end = max(int(person[0]) - first, 0), max(int(person[1]) - first, 0)
        whole, edge, side = person[2:]
        if whole < self.given.whole:
            seen[begin:end, camera] = False
            return
        line = edge * float(self.rig.image_size[camera, 0])
        right = uv[begin:end, camera, :, 0] > line
        seen[begin:end, camera] &= right if side < 0.5 else ~right

    def _advance(self, number: int) -> None:
        """Do nothing: `_simulate` moves the rig."""


def calibrated_stream(
    name: str, seed: int, count: int, bumps: Sequence[Bump] = (), given: Disturbances = Disturbances()
) -> tuple[ReplayedStream, imgcal.Calibration]:
    """Make a stream whose first `TEACHING` snapshots have been calibrated from labels; `count` more will follow.

    Raises:
        RefusedError: these snapshots cannot be calibrated.
    """
    place = place_of(name, seed)
    conditions = replace(REPLAYED, labelled=True)
    stream = ReplayedStream(
        place.factory, place.obj, seed, conditions, bumps, place=place, length=TEACHING + count, given=given
    )
    parts = [stream.snapshot(number) for number in range(TEACHING) if number % TEACH_EVERY == 0]
    parts = [part for part in parts if (part.fiducial >= 0).sum() >= 8]
    calibration = imgcal.calibrate(Detections.join(parts), place.factory, place.obj)
    stream.conditions = REPLAYED
    return stream, calibration

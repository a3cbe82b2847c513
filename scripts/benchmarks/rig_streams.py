"""A simulated rig that watches a moving object: blobs, snapshot by snapshot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import imgcal
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.monitoring import CHANGES
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CameraRig, Detections, DriftRate, Observations

Blobs = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]


@dataclass(frozen=True)
class Conditions:
    """Visibility and noise of the object, and errors of the rig."""

    noise: float = 0.1  # px
    shake: float = 0.0  # px, sigma of a shift that all points of an image share
    noisy: float = 0.0  # px, noise of the second camera in addition to its blobs' sigma
    lens: float = 0.0  # px RMS per axis, unmodelled lens errors with wavelengths of 300 to 900 px
    hidden: float = 0.1  # share of hidden fiducials
    clutter: float = 0.5  # false blobs per camera and snapshot
    radius: float = 5.0  # px, of each blob; nan = unknown
    rate: float = 60.0  # snapshots/s
    drift: DriftRate = DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)
    reach: tuple[float, float, float] = (90.0, 60.0, 60.0)  # mm, amplitude of the object's motion
    labelled: bool = False


@dataclass(frozen=True)
class Bump:
    """A change of a camera before a snapshot."""

    snapshot: int
    camera: int
    kind: str  # of `CHANGES`
    size: float  # rad, mm, px


@dataclass(frozen=True)
class Slip:
    """A camera exposes later than the others from a snapshot on."""

    snapshot: int
    camera: int
    seconds: float


@dataclass
class Stream:
    """Snapshots of a rig; iterate over it once."""

    factory: CameraRig
    obj: imgcal.CalibrationObject
    seed: int
    conditions: Conditions = Conditions()
    bumps: Sequence[Bump] = ()
    absent: Sequence[tuple[int, int]] = ()  # snapshots (first, last excluded) without the object
    out: Mapping[int, tuple[int, int]] = field(default_factory=dict)  # camera -> snapshots without frames
    creep: Tensor | None = None  # (C, K) change of the cameras per snapshot of `labelled`
    slips: Sequence[Slip] = ()

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)
        truth = simulate_truth(self.factory, self.obj, 1, self.generator, PhysicalDrift())
        self.rig = truth.rig
        self.noise = np.random.default_rng(self.seed)
        self.pose = truth.rig_from_object[:1]
        self.middle = self.pose.translation[0]
        phases = torch.rand(6, 2, generator=self.generator, dtype=torch.float64)
        self.frequency, self.phase = 0.1 + 0.4 * phases[:, 0], 2 * math.pi * phases[:, 1]

    def pose_at(self, seconds: float) -> RigidTransform:
        """Pose (1,) of the object."""
        return self.poses_at(torch.tensor([seconds], dtype=torch.float64))

    def poses_at(self, seconds: Tensor) -> RigidTransform:
        """Poses of the object at times (S,)."""
        wave = torch.sin(2 * math.pi * self.frequency * seconds[:, None] + self.phase)
        turn = rotation_from_vector(0.6 * wave[:, :3])
        shift = wave[:, 3:] * torch.tensor(self.conditions.reach, dtype=torch.float64)
        return RigidTransform(turn @ self.pose.rotation, self.middle + shift)

    def changed(self, bump: Bump) -> CameraRig:
        part, step = CHANGES[bump.kind], torch.zeros(self.rig.num_cameras, 15, dtype=torch.float64)
        direction = torch.randn(part.stop - part.start, generator=self.generator, dtype=torch.float64)
        step[bump.camera, part] = bump.size * direction / direction.norm()
        return self.rig.retract(step)

    def snapshot(self, number: int) -> Detections:
        """Simulate the blobs of a snapshot; `self.rig` and `self.pose` then hold its ground truth."""
        given, noise = self.conditions, self.noise
        self._advance(number)
        cameras, spots, fiducials = self._blobs(number)
        false = noise.poisson(given.clutter, self.rig.num_cameras)
        where = np.repeat(np.arange(self.rig.num_cameras), false)
        wrong = noise.random((len(where), 2)) * self.rig.image_size.numpy()[where]
        camera = np.concatenate((cameras, where))
        labels = np.concatenate((fiducials if given.labelled else np.full(len(cameras), -1), np.full(len(where), -1)))
        rows = noise.permutation(len(camera))
        rows = rows[[not self._is_out(int(camera[r]), number) for r in rows]]
        return Detections(
            uv=np.concatenate((spots, wrong))[rows],
            sigma=np.full(len(rows), given.noise),
            camera=camera[rows].astype(np.int64),
            snapshot=np.zeros(len(rows), dtype=np.int64),
            fiducial=labels[rows].astype(np.int64),
            radius=np.full(len(rows), given.radius),
            flags=np.zeros(len(rows), dtype=np.uint8),
            camera_names=self.rig.camera_names,
            snapshot_names=(str(number),),
        )

    def _advance(self, number: int) -> None:
        """Let the rig drift, and apply the bumps before a snapshot."""
        if number:
            walk = self.conditions.drift.std(self.rig) * math.sqrt(1 / self.conditions.rate / 3600)
            if walk.any():
                self.rig = self.rig.retract(walk * torch.from_numpy(self.noise.standard_normal(walk.shape)))
        for bump in self.bumps:
            if bump.snapshot == number:
                self.rig = self.changed(bump)

    def _blobs(self, number: int) -> Blobs:
        """Simulate blobs of fiducials in a snapshot: cameras (M,), pixels (M, 2), fiducials (M,)."""
        given, noise = self.conditions, self.noise
        uv, visible = self._images(torch.tensor([number]), self.rig.expand(1))
        uv, seen = uv[0], visible[0]
        uv = uv + given.noise * noise.standard_normal(uv.shape) + self._shaken(uv[:, :1])
        if given.noisy:
            uv[1] += given.noisy * noise.standard_normal(uv[1].shape)
        uv = uv + self._bent(uv)
        seen = seen & (noise.random(seen.shape) >= given.hidden)
        if any(first <= number < last for first, last in self.absent):
            seen[:] = False
        cameras, fiducials = np.nonzero(seen)
        return cameras, uv[cameras, fiducials], fiducials

    def labelled(self, first: int, last: int) -> tuple[Observations, CameraRig]:
        """Simulate fiducials (S, C, N) of many snapshots at once, without false blobs, and the true rigs (S,).

        Many times faster than one after another; the noise differs from that of `snapshot`.
        """
        given, noise, count = self.conditions, self.noise, last - first
        rigs = self._rigs(first, last)
        uv, visible = self._images(torch.arange(first, last), rigs)
        uv = uv + given.noise * noise.standard_normal(uv.shape) + self._shaken(uv[:, :, :1])
        seen = visible & (noise.random(uv.shape[:-1]) >= given.hidden)
        for begin, end in self.absent:
            seen[max(begin - first, 0) : max(end - first, 0)] = False
        for camera, (begin, end) in self.out.items():
            seen[max(begin - first, 0) : max(end - first, 0), camera] = False
        sigma = torch.full((count, *uv.shape[1:-1]), given.noise, dtype=torch.float64)
        return Observations(torch.from_numpy(uv), sigma, torch.from_numpy(seen)), rigs

    def _images(self, numbers: Tensor, rigs: CameraRig) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Project the fiducials (S, C, N, 2) with rigs (S,), each camera at the time of its own clock."""
        seconds = numbers.double() / self.conditions.rate
        image = rigs.project_values(self.poses_at(seconds).apply(self.obj.points), self.obj.radius)
        uv, visible = image.uv.numpy(), image.visible.numpy()
        for slip in self.slips:
            rows = (numbers >= slip.snapshot).numpy()
            late = rigs.project_values(self.poses_at(seconds + slip.seconds).apply(self.obj.points), self.obj.radius)
            uv[rows, slip.camera] = late.uv.numpy()[rows, slip.camera]
            visible[rows, slip.camera] = late.visible.numpy()[rows, slip.camera]
        return uv, visible

    def _rigs(self, first: int, last: int) -> CameraRig:
        """True rigs (S,) of some snapshots; sets `self.rig` to the last one."""
        steps = self.conditions.drift.std(self.rig) * math.sqrt(1 / self.conditions.rate / 3600)
        walk = steps * torch.from_numpy(self.noise.standard_normal((last - first, *steps.shape)))
        walk = walk + (0.0 if self.creep is None else self.creep)
        if first == 0:
            walk[0] = 0.0
        bumps = {bump.snapshot: bump for bump in self.bumps if first <= bump.snapshot < last}
        parts, begin = [], first
        for end in (*sorted(bumps), last):
            if begin < end:
                parts.append(self.rig.expand(end - begin).retract(walk[begin - first : end - first].cumsum(0)))
                self.rig, begin = parts[-1][-1], end
            for bump in self.bumps:
                if bump.snapshot == end < last:
                    self.rig = self.changed(bump)
        return CameraRig.cat(parts)

    def _shaken(self, uv: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """Random shifts of each image, in the shape of one fiducial per camera."""
        size = self.conditions.shake
        return size * self.noise.standard_normal(uv.shape) if size else 0.0

    def _bent(self, uv: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """Unmodelled lens errors at pixels (C, N, 2): waves over the image, two for each axis."""
        if not self.conditions.lens:
            return 0.0
        draw = np.random.default_rng((self.seed, 1))
        length, phase = draw.uniform(300, 900, (len(uv), 1, 2, 2)), draw.uniform(0, 2 * np.pi, (len(uv), 1, 2, 2))
        waves: NDArray[np.float64] = np.sin(2 * np.pi * uv[..., None, :] / length + phase)
        return self.conditions.lens * waves.sum(-1)

    def _is_out(self, camera: int, number: int) -> bool:
        first, last = self.out.get(camera, (0, 0))
        return first <= number < last

    def snapshots(self, count: int) -> Iterator[tuple[float, Detections]]:
        """Yield times (s) and blobs."""
        for number in range(count):
            yield number / self.conditions.rate, self.snapshot(number)

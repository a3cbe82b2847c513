"""A simulated running rig: an object carried through its volume, and faults of cameras on demand."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.synthesis.captures import FrameModel, Frames, Truth, simulate_frames
from imgcal.types import BlobFlag, CalibrationObject, CameraRig, Detections

NOISE = 0.07  # px, of a blob's centre
HIDDEN = 0.02  # share of fiducials that a camera misses
FALSE = 0.03  # blobs of nothing in an image
PERIODS = (23.0, 17.0, 29.0)  # s, of the object's way along the sides of the volume
TURNS = ((0.7, 19.0), (0.6, 31.0), (0.9, 27.0))  # rad and s, about each axis
WAY = 0.85
"""Of the room that the object has: how far it is carried."""
WARM, WARMING_SECONDS = 8e-4, 90.0
"""Relative growth of a lens's focal length, and how long until two thirds of it."""
DARK = 6.0  # grey value of a covered camera


class SimulatedRig:
    """A simulated rig and its true values at any moment.

    Examples:
        >>> import imgcal
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> low, high = torch.tensor([[-150.0, -80.0, 780.0], [150.0, 80.0, 920.0]], dtype=torch.float64)
        >>> running = SimulatedRig(rig, obj, low, high, seed=1)
        >>> len(running.snapshot(0.0)) > 20
        True
        >>> running.covered.add(2)
        >>> bool((running.snapshot(0.1).camera == 2).any())
        False
    """

    def __init__(self, rig: CameraRig, obj: CalibrationObject, low: Tensor, high: Tensor, seed: int = 0) -> None:
        """Begin.

        Args:
            rig: without batch axes, as it is in truth.
            obj: the calibration object.
            low: (3,) mm, lower corner of the box through which it is carried.
            high: (3,) mm, upper corner.
            seed: of all that is random.
        """
        self.obj, self.away, self.warm = obj, False, False
        self.covered: set[int] = set()
        self._base, self._random = rig.to(torch.float64), np.random.default_rng(seed)
        self._generator = torch.Generator().manual_seed(seed)
        self._middle, self._centroid = (low + high).double() / 2, obj.points.double().mean(0)
        reach = float((obj.points.double() - self._centroid).norm(dim=-1).max())
        self._way = WAY * ((high - low).double() / 2 - reach).clamp_min(0.0)
        self._share = torch.from_numpy(self._random.uniform(0.7, 1.3, (rig.num_cameras, 1)))
        self._warmth, self._at = 0.0, 0.0

    @property
    def rig(self) -> CameraRig:
        """The true rig of the last snapshot."""
        return replace(self._base, focal_length=self._base.focal_length * (1 + WARM * self._warmth * self._share))

    def bump(self, camera: int, turn_deg: float = 0.3, way_mm: float = 0.0) -> None:
        """Turn and shift a camera, about a random axis and in a random direction."""
        step = torch.zeros(self._base.num_cameras, self._base.num_parameters, dtype=torch.float64)
        axis, way = torch.randn(2, 3, generator=self._generator, dtype=torch.float64)
        step[camera, :3] = axis / axis.norm() * math.radians(turn_deg)
        step[camera, 3:6] = way / way.norm() * way_mm
        self._base = self._base.retract(step)

    def pose(self, seconds: float) -> RigidTransform:
        """Where the object is after some seconds: rig_from_object (), mm."""
        sway = [math.sin(2 * math.pi * seconds / period + k) for k, period in enumerate(PERIODS)]
        turn = [most * math.sin(2 * math.pi * seconds / period + 2 * k) for k, (most, period) in enumerate(TURNS)]
        rotation = rotation_from_vector(torch.tensor(turn, dtype=torch.float64))
        place = self._middle + self._way * torch.tensor(sway, dtype=torch.float64)
        return RigidTransform(rotation, place - rotation @ self._centroid)

    def snapshot(self, seconds: float) -> Detections:
        """What the cameras see: blobs without labels, in any order.

        Args:
            seconds: since the beginning; lenses warm up and cool down between two calls.
        """
        passed, self._at = max(seconds - self._at, 0.0), seconds
        self._warmth += (float(self.warm) - self._warmth) * (1 - math.exp(-passed / WARMING_SECONDS))
        points = self.pose(seconds).apply(self.obj.points.double())
        hidden = 1.0 if self.away else HIDDEN
        blobs, _ = simulate_blobs(self.rig, points, self.obj.radius, self._random, NOISE, hidden, FALSE)
        return blobs.select(~np.isin(blobs.camera, list(self.covered)))

    def frames(self, width: int) -> Frames:
        """Render the frames of the last snapshot, small: camera name -> (H, W)."""
        size = self._base.image_size.double()
        small = self.rig.resized((size * width / size[:, :1]).round().long())
        pose = self.pose(self._at)
        pose = RigidTransform(pose.rotation[None], pose.translation[None])
        uv = small.expand(1).project(pose.apply(self.obj.points.double()[None]), self.obj.radius).uv
        (frames,) = simulate_frames(Truth(small, pose, uv), self.obj, FrameModel(), self._generator)
        for camera, name in enumerate(small.camera_names):
            if self.away or camera in self.covered:
                frames[name] = self._darken(frames[name])
        return frames

    def _darken(self, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> NDArray[np.uint8]:
        return self._random.normal(DARK, 2.0, frame.shape).clip(0, 255).astype(np.uint8)


def simulate_blobs(
    rig: CameraRig,
    points: Tensor,
    radius: Tensor | None,
    random: np.random.Generator,
    noise: float = NOISE,
    hidden: float = 0.0,
    false: float = 0.0,
    blind: Collection[int] = (),
) -> tuple[Detections, NDArray[np.int64]]:
    """Simulate what cameras see in one snapshot: blobs without labels, in any order.

    Args:
        rig: without batch axes.
        points: (N, 3) mm, fiducials in the rig's frame.
        radius: (N,) mm, of the markers, or none.
        random: source of randomness.
        noise: px, of a blob's centre.
        hidden: share of fiducials that a camera misses.
        false: blobs of nothing in an image.
        blind: cameras that see nothing of the object.

    Returns:
        The blobs, and the fiducial of each; -1 = none.

    Examples:
        >>> import imgcal
        >>> rig, point = imgcal.load_rig("T4"), torch.tensor([[0.0, 0.0, 850.0]], dtype=torch.float64)
        >>> blobs, fiducials = simulate_blobs(rig, point, None, np.random.default_rng(0), blind=(2,))
        >>> sorted(blobs.camera.tolist()), fiducials.tolist()
        ([0, 1, 3], [0, 0, 0])
    """
    seen = rig.project(points, radius)
    shown = seen.visible.numpy().copy()
    shown[list(blind)] = False
    if hidden:
        shown &= random.random(shown.shape) > hidden
    camera, fiducial = np.nonzero(shown)
    uv = seen.uv.numpy()[camera, fiducial] + noise * random.standard_normal((len(camera), 2))
    nothing = np.repeat(np.arange(rig.num_cameras), random.poisson(false, rig.num_cameras))
    size = rig.image_size.double().numpy()
    uv = np.concatenate((uv, random.random((len(nothing), 2)) * (size[nothing] - 1)))
    camera, fiducial = np.concatenate((camera, nothing)), np.concatenate((fiducial, np.full(len(nothing), -1)))
    order = random.permutation(len(camera))
    camera, uv = camera[order], np.clip(uv, 0, size[camera] - 1)[order]
    blobs = Detections(
        uv=uv,
        sigma=np.full(len(order), noise),
        camera=camera,
        snapshot=np.zeros(len(order), dtype=np.int64),
        fiducial=np.full(len(order), -1, dtype=np.int64),
        radius=np.full(len(order), np.nan),
        flags=np.full(len(order), int(BlobFlag.NONE), dtype=np.uint8),
        camera_names=rig.camera_names,
        snapshot_names=("0",),
    )
    return blobs, fiducial[order]

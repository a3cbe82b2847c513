"""Captures that violate their description: bent objects, damaged blobs, rigs that have drifted too far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from imgcal.types import CalibrationObject, CameraRig, Detections

Bend = Callable[[Tensor, np.random.Generator], Tensor]
Damage = Callable[[np.random.Generator, CameraRig, CalibrationObject, Detections], Detections]


@dataclass(frozen=True)
class Attack:
    """A kind of capture that violates its description."""

    bend: Bend | None = None  # makes the true fiducials (N, 3)
    damage: Damage | None = None  # changes the blobs
    drift: float = 1.0  # multiple of the prior


def scaled(factor: float) -> Attack:
    """Make an object whose scale differs from its file."""
    return Attack(lambda points, _: points.mean(0) + factor * (points - points.mean(0)))


def stretched(factor: float) -> Attack:
    """Make an object that is longer along its longest axis than in its file."""

    def bend(points: Tensor, _: np.random.Generator) -> Tensor:
        axis = int((points.amax(0) - points.amin(0)).argmax())
        points[:, axis] *= factor
        return points

    return Attack(bend)


def one_off(size: float) -> Bend:
    """Displace one fiducial in a random direction, within the plane for flat objects."""

    def bend(points: Tensor, random: np.random.Generator) -> Tensor:
        direction = random.normal(size=3) * (np.ptp(points.numpy(), axis=0) > 0)
        points[random.integers(len(points))] += torch.from_numpy(size * direction / np.linalg.norm(direction))
        return points

    return bend


def all_off(size: float) -> Attack:
    """Displace all fiducials randomly (sigma in mm), while the object file claims to be exact."""
    return Attack(lambda points, random: points + torch.from_numpy(size * random.normal(size=points.shape)))


def _outliers(random: np.random.Generator, rig: CameraRig, obj: CalibrationObject, table: Detections) -> Detections:
    uv = table.uv + 0.05 * random.standard_t(2.5, size=table.uv.shape)
    rows = random.choice(len(uv), int(random.uniform(0.05, 0.2) * len(uv)), replace=False)
    uv[rows] += random.normal(size=(len(rows), 2)) * random.choice([3, 10, 50])
    size = rig.image_size.numpy()[table.camera]
    return replace(table, uv=np.clip(uv, 0, size - 1.0))


def _missing(random: np.random.Generator, rig: CameraRig, obj: CalibrationObject, table: Detections) -> Detections:
    return table.select(random.random(len(table)) > 0.6)


def _mirrored(random: np.random.Generator, rig: CameraRig, obj: CalibrationObject, table: Detections) -> Detections:
    camera = random.integers(rig.num_cameras)
    uv, mine = table.uv.copy(), table.camera == camera
    uv[mine, 0] = rig.image_size[camera, 0].item() - 1 - uv[mine, 0]
    return replace(table, uv=uv)


def _exchanged(random: np.random.Generator, rig: CameraRig, obj: CalibrationObject, table: Detections) -> Detections:
    a, b = random.choice(rig.num_cameras, 2, replace=False)
    camera = np.where(table.camera == a, b, np.where(table.camera == b, a, table.camera))
    return replace(table, camera=camera)


def _bumped(random: np.random.Generator, rig: CameraRig, obj: CalibrationObject, table: Detections) -> Detections:
    """Shift the blobs of one camera from some snapshot on, like a rotation by 0.5 degrees."""
    camera, count = random.integers(rig.num_cameras), len(table.snapshot_names)
    shift = (
        float(rig.focal_length[camera].mean())
        * np.radians(0.5)
        * np.array([np.cos(a := random.uniform(0, 7)), np.sin(a)])
    )
    late = (table.camera == camera) & (table.snapshot >= random.integers(max(1, count // 4), max(2, count)))
    size = rig.image_size.numpy()[table.camera]
    return replace(table, uv=np.clip(table.uv + late[:, None] * shift, 0, size - 1.0))


ATTACKS: dict[str, Attack] = {
    "as said": Attack(),
    "twice the drift": Attack(drift=2.0),
    "scale +5 %": scaled(1.05),
    "scale -10 %": scaled(0.9),
    "scale +30 %": scaled(1.3),
    "stretched 1 %": stretched(1.01),
    "stretched 15 %": stretched(1.15),
    "stretched 30 %": stretched(1.3),
    "one fiducial 1 mm": Attack(one_off(1.0)),
    "one fiducial 5 mm": Attack(one_off(5.0)),
    "all fiducials 0.2 mm": all_off(0.2),
    "heavy tails, 5-20 % outliers": Attack(damage=_outliers),
    "the same, four times the drift": Attack(damage=_outliers, drift=4.0),
    "60 % missing": Attack(damage=_missing),
    "a camera mirrored": Attack(damage=_mirrored),
    "two cameras exchanged": Attack(damage=_exchanged),
    "a camera turned 0.5 degrees": Attack(damage=_bumped),
}

BENT: dict[str, Bend] = {
    "1 mm": one_off(1.0),
    "5 mm": one_off(5.0),
    "stem 5 % longer": lambda points, _: points * torch.tensor([[1.0], [1.0], [1.0], [1.05]], dtype=points.dtype),
}
"""Bends of the wand whose true shape should be found."""

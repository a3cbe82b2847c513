"""Captures with known ground truth, and faults of one of their cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from imgcal.io import load_object, read_rig
from imgcal.synthesis import PhysicalDrift, Truth, simulate_truth, simulate_volume, true_detections
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior

NOISE = 0.1  # px

Scene = tuple[CameraRig, CalibrationObject, Truth]  # factory rig, object, truth
Change = Callable[[CameraRig], CameraRig]


def wand_in_a_room(snapshots: int, seed: int = 0) -> Scene:
    """Carry a wand through a room with ten cameras."""
    rig, wand = read_rig("room10"), load_object("wand4")
    return rig, wand, simulate_volume(rig, wand, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())


def object_before_a_ring(snapshots: int, seed: int = 0, rig: str = "O10") -> Scene:
    """Turn an object in front of one of the reference rigs."""
    factory, obj = read_rig(rig), load_object("asymmetric8")
    return factory, obj, simulate_truth(factory, obj, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())


def blobs(
    truth: Truth, seed: int = 0, clutter: float = 0.3, missed: float = 0.02,
    crowded: tuple[int, float] | None = None, labelled: bool = False,
) -> Detections:  # fmt: skip
    """Simulate blobs: noise, a few false ones per frame (`crowded`: a camera and its number), some missed fiducials."""
    draw = np.random.default_rng(seed)
    found = true_detections(truth)
    found = found.select(draw.random(len(found)) >= missed)
    found = replace(found, uv=found.uv + NOISE * draw.standard_normal(found.uv.shape))
    rate = np.full(truth.rig.num_cameras, clutter)
    if crowded is not None:
        rate[crowded[0]] = crowded[1]
    number = draw.poisson(np.broadcast_to(rate, (len(found.snapshot_names), len(rate)))).ravel()
    snapshot, camera = np.divmod(np.repeat(np.arange(len(number)), number), len(rate))
    size = truth.rig.image_size.numpy()
    false = replace(
        found,
        uv=draw.random((len(camera), 2)) * (size[camera] - 1),
        sigma=np.full(len(camera), 0.1),
        camera=camera,
        snapshot=snapshot,
        fiducial=np.full(len(camera), -1),
        radius=np.full(len(camera), np.nan),
        flags=np.zeros(len(camera), dtype=np.uint8),
    )
    both = joined(found, false)
    inside = (both.uv >= -0.5) & (both.uv <= size[both.camera] - 0.5)
    both = both.select(np.all(inside, axis=1))
    both = both.select(np.lexsort((draw.random(len(both)), both.snapshot)))
    return both if labelled else replace(both, fiducial=np.full(len(both), -1))


def joined(*tables: Detections) -> Detections:
    """Concatenate tables of the same cameras and snapshots."""
    columns = [f.name for f in fields(Detections) if not f.name.endswith("_names")]
    together: dict[str, Any] = {name: np.concatenate([getattr(t, name) for t in tables]) for name in columns}
    return replace(tables[0], **together)


def mirrored(table: Detections, rig: CameraRig, camera: int, how: str) -> Detections:
    """Flip (u, v, both) or rotate the image of one camera; points that leave the image are lost."""
    width, height = rig.image_size[camera].tolist()
    flips: dict[str, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
        "u": lambda u, v: (width - 1 - u, v),
        "v": lambda u, v: (u, height - 1 - v),
        "both": lambda u, v: (width - 1 - u, height - 1 - v),
        "turned": lambda u, v: (height - 1 - v, u),
    }
    uv, own = table.uv.copy(), table.camera == camera
    uv[own] = np.stack(flips[how](*uv[own].T), axis=1)
    return replace(table, uv=uv).select(~own | ((uv >= -0.5) & (uv <= np.array([width, height]) - 0.5)).all(1))


def swapped(table: Detections, first: int, second: int) -> Detections:
    """Swap two cameras."""
    camera = table.camera
    return replace(table, camera=np.where(camera == first, second, np.where(camera == second, first, camera)))


def late(table: Detections, camera: int) -> Detections:
    """Delay one camera by one snapshot."""
    count = len(table.snapshot_names)
    snapshot = np.where(table.camera == camera, (table.snapshot + 1) % count, table.snapshot)
    return replace(table, snapshot=snapshot)


def with_camera(truth: Truth, obj: CalibrationObject, camera: int, change: Change) -> Truth:
    """Change one camera in all snapshots."""
    rig = replace(change(truth.rig), camera_names=truth.rig.camera_names)
    seen = rig.expand(len(truth.uv)).project(truth.rig_from_object.apply(obj.points), obj.radius)
    uv, visible = truth.uv.clone(), _visible(truth).clone()
    uv[:, camera], visible[:, camera] = seen.uv[:, camera], seen.visible[:, camera]
    return Truth(rig, truth.rig_from_object, uv, visible)


def longer_lens(rig: CameraRig, camera: int, factor: float = 2.0) -> CameraRig:
    """Change the focal length of one camera."""
    focal = rig.focal_length.clone()
    focal[camera] *= factor
    return replace(rig, focal_length=focal)


def turned(rig: CameraRig, camera: int, degrees: float, axis: int = 0) -> CameraRig:
    """Turn one camera about one of its axes."""
    step = torch.zeros_like(RigPrior().std(rig))
    step[camera, axis] = np.radians(degrees)
    return rig.retract(step)


def shifted(rig: CameraRig, camera: int, millimetres: float, axis: int = 0) -> CameraRig:
    """Move one camera along an axis of the rig."""
    step = torch.zeros_like(RigPrior().std(rig))
    step[camera, 3 + axis] = millimetres
    return rig.retract(step)


def changed_from(truth: Truth, obj: CalibrationObject, camera: int, first: int, change: Change) -> Truth:
    """Change one camera from a snapshot on; the true rig is the one before the change."""
    after = with_camera(truth, obj, camera, change)
    later = torch.arange(len(truth.uv)) >= first
    uv = torch.where(later[:, None, None, None], after.uv, truth.uv)
    return Truth(
        truth.rig, truth.rig_from_object, uv, torch.where(later[:, None, None], _visible(after), _visible(truth))
    )


def _visible(truth: Truth) -> Tensor:
    return torch.ones_like(truth.uv[..., 0], dtype=torch.bool) if truth.visible is None else truth.visible


def with_lens_errors(truth: Truth, seed: int = 0, size: float = 0.15) -> Truth:
    """Add lens errors that the camera model cannot express: smooth over each image, px."""
    draw, where = np.random.default_rng(seed), truth.uv / truth.rig.image_size.double()[:, None]
    shape = (truth.uv.shape[1], 1, 2)
    slope, phase = (torch.from_numpy(draw.uniform(low, high, shape)) for low, high in ((2, 5), (0, 6)))
    return replace(truth, uv=truth.uv + size * (slope * where.flip(-1) + phase).sin())


def from_one_end_to_the_other(truth: Truth) -> Truth:
    """Sort the snapshots by one coordinate, so that position and time are correlated."""
    order = truth.rig_from_object.translation[:, 0].argsort()
    visible = None if truth.visible is None else truth.visible[order]
    return replace(truth, uv=truth.uv[order], visible=visible, rig_from_object=truth.rig_from_object[order])

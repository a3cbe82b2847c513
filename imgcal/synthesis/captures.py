"""Synthetic captures with known truth: one drifted rig, an object that moves, realistic infrared frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.geometry import NEAREST_DEPTH, RigidTransform, distort_with_jacobian
from imgcal.synthesis.difficulty import Difficulty, behind_drapes
from imgcal.synthesis.rigs import Drift, PoseRange, Snapshots, synthesize
from imgcal.types import BlobFlag, CalibrationObject, CameraRig, Detections
from renderers import ClutterModel, SensorModel, Smear, Spots, infrared_frames, sample_clutter

Frames = dict[str, NDArray[np.uint8] | NDArray[np.uint16]]


@dataclass(frozen=True)
class Motion:
    """How the object moves while a snapshot is taken: where it is a moment before, and a moment after."""

    before: RigidTransform  # (S,) rig_from_object
    after: RigidTransform  # (S,)
    seconds: float  # in between


@dataclass(frozen=True)
class Truth:
    """The truth behind a capture."""

    rig: CameraRig  # the drifted rig
    rig_from_object: RigidTransform  # (S,)
    uv: Tensor  # (S, C, N, 2) pixels, exact image points
    visible: Tensor | None = None  # (S, C, N) bool, where a camera does not see everything; None = all is seen
    motion: Motion | None = None  # None = the object rests
    parts: tuple[Truth, ...] = ()  # of several objects, that of each; the poses above are those of the first then


@dataclass(frozen=True)
class FrameModel:
    """How markers become frames."""

    sensor: SensorModel = SensorModel()
    clutter: ClutterModel | None = None
    marker_radius: float = 6.0  # mm, where the object's fiducials have no radius of their own
    difficulty: Difficulty | None = None  # disturbs the frames; its clutter and its light replace those above
    exposure_ms: float = 0.0  # during which an object that moves is smeared, as fast as it is; see `Truth.motion`


def simulate_truth(
    rig: CameraRig,
    obj: CalibrationObject,
    snapshots: int,
    generator: torch.Generator,
    drift: Drift | None,
    pose_range: PoseRange = PoseRange(),
) -> Truth:
    """Disturb the rig once, then move the object: every fiducial is in view of every camera in every snapshot.

    Raises:
        RefusedError: the drifted rig cannot see the object.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import PhysicalDrift
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("cube8")
        >>> truth = simulate_truth(rig, obj, 3, torch.Generator().manual_seed(0), PhysicalDrift())
        >>> truth.uv.shape  # snapshots, cameras, fiducials, (u, v)
        torch.Size([3, 4, 8, 2])
    """
    # The first snapshot decides about the drift too, so that the rig is one that sees the object at all.
    first = synthesize(rig, obj, 1, generator, drift=drift, pose_range=pose_range)
    true_rig = first.rig[0]
    parts: list[Snapshots] = [first]
    if snapshots > 1:
        parts.append(synthesize(true_rig, obj, snapshots - 1, generator, drift=None, pose_range=pose_range))
    poses = RigidTransform(
        torch.cat([part.rig_from_object.rotation for part in parts]),
        torch.cat([part.rig_from_object.translation for part in parts]),
    )
    return Truth(true_rig, poses, torch.cat([part.projection.uv for part in parts]))


@dataclass(frozen=True)
class Shot:
    """One simulated snapshot, and what its frames show of the markers."""

    frames: Frames  # camera name -> (H, W)
    seen: Tensor  # (C, N) share of each marker's area that is inside the frame and not hidden
    markers: Spots  # (C, N) as they were drawn, before drapes cut them
    sensor: SensorModel  # and the light


def simulate_frames(
    truth: Truth, obj: CalibrationObject, model: FrameModel, generator: torch.Generator
) -> Iterator[Frames]:
    """Render the frames of one snapshot after another: camera name -> (H, W)."""
    return (shot.frames for shot in simulate_shots(truth, obj, model, generator))


def simulate_shots(
    truth: Truth, obj: CalibrationObject, model: FrameModel, generator: torch.Generator
) -> Iterator[Shot]:
    """Render one snapshot after another, with the truth about what is hidden."""
    rig, difficulty = truth.rig, model.difficulty
    each = list(zip(truth.parts, obj.parts, strict=True)) if truth.parts else [(truth, obj)]
    for pose in range(len(truth.uv)):
        markers = _join([_markers(one, part, model, pose, generator) for one, part in each])
        sensor, clutter = model.sensor, model.clutter
        if difficulty is not None:
            markers = difficulty.disguise(markers, generator)
            sensor, clutter = difficulty.sensor(sensor, generator), difficulty.clutter
        ways = [_image_motion(one, pose, part) / one.motion.seconds for one, part in each if one.motion is not None]
        if model.exposure_ms > 0 and len(ways) == len(each):
            defocus = torch.zeros_like(markers.depth) if markers.smear is None else markers.smear.defocus
            path = torch.cat(ways, 1) * (1e-3 * model.exposure_ms)
            markers = replace(markers, smear=Smear(path, defocus))
        yield _shot(markers, rig, sensor, clutter, generator)


def join_truths(truths: Sequence[Truth]) -> Truth:
    """Join captures of one rig, in each of which another object moves by itself."""
    if len(truths) == 1:
        return truths[0]
    visible = None
    if any(truth.visible is not None for truth in truths):
        shown = [torch.ones(t.uv.shape[:-1], dtype=torch.bool) if t.visible is None else t.visible for t in truths]
        visible = torch.cat(shown, 2)
    first = truths[0]
    return replace(first, uv=torch.cat([t.uv for t in truths], 2), visible=visible, motion=None, parts=tuple(truths))


def _markers(truth: Truth, obj: CalibrationObject, model: FrameModel, pose: int, generator: torch.Generator) -> Spots:
    """Markers of one object."""
    rig, difficulty = truth.rig, model.difficulty
    radius = torch.full_like(obj.points[:, 0], model.marker_radius) if obj.radius is None else obj.radius
    points = truth.rig_from_object[pose].apply(obj.points)
    projection = rig.project(points, obj.radius)
    smear = None
    if difficulty is not None:
        smear = difficulty.smear(rig, truth.rig_from_object[pose], obj.points, obj.radius, generator)
    return Spots(
        uv=projection.uv,
        shape=sphere_images(rig, points, radius),
        intensity=torch.ones_like(projection.depth),
        visible=projection.visible,
        depth=projection.depth,
        smear=smear,
    )


def _join(parts: Sequence[Spots]) -> Spots:
    """Markers of several objects."""
    if len(parts) == 1:
        return parts[0]
    smears = [part.smear for part in parts if part.smear is not None]
    names = ("uv", "shape", "intensity", "visible", "depth")
    joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts], 1) for name in names}
    spots = Spots(**joined)
    if not smears:
        return spots
    path = torch.cat([smear.path for smear in smears], 1)
    return replace(spots, smear=Smear(path, smears[0].defocus[:, :1].expand(path.shape[:-1])))  # a camera has one focus


def true_detections(truth: Truth) -> Detections:
    """The exact image points of what is seen as labelled detections, without noise.

    Examples:
        >>> import imgcal
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("cube8")
        >>> len(true_detections(simulate_truth(rig, obj, 3, torch.Generator().manual_seed(0), None))) == 3 * 4 * 8
        True
    """
    snapshots, cameras, fiducials = truth.uv.shape[:3]
    snapshot, camera, fiducial = (a.reshape(-1) for a in np.indices((snapshots, cameras, fiducials)))
    count = len(snapshot)
    exact = Detections(
        uv=truth.uv.reshape(-1, 2).double().numpy(),
        sigma=np.full(count, 0.1),
        camera=camera,
        snapshot=snapshot,
        fiducial=fiducial,
        radius=np.full(count, np.nan),
        flags=np.full(count, int(BlobFlag.NONE), dtype=np.uint8),
        camera_names=truth.rig.camera_names,
        snapshot_names=tuple(f"{s:05d}" for s in range(snapshots)),
    )
    return exact if truth.visible is None else exact.select(truth.visible.reshape(-1).numpy())


def _image_motion(truth: Truth, snapshot: int, obj: CalibrationObject) -> Tensor:
    """How far each marker moves from a moment before a snapshot to a moment after it: (C, N, 2) pixels."""
    assert truth.motion is not None
    before, after = (
        truth.rig.project(where[snapshot].apply(obj.points), obj.radius).uv
        for where in (truth.motion.before, truth.motion.after)
    )
    return after - before


def _shot(
    markers: Spots, rig: CameraRig, sensor: SensorModel, model: ClutterModel | None, generator: torch.Generator
) -> Shot:
    """Render one snapshot: cameras with images of the same size together."""
    frames: Frames = {}
    seen = torch.zeros_like(markers.intensity)
    sizes = [tuple(size) for size in rig.image_size.tolist()]
    for width, height in sorted(set(sizes)):
        cameras = [camera for camera, size in enumerate(sizes) if size == (width, height)]
        some = markers.of_each(itemgetter(cameras)).of_each(_single)
        clutter = None
        if model is not None:
            clutter = sample_clutter(model, some, (height, width), generator=generator)
            some = behind_drapes(some, clutter.drapes)
        rendered = infrared_frames(some, (height, width), sensor, clutter=clutter, generator=generator)
        seen[cameras] = rendered.seen.to(seen)
        frames |= {rig.camera_names[c]: frame for c, frame in zip(cameras, rendered.frames.numpy(), strict=True)}
    return Shot({name: frames[name] for name in rig.camera_names}, seen, markers, sensor)


def _single(values: Tensor) -> Tensor:
    """Render in single precision."""
    return values.float() if values.is_floating_point() else values


def sphere_images(rig: CameraRig, points_rig: Tensor, radius: Tensor) -> Tensor:
    """Shapes of the images of spheres, to first order in the distortion across a marker.

    Args:
        rig: (*B) cameras.
        points_rig: (*B, N, 3) mm, centres of the spheres.
        radius: (N,) mm.

    Returns:
        (*B, C, N, 2, 2) pixels^2: A of the boundary (x - centre)^T A^-1 (x - centre) = 1. The centres are those of
        `rig.project(points_rig, radius)`.

    Source: rays d that touch a sphere at p satisfy (p d)^2 = (|p|^2 - r^2) |d|^2, a conic on the z = 1 plane.
    """
    points = rig.cam_from_rig.rotation @ points_rig.unsqueeze(-3).mT + rig.cam_from_rig.translation[..., None]
    x, y, z = points.unbind(-2)  # (*B, C, N)
    z = z.clamp_min(NEAREST_DEPTH)
    squared = radius * radius
    gap = (z * z - squared).clamp_min(NEAREST_DEPTH)
    # In the radial direction the ellipse's squared semi-axis is r^2 (|p|^2 - r^2) / gap^2, across it is r^2 / gap.
    scale = squared / (gap * gap)
    aa, ab, bb = scale * (gap + x * x), scale * x * y, scale * (gap + y * y)
    cx, cy = x * z / gap, y * z / gap
    _, _, jxx, jxy, jyy, _ = distort_with_jacobian(cx, cy, rig.distortion, rig.lens_model)
    fx, fy = rig.focal_length.unsqueeze(-2).unbind(-1)
    uu = fx * fx * (jxx * jxx * aa + 2 * jxx * jxy * ab + jxy * jxy * bb)
    uv = fx * fy * (jxx * jxy * aa + (jxx * jyy + jxy * jxy) * ab + jxy * jyy * bb)
    vv = fy * fy * (jxy * jxy * aa + 2 * jxy * jyy * ab + jyy * jyy * bb)
    return torch.stack((uu, uv, uv, vv), dim=-1).unflatten(-1, (2, 2))

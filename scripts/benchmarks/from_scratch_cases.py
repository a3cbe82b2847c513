"""Rigs without a factory calibration, an object carried through their volumes, and errors of results."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from imgcal.geometry import RigidTransform, undistort_cpu
from imgcal.io import load_object
from imgcal.synthesis import (
    HandHeld,
    Lens,
    PhysicalDrift,
    Shape,
    Truth,
    arrange_rig,
    sample_volume,
    simulate_volume,
    true_detections,
)
from imgcal.types import CalibrationObject, CameraRig, ConvexVolume, Detections, RigPrior

NOISE = 0.1  # px, each axis
FOCAL_ERROR = 0.15  # relative, largest error of the given focal lengths
FALSE_BLOBS = 0.5  # per image, on average
HIDDEN = 0.03  # share of the markers
DRIFT = PhysicalDrift(distortion=0.005)
HELD_OUT = 1000  # points, uniform in the volume
LENSES = ((1280, 1024, 65.0), (2048, 1088, 56.0), (1920, 1200, 75.0))
SHAPES: tuple[Shape, ...] = ("ring", "dome", "row")


@dataclass(frozen=True)
class Case:
    """One rig and its observations."""

    name: str
    truth: Truth
    factory: CameraRig  # the true rig has drifted from this by its prior
    volume: ConvexVolume  # working volume, in the true rig's frame
    cameras: CameraRig  # input from scratch: rough focal lengths, no extrinsics
    obj: CalibrationObject
    labelled: Detections
    blobs: Detections  # the same without labels, with false blobs


def make_case(number: int, snapshots: int) -> Case:
    """Make rig `number`: 6 to 16 cameras in a ring, a dome or a row, wands and solid objects."""
    rng = np.random.default_rng(1000 + number)
    generator = torch.Generator().manual_seed(number)
    shape = SHAPES[number % 3]
    cameras, radius = int(rng.integers(6, 17)), float(rng.uniform(2500, 4500))
    width, height, angle = LENSES[number % len(LENSES)] if number % 2 else LENSES[0]
    rig = arrange_rig(
        shape,
        cameras,
        radius,
        height=0.0 if shape == "dome" else 0.6 * radius,
        target=(0.0, 1.0 * radius, 1000.0) if shape == "row" else (0.0, 0.0, 1000.0),
        lens=Lens((width, height), angle),
    )
    reach = 0.6 * radius
    middle = radius if shape == "row" else 0.0
    volume = ConvexVolume.box((-reach, middle - reach, 100.0), (reach, middle + reach, 2200.0))
    lens = torch.tensor([-0.08, 0.05, 0.0003, -0.0002, 0.0], dtype=torch.float64)
    rig = replace(rig, distortion=lens.repeat(cameras, 1), volume=volume, prior=DRIFT_PRIOR)
    obj = load_object("wand4") if number % 2 == 0 else load_object("asymmetric8")
    obj = obj if number % 2 == 0 else replace(obj, points=2 * obj.points, radius=None)
    drifted = DRIFT.apply(rig, generator)
    drifted.distortion[:, 4] = 0.0  # some tools have no third radial coefficient
    truth = simulate_volume(drifted, obj, snapshots, generator, None, hand=HandHeld(speed=800.0, rate=5.0))
    labelled = _seen(true_detections(truth), rng)
    focal = drifted.focal_length * torch.from_numpy(1 + rng.uniform(-FOCAL_ERROR, FOCAL_ERROR, (cameras, 1)))
    rough = replace(
        rig,
        focal_length=focal,
        distortion=torch.zeros_like(rig.distortion),
        cam_from_rig=RigidTransform.identity(cameras, dtype=torch.float64),
        prior=RigPrior(0.15, 0.02 * width, 0.1, 1.0, 1e6),
        volume=None,
    )
    name = f"{number}: {shape}, {cameras} cameras, {obj.name}"
    return Case(name, truth, rig, volume, rough, obj, labelled, _as_blobs(labelled, rig, rng))


DRIFT_PRIOR = RigPrior(DRIFT.focal_length, DRIFT.principal_point, DRIFT.distortion, np.radians(DRIFT.rotation_deg), 2.0)


def _seen(exact: Detections, rng: np.random.Generator) -> Detections:
    """Hide some markers, and add noise to the others."""
    seen = exact.select(rng.random(len(exact)) >= HIDDEN)
    return replace(seen, uv=seen.uv + NOISE * rng.normal(size=seen.uv.shape), sigma=np.full(len(seen), NOISE))


def _as_blobs(labelled: Detections, rig: CameraRig, rng: np.random.Generator) -> Detections:
    """Remove the labels, and add false blobs at random."""
    snapshots, cameras = len(labelled.snapshot_names), len(labelled.camera_names)
    count = int(rng.poisson(FALSE_BLOBS * snapshots * cameras))
    camera = rng.integers(0, cameras, count)
    both = replace(
        labelled,
        uv=np.concatenate((labelled.uv, rng.random((count, 2)) * (rig.image_size.numpy()[camera] - 1))),
        sigma=np.full(len(labelled) + count, NOISE),
        camera=np.concatenate((labelled.camera, camera)),
        snapshot=np.concatenate((labelled.snapshot, rng.integers(0, snapshots, count))),
        fiducial=np.full(len(labelled) + count, -1),
        radius=np.full(len(labelled) + count, np.nan),
        flags=np.zeros(len(labelled) + count, dtype=np.uint8),
    )
    return both.select(np.lexsort((both.uv[:, 1], both.camera, both.snapshot)))


def point_errors(found: CameraRig, truth: CameraRig, volume: ConvexVolume, scaled: bool = False) -> np.ndarray:
    """Errors (mm) of points in the volume that a rig triangulates from their true pixels.

    The rig is first aligned with the truth, by the best rigid motion.

    Args:
        found: the rig to score, in any frame.
        truth: the true rig.
        volume: of the points, in the true rig's frame.
        scaled: also ignore an error of the scale.
    """
    points = sample_volume(volume, HELD_OUT, torch.Generator().manual_seed(7))
    projection = truth.project(points)
    seen = projection.visible & (projection.visible.sum(0) >= 2)
    xy, _ = undistort_cpu(
        (projection.uv - found.principal_point[:, None]) / found.focal_length[:, None],
        found.distortion,
    )
    rays = torch.nn.functional.normalize(torch.cat((xy, torch.ones_like(xy[..., :1])), -1), dim=-1)
    rays = rays @ found.cam_from_rig.rotation
    across = (torch.eye(3, dtype=rays.dtype) - rays[..., :, None] * rays[..., None, :]) * seen[..., None, None]
    kept = seen.any(0)
    pulled = torch.einsum("cpij,cj->pi", across, found.positions)[kept]
    there = torch.linalg.solve(across.sum(0)[kept], pulled).numpy()
    return np.linalg.norm(_laid(there, points[kept].numpy(), scaled) - points[kept].numpy(), axis=1)


def _laid(source: np.ndarray, destination: np.ndarray, scaled: bool) -> np.ndarray:
    """Align points (P, 3) with others.

    Source: Umeyama 1991.
    """
    a, b = source - source.mean(0), destination - destination.mean(0)
    u, s, vh = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vh)])
    scale = float((s * sign).sum() / (a * a).sum()) if scaled else 1.0
    return scale * a @ ((u * sign) @ vh).T + destination.mean(0)

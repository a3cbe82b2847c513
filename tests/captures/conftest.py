"""How real frames are used: fit one half, call that the factory calibration, disturb it, recover, score the rest."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from imgcal.cli.main import main
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import save_rig
from imgcal.types import CameraRig, Detections, RigPrior

# Rotation, translation, focal length, principal point, distortion: sizes of a unit step in the fit.
SCALE = np.array([0.1] * 3 + [10.0] * 3 + [100.0] * 4 + [0.1, 0.1, 0.01, 0.01, 1.0])


@dataclass(frozen=True)
class Points:
    """Image points with what they are images of, of all cameras."""

    uv: np.ndarray  # (M, 2)
    xyz: np.ndarray  # (M, 3)
    camera: np.ndarray  # (M,)
    fiducial: np.ndarray  # (M,)

    def select(self, rows: np.ndarray) -> Points:
        return Points(self.uv[rows], self.xyz[rows], self.camera[rows], self.fiducial[rows])


def read_points(path: Path, object_points: np.ndarray, cameras: tuple[str, ...]) -> Points:
    with path.open() as file:
        rows = list(csv.DictReader(file))
    xyz = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    fiducial = np.linalg.norm(xyz[:, None] - object_points, axis=-1).argmin(1)
    uv = np.array([[float(row["u"]), float(row["v"])] for row in rows])
    return Points(uv, xyz, np.array([cameras.index(row["camera"]) for row in rows]), fiducial)


def fit_camera(xyz: np.ndarray, uv: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Pinhole and five coefficients by SciPy, from several principal points: refraction puts it far outside."""
    width, height = image_size
    start = np.array([[5000.0, 0, width / 2], [0, 5000, height / 2], [0, 0, 1]])
    fixed = (
        cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    )  # fmt: skip
    points = (xyz.astype(np.float32), uv.astype(np.float32))
    _, matrix, _, rotation, translation = cv2.calibrateCamera(
        [points[0]], [points[1]], image_size, start, None, flags=fixed
    )

    def residuals(x: np.ndarray) -> np.ndarray:
        p = np.r_[x, np.zeros(15 - len(x))] * SCALE
        camera = np.array([[p[6], 0, p[8]], [0, p[7], p[9]], [0, 0, 1]])
        return (cv2.projectPoints(xyz, p[:3], p[3:6], camera, p[10:])[0][:, 0] - uv).ravel()

    first = np.r_[rotation[0].ravel(), translation[0].ravel(), matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    best = None
    for shift in ((0, 0), (-300, 500), (300, 500), (-300, -500), (800, 0), (-800, 0)):
        x = (first + np.r_[np.zeros(8), shift]) / SCALE[:10]
        pinhole = least_squares(residuals, x, method="lm", max_nfev=3000).x
        fit = least_squares(residuals, np.r_[pinhole, np.zeros(5)], method="lm", max_nfev=6000)
        best = fit if best is None or fit.cost < best.cost else best
    return best.x * SCALE


def fit_rig(points: Points, cameras: tuple[str, ...], image_size: tuple[int, int], prior: RigPrior) -> CameraRig:
    """Each camera by itself; the rig frame is the object's frame."""
    rows = [points.camera == camera for camera in range(len(cameras))]
    found = torch.from_numpy(np.array([fit_camera(points.xyz[r], points.uv[r], image_size) for r in rows]))
    return CameraRig(
        found[:, 6:8], found[:, 8:10], found[:, 10:],
        RigidTransform(rotation_from_vector(found[:, :3]), found[:, 3:6]),
        torch.tensor([image_size] * len(cameras)), cameras, "factory", None, prior,
    )  # fmt: skip


def disturbed(rig: CameraRig, points: Points, pixels: float, seed: int) -> CameraRig:
    """Turn, shift and rescale every camera by a few percent so that points move by `pixels` (RMS) in each camera."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.randn(rig.num_cameras, 15, generator=generator, dtype=torch.float64)
    size = torch.cat(
        (torch.full((3,), 0.001), torch.full((3,), 1.0), torch.full((2,), 20.0), torch.full((2,), 5.0), torch.zeros(5))
    )
    step = draw * size
    for _ in range(20):
        moved = rig.retract(step)
        shift = np.linalg.norm(predicted(moved, points) - predicted(rig, points), axis=1)
        rms = np.sqrt([np.mean(shift[points.camera == c] ** 2) for c in range(rig.num_cameras)])
        step = step * torch.from_numpy(pixels / rms)[:, None]
    return rig.retract(step)


def predicted(rig: CameraRig, points: Points) -> np.ndarray:
    uv = rig.project(torch.from_numpy(points.xyz)).uv.numpy()
    return uv[points.camera, np.arange(len(points.xyz))]


def at_own_centres(points: Points, found: Detections) -> tuple[Points, float]:
    """Move points to the blobs that our own detector found within 2 px of them; also the share that has one."""
    uv, kept = points.uv.copy(), np.zeros(len(points.uv), dtype=bool)
    for camera in np.unique(points.camera):
        rows = np.flatnonzero(points.camera == camera)
        own = found.uv[(found.camera == camera) & found.usable]
        distance = np.linalg.norm(points.uv[rows][:, None] - own, axis=-1)
        kept[rows], uv[rows] = distance.min(1) < 2, own[distance.argmin(1)]
    return replace(points, uv=uv).select(kept), float(kept.mean())


def as_detections(points: Points, cameras: tuple[str, ...]) -> Detections:
    count = len(points.uv)
    return Detections(
        points.uv, np.full(count, 0.1), points.camera, np.zeros(count, np.int64), points.fiducial,
        np.full(count, np.nan), np.zeros(count, np.uint8), cameras, ("0",),
    )  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    code: int
    result: dict
    rig: Path


@pytest.fixture
def calibrate(tmp_path):
    """Run `imgcal calibrate` on a capture with a rig in memory."""

    def run(source: Path, rig: CameraRig, obj: Path, *more: str) -> Outcome:
        out = tmp_path / "out"
        save_rig(replace(rig, name="disturbed"), tmp_path / "disturbed.yaml")
        arguments = [str(source), "--rig", str(tmp_path / "disturbed.yaml"), "--object", str(obj), "--out", str(out)]
        code = main(["calibrate", *arguments, "--no-report", *more])
        return Outcome(code, json.loads((out / "result.json").read_text()), out / "rig.yaml")

    return run


@pytest.fixture
def score(capsys):
    """Run `imgcal score` and read what it prints."""

    def run(source: Path, rig: Path, obj: Path, *more: str) -> dict:
        capsys.readouterr()
        assert main(["score", str(source), "--rig", str(rig), "--object", str(obj), *more]) == 0
        return json.loads(capsys.readouterr().out)

    return run

"""Each set of real frames, with a factory calibration fitted to half of its points, and the other half to score by."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, read_frame
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior
from renderers import palette
from tests.captures.conftest import Points, as_detections, at_own_centres, fit_rig, predicted, read_points

DOTS, CAVITY = ("cam1", "cam2", "cam3"), ("cam3", "cam4")
SIZE = (1280, 1024)
# Refraction is no small drift of distortion; what drifted by a few percent is said by the prior.
PRIOR = RigPrior(focal_length=0.01, principal_point=20.0, distortion=0.05, rotation=0.005, position=3.0)
PITCH = 25.4  # mm, of the grid's dots

# The ends of each row of the cavity's dots, read off the frames by eye (pixels), and what they are: (x first, x last,
# y, z) in mm.
ROWS = {
    "cam3": [
        ((237, 394), (971, 381), (-40, 30, 25, 8)), ((286, 493), (956, 479), (-35, 30, 15, 0)),
        ((280, 643), (940, 624), (-35, 30, 0, -8)), ((290, 809), (957, 784), (-35, 30, -15, 0)),
        ((246, 926), (921, 900), (-40, 25, -25, 8)),
    ],
    "cam4": [
        ((251, 300), (986, 301), (-40, 30, 25, 8)), ((321, 401), (944, 401), (-35, 25, 15, 0)),
        ((343, 550), (957, 551), (-35, 25, 0, -8)), ((329, 711), (949, 720), (-35, 25, -15, 0)),
        ((261, 824), (993, 836), (-40, 30, -25, 8)),
    ],
}  # fmt: skip


@dataclass(frozen=True)
class RealSet:
    """One set: what was published about it, and what was made of that."""

    frames: dict[str, list[np.ndarray]]  # camera -> (H, W) of each snapshot
    obj: CalibrationObject
    factory: CameraRig  # fitted to one half of the points
    points: Points  # all that were published
    held_out: Detections  # the other half, measured by our own detector where the published blobs are
    share: float  # of the other half, for which it found a blob


def three_cameras_dots(captures: Path) -> RealSet:
    """437 bright dots on a lattice, three cameras, one frame each, seen through glass."""
    folder = captures / "three-cameras-dots"
    obj = load_object(folder / "object.csv")
    points = read_points(folder / "correspondences.csv", obj.points.numpy(), DOTS)
    return _halved({name: [read_frame(folder / "frames" / f"{name}.tif")] for name in DOTS}, obj, points, 0)


def cavity_two_cameras(captures: Path) -> RealSet:
    """73 bright dots of a target that is not planar, amid thousands of real particles, two cameras, one frame each."""
    folder = captures / "cavity-two-cameras"
    obj = load_object(folder / "object.csv")
    points = _published_dots(folder, obj.points.numpy())
    # Two places are a particle beside the dot: they stand out of a first fit.
    off = np.linalg.norm(predicted(fit_rig(points, CAVITY, SIZE, PRIOR), points) - points.uv, axis=1)
    frames = {name: [read_frame(folder / "frames" / f"{name}.png")] for name in CAVITY}
    return _halved(frames, obj, points.select(off < 2.5), 1)


def dot_grid(captures: Path) -> tuple[list[np.ndarray], CalibrationObject]:
    """15 views of a grid of 10 x 10 dark dots, by one camera, and the grid."""
    frames = [read_frame(path) for path in sorted((captures / "dot-grid-10x10" / "frames").glob("*.png"))]
    rows, columns = torch.meshgrid(torch.arange(10), torch.arange(10), indexing="ij")
    points = PITCH * torch.stack((columns, rows, torch.zeros_like(rows)), -1).reshape(-1, 3).double()
    return frames, CalibrationObject(points, palette(len(points)))


def nominal() -> CameraRig:
    """The grid's camera as its maker describes it: 2 % off."""
    return CameraRig(
        torch.tensor([[550.0, 550.0]], dtype=torch.float64), torch.tensor([[320.0, 240.0]], dtype=torch.float64),
        torch.zeros(1, 5, dtype=torch.float64), RigidTransform.identity(1, dtype=torch.float64),
        torch.tensor([[640, 480]]), ("cam",),
    )  # fmt: skip


def _halved(frames: dict[str, list[np.ndarray]], obj: CalibrationObject, points: Points, seed: int) -> RealSet:
    cameras = tuple(frames)
    half = np.random.default_rng(seed).random(len(points.uv)) < 0.5
    factory = fit_rig(points.select(half), cameras, SIZE, PRIOR)
    held_out, share = at_own_centres(points.select(~half), imgcal.detect(frames))
    return RealSet(frames, obj, factory, points, as_detections(held_out, cameras), share)


def _published_dots(folder: Path, object_points: np.ndarray) -> Points:
    """The heaviest published blob near each place along the cavity's rows, and which dot it is."""
    with (folder / "detections.csv").open() as file:
        blobs = list(csv.DictReader(file))
    uv, xyz, camera = [], [], []
    for index, name in enumerate(CAVITY):
        mine = [blob for blob in blobs if blob["camera"] == name]
        centres = np.array([[float(blob["u"]), float(blob["v"])] for blob in mine])
        mass = np.array([float(blob["mass"]) for blob in mine])
        for first, last, (x0, x1, y, z) in ROWS[name]:
            for x in range(x0, x1 + 1, 5):
                near = np.flatnonzero(np.linalg.norm(centres - _between(first, last, (x - x0) / (x1 - x0)), axis=1) < 8)
                if len(near):
                    uv.append(centres[near[mass[near].argmax()]])
                    xyz.append((x, y, z))
                    camera.append(index)
    places = np.array(xyz, dtype=float)
    fiducial = np.linalg.norm(places[:, None] - object_points, axis=-1).argmin(1)
    return Points(np.array(uv), places, np.array(camera), fiducial)


def _between(first: Sequence[int], last: Sequence[int], share: float) -> np.ndarray:
    return (1 - share) * np.array(first) + share * np.array(last)

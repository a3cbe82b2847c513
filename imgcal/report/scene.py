"""What the report shows of the rig in 3D: factory and recalibrated cameras, and the object in each snapshot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.live_page import frustum_length
from imgcal.report.content import Array, ReportContent
from imgcal.report.rig_view import DrawnRig, Scene, rig_scene
from imgcal.types import CameraRig

EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100)
LARGEST_CLOUD = 3000  # fiducials drawn, of all snapshots together


@dataclass(frozen=True)
class DrawnScene:
    """A scene, with the factors by which changes are drawn larger, and the number of the one to start with."""

    values: Scene
    factors: tuple[int, ...] = ()  # empty where nothing was recalibrated
    start: int = 0


def describe_scene(content: ReportContent) -> DrawnScene:
    """Describe the scene; the recalibrated rig has one step for each exaggeration of its changes.

    Convention: drawn in the factory's rig frame; the recalibrated rig is aligned to the factory's by `content.gauge`.
    """
    factory = content.factory.to(torch.float64)
    points = _object_points(content)
    rigs = [DrawnRig("factory", "--ghost", (factory,))]
    factors: tuple[int, ...] = ()
    start = 0
    if content.recalibrated is not None:
        factors, start = _exaggerations(content, frustum_length(factory, points))
        steps = tuple(_exaggerate(content, factor) for factor in factors)
        rigs.append(DrawnRig("recalibrated", "--after", steps, filled=True))
    scene = rig_scene(rigs, points)
    if points is not None:
        snapshots, fiducials = choose_fiducials(content)
        names = content.detections.snapshot_names
        scene |= {"groupNames": [f"snapshot {names[s]}" for s in snapshots], "fiducials": fiducials.tolist()}
    return DrawnScene(scene, factors, start)


def known_poses(content: ReportContent) -> NDArray[np.int64]:
    """Numbers of the rows with a pose of the object."""
    if content.rig_from_object is None:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(np.isfinite(content.rig_from_object.translation.cpu().numpy()).all(axis=1))


def choose_fiducials(content: ReportContent) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Choose snapshots and fiducials to draw: indices, evenly spread, all of them where there are few."""
    if content.rig_from_object is None or content.object_points is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    good = known_poses(content)
    snapshots = good[_evenly(len(good), 60)]
    fiducials = _evenly(len(content.object_points), max(LARGEST_CLOUD // max(len(snapshots), 1), 1))
    return snapshots, fiducials


def _evenly(count: int, largest: int) -> NDArray[np.int64]:
    return np.linspace(0, max(count - 1, 0), min(count, largest)).round().astype(np.int64)


def _object_points(content: ReportContent) -> Array | None:
    """Fiducials of the drawn snapshots in the factory's rig frame: (S', N', 3) mm."""
    snapshots, fiducials = choose_fiducials(content)
    if content.recalibrated is None or content.rig_from_object is None or not len(snapshots):
        return None
    recalibrated, laid = content.recalibrated.to(torch.float64), content.aligned_rig
    drawn_from_rig = (recalibrated if laid is None else laid).cam_from_rig[0].inverse() @ recalibrated.cam_from_rig[0]
    points = torch.as_tensor(content.object_points)[fiducials].to(torch.float64)
    poses = content.rig_from_object.to(torch.float64)[torch.as_tensor(snapshots)]
    return drawn_from_rig.apply(poses.apply(points.to(poses.translation.device))).detach().cpu().numpy()


def _exaggerate(content: ReportContent, factor: float) -> CameraRig:
    """Factory cameras, moved by `factor` times their change."""
    if content.aligned_rig is None:
        return content.factory
    factory = content.factory.to(torch.float64)
    step = content.aligned_rig.local(factory).detach()
    step[..., :6] *= factor
    return factory.retract(step)


def _exaggerations(content: ReportContent, length: float) -> tuple[tuple[int, ...], int]:
    """Factors to choose from, and the one to start with: changes that can be seen but do not tear the rig apart."""
    if content.change is None or len(content.cameras) == 1:
        return (1,), 0
    angle = float(np.linalg.norm(content.change[:, :3], axis=1).max())
    shift = float(np.linalg.norm(content.change[:, 3:6], axis=1).max())
    factors = tuple(k for k in EXAGGERATIONS if k == 1 or (k * angle < 1.0 and k * shift < 4 * length))
    start = max(i for i, k in enumerate(factors) if k == 1 or (k * angle < 0.25 and k * shift < 0.6 * length))
    return factors, start

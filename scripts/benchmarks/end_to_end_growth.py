"""How the cost of a calibration grows with cameras, fiducials, snapshots and image size."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from imgcal.association import Associations, PipelineOptions, SnapshotIdentity, associate, relocalize, track
from imgcal.detection import DetectionOptions, detect_snapshot
from imgcal.io import load_object, read_rig
from imgcal.online import RigKeeper
from imgcal.pipeline import calibrate, fit_labelled
from imgcal.synthesis import FrameModel, PhysicalDrift, Truth, simulate_frames, simulate_truth, true_detections
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior
from renderers import ClutterModel
from scripts.benchmarks.calibration_speed import carried
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peers import opencv_live
from scripts.output import BLUE, GREEN, GREY, RED, figure, markdown
from scripts.results.runtime import ring
from scripts.timing import side_by_side

NOISE = 0.05  # px
DRIFT = replace(PhysicalDrift(), principal_point=1.0, rotation_deg=0.05)  # so that all cameras see the whole object
WIDTH = 120.0  # mm, of objects
MOST_RUNNING = 128  # cameras of a running rig
BEGUN = 20  # snapshots of a running rig before it is timed: it measures the noise after 4, 8 and 16
SIZES = ((640, 480), (1280, 1024), (2048, 1088), (4096, 3000))
COLD, KNOWN, RUNNING = "identity, cold", "identity, pose known", "running: blobs to a rig"
LABELLED, OPENCV = "labels to a rig", "OpenCV, labels to cameras"
IDENTITY, FOLLOWED, ESTIMATION = "identity", "identity, followed", "estimation"
DETECTION, FRAMES = "detection", "running: frames to a rig"
QUICK, EXACT = "OpenCV, detection, 1 threshold", "OpenCV, detection, 10 thresholds"
COLOURS = {COLD: GREEN, KNOWN: "#8fbf6f", RUNNING: BLUE, LABELLED: "#6fa8dc", OPENCV: RED}
COLOURS |= {
    IDENTITY: GREEN,
    FOLLOWED: "#8fbf6f",
    ESTIMATION: BLUE,
    DETECTION: GREEN,
    FRAMES: BLUE,
    QUICK: "#e58a80",
    EXACT: RED,
}
AXES = {
    "cameras": (COLD, KNOWN, RUNNING, LABELLED, OPENCV),
    "fiducials": (COLD, KNOWN, RUNNING, LABELLED, OPENCV),
    "fiducials of a lattice": (COLD, KNOWN),
    "snapshots": (IDENTITY, FOLLOWED, ESTIMATION, OPENCV),
    "megapixels": (DETECTION, FRAMES, QUICK, EXACT),
}


@dataclass(frozen=True)
class Scene:
    """A drifted rig and its observations of an object."""

    rig: CameraRig  # factory
    obj: CalibrationObject
    truth: Truth
    detections: Detections  # labelled


def measure(effort: Effort) -> dict[str, Any]:
    """Measure all five axes; every point takes about the same time."""
    seconds = effort.pick(1.0, 0.02)
    o10, few = read_rig("O10"), load_object("asymmetric8")
    cameras = effort.pick((2, 4, 8, 16, 32, 64, 128, 256, 512, 1024), (2, 4))
    fiducials = effort.pick((8, 16, 32, 64, 128, 256, 437), (8, 12))
    lattices = effort.pick(((5, 5), (10, 10), (15, 15), (19, 23)), ((4, 4),))
    snapshots = effort.pick((1, 3, 10, 30, 100, 300, 1000), (1, 2))
    sizes = effort.pick(SIZES, SIZES[:1])
    return {
        "cameras": [{"n": n} | of_one_snapshot(make_scene(ring(n), few), seconds, _stages(n)) for n in cameras],
        "fiducials": [{"n": n} | of_one_snapshot(make_scene(o10, cloud(n)), seconds) for n in fiducials],
        "fiducials of a lattice": [
            {"n": n * m} | of_one_snapshot(make_scene(o10, lattice(n, m)), seconds, (COLD, KNOWN)) for n, m in lattices
        ],
        "snapshots": [{"n": n} | of_snapshots(make_scene(o10, few, n), seconds) for n in snapshots],
        "megapixels": [{"n": w * h / 1e6, "size": f"{w} x {h}"} | of_frames(w, h, seconds) for w, h in sizes],
    }


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make one table per axis: times in ms, and the exponent of their growth."""
    made = {}
    for axis, stages in AXES.items():
        rows = [(str(row.get("size", row["n"])), *(_ms(row.get(stage)) for stage in stages)) for row in result[axis]]
        rows.append(("grows by the power", *(_power(result[axis], stage) for stage in stages)))
        made[f"growth {axis}"] = markdown((axis, *(f"{stage}, ms" for stage in stages)), rows)
    return made


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw all curves, log-log, with a line of slope one."""
    with figure(path, panels=len(AXES), size=(15.0, 3.6)) as panels:
        for axes, (axis, stages) in zip(panels, AXES.items(), strict=True):
            for stage in stages:
                points = [(row["n"], row[stage]) for row in result[axis] if row.get(stage) is not None]
                axes.plot(*zip(*points, strict=True), "o-", color=COLOURS[stage], markersize=2.5, label=stage)
            n = np.array([row["n"] for row in result[axis]], dtype=float)
            low = min(row[stage] for row in result[axis] for stage in stages if row.get(stage) is not None)
            axes.plot(n, low * n / n[0], ":", color=GREY, linewidth=1, label="linear")
            axes.set(xscale="log", yscale="log", xlabel=axis)
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.legend(fontsize=5.5)
        panels[0].set_ylabel("ms")


def _stages(cameras: int) -> Sequence[str]:
    """Stages to time with so many cameras; with hundreds, a running rig's matrices would need gigabytes and minutes."""
    return [stage for stage in AXES["cameras"] if stage != RUNNING or cameras <= MOST_RUNNING]


def cloud(fiducials: int) -> CalibrationObject:
    """Place fiducials at random in a cube."""
    generator = torch.Generator().manual_seed(fiducials)
    points = (torch.rand(fiducials, 3, generator=generator, dtype=torch.float64) - 0.5) * WIDTH
    return CalibrationObject(points, torch.rand(fiducials, 3, generator=generator, dtype=torch.float64))


def lattice(rows: int, columns: int) -> CalibrationObject:
    """Place fiducials in a plane, in a square lattice."""
    places = torch.cartesian_prod(torch.arange(rows), torch.arange(columns), torch.zeros(1, dtype=torch.int64)).double()
    points = (places - places.mean(0)) * (WIDTH / (max(rows, columns) - 1))
    return CalibrationObject(points, torch.ones_like(points))


def make_scene(rig: CameraRig, obj: CalibrationObject, snapshots: int = 1) -> Scene:
    """Let the rig drift, and simulate noisy observations of the object."""
    truth = simulate_truth(rig, obj, snapshots, torch.Generator().manual_seed(0), DRIFT)
    found = true_detections(truth)
    noise = NOISE * np.random.default_rng(0).standard_normal(found.uv.shape)
    return Scene(rig, obj, truth, replace(found, uv=found.uv + noise, sigma=np.full(len(found), NOISE)))


def of_one_snapshot(scene: Scene, seconds: float, stages: Sequence[str] = AXES["cameras"]) -> dict[str, float]:
    """Time the stages after detection, and the same with OpenCV: medians, ms."""
    rig, obj, pose = scene.rig, scene.obj, scene.truth.rig_from_object[0]
    std = (rig.prior or RigPrior()).std(rig)
    blank = replace(scene.detections, fiducial=np.full(len(scene.detections), -1))
    told = replace(blank, sigma=np.hypot(blank.sigma, PipelineOptions().identity_error))
    labelled = Associations(scene.detections, (SnapshotIdentity("0", "by_tracking", "", 1, pose),))
    moments = count()
    with RigKeeper(rig, obj, horizon=1) as keeper:
        cases: dict[str, Callable[[], object]] = {
            COLD: lambda: relocalize(told, rig, obj, std),
            KNOWN: lambda: track(told, rig, obj, std, pose),
            RUNNING: lambda: keeper.update(blank, next(moments) / 60),
            LABELLED: lambda: fit_labelled(labelled, rig, obj),
            OPENCV: lambda: cameras_by_opencv(scene),
        }
        chosen = {name: cases[name] for name in stages}
        for _ in range(BEGUN if RUNNING in stages else 0):
            chosen[RUNNING]()
        return {name: timing.p50 for name, timing in side_by_side(chosen, seconds).items()}


def cameras_by_opencv(scene: Scene) -> None:
    """Calibrate each camera from its labelled blobs of one snapshot."""
    points = scene.obj.points.numpy()
    uv, labels = scene.truth.uv[0].numpy(), np.arange(len(points))
    for c in range(scene.rig.num_cameras):
        opencv_live.calibrated(labels, uv[c], points, view_of(scene, c), _size(scene.rig))


def view_of(scene: Scene, camera: int) -> opencv_live.View:
    """A camera's factory intrinsics and pose."""
    rig = scene.rig
    matrix = np.diag([*rig.focal_length[camera].tolist(), 1.0])
    matrix[:2, 2] = rig.principal_point[camera].numpy()
    pose = rig.cam_from_rig[camera] @ scene.truth.rig_from_object[0]
    vector = cv2.Rodrigues(pose.rotation.numpy())[0][:, 0]
    return opencv_live.View(matrix, rig.distortion[camera].numpy(), np.asarray(vector, float), pose.translation.numpy())


def of_snapshots(scene: Scene, seconds: float) -> dict[str, float]:
    """Time the stages of `calibrate`, and OpenCV, in ms; slow ones only once."""
    blank = replace(scene.detections, fiducial=np.full(len(scene.detections), -1))
    runs: list[Mapping[str, float]] = []
    begin = time.perf_counter()
    while not runs or (time.perf_counter() - begin < seconds and len(runs) < 5):
        runs.append(calibrate(blank, scene.rig, scene.obj).seconds)
    stages = {name: 1e3 * float(np.median([run[name] for run in runs])) for name in (IDENTITY, ESTIMATION)}
    moved, rig = _follow(len(scene.truth.uv), scene.rig), scene.rig.to(torch.float64)
    followed = side_by_side({FOLLOWED: lambda: associate(moved, rig, scene.obj)}, seconds)
    stages[FOLLOWED] = followed[FOLLOWED].p50
    return stages | {OPENCV: 1e3 * scene.rig.num_cameras * _views_by_opencv(scene)}


def _follow(snapshots: int, rig: CameraRig) -> Detections:
    """Blobs of an object that moves smoothly; that of `make_scene` is somewhere else in every snapshot."""
    names = tuple(f"{number:05d}" for number in range(snapshots))
    columns = carried("O10", "asymmetric8", snapshots)
    return Detections(**columns, camera_names=rig.camera_names, snapshot_names=names)


def _views_by_opencv(scene: Scene) -> float:
    """Calibrate the first camera from all snapshots, with its lens if there are enough; seconds."""
    count, points = len(scene.truth.uv), scene.obj.points.numpy().astype(np.float32)
    start = view_of(scene, 0)
    flags = opencv_live.FLAGS if count < 3 else cv2.CALIB_USE_INTRINSIC_GUESS
    uv = [one.numpy().astype(np.float32) for one in scene.truth.uv[:, 0]]
    run: Any = cv2.calibrateCamera  # its stubs lack half of its arguments
    begin = time.perf_counter()
    run([points] * count, uv, _size(scene.rig), start.matrix.copy(), start.distortion.copy(), flags=flags)
    return time.perf_counter() - begin


def of_frames(width: int, height: int, seconds: float) -> dict[str, float]:
    """Time ten frames of one size, one thread: medians, ms."""
    rig, obj = wide(read_rig("O10"), width, height), load_object("asymmetric8")
    scene = make_scene(rig, obj)
    frames = _frames(scene)
    scale = width / 2048
    quick, exact = (opencv_live.detector((6.0 * scale, 24.0 * scale), number) for number in (1, 10))
    usual = DetectionOptions()
    options = replace(usual, max_radius=usual.radius_limit * max(scale, 1.0))
    moments = count()
    with RigKeeper(rig, obj, detection=options, horizon=1) as keeper, ThreadPoolExecutor(1) as pool:
        cases: dict[str, Callable[[], object]] = {
            DETECTION: lambda: detect_snapshot(frames, options, pool=pool),
            FRAMES: lambda: keeper.update(frames, next(moments) / 60),
            QUICK: lambda: [quick.detect(frame) for frame in frames.values()],
            EXACT: lambda: [exact.detect(frame) for frame in frames.values()],
        }
        return {name: timing.p50 for name, timing in side_by_side(cases, seconds).items()}


def wide(rig: CameraRig, width: int, height: int) -> CameraRig:
    """Give all cameras images of another size, with the same horizontal field of view."""
    old = rig.image_size.to(rig.focal_length)
    size = torch.tensor([width, height])
    scale = (width / old[:, :1]).expand(-1, 2)
    middle = (size.to(old) - 1) / 2
    shift = (rig.principal_point - (old - 1) / 2) * scale
    return replace(
        rig,
        focal_length=rig.focal_length * scale,
        principal_point=middle + shift,
        image_size=size.expand(rig.num_cameras, 2),
    )


def _frames(scene: Scene) -> dict[str, NDArray[Any]]:
    """Render camera by camera; large images of all cameras at once would take gigabytes."""
    generator = torch.Generator().manual_seed(1)
    frames: dict[str, NDArray[Any]] = {}
    model = FrameModel(clutter=replace(ClutterModel(), occluded=0.0))
    for c in range(scene.rig.num_cameras):
        truth = replace(scene.truth, rig=scene.truth.rig.select([c]), uv=scene.truth.uv[:, [c]])
        frames |= next(iter(simulate_frames(truth, scene.obj, model, generator)))
    return frames


def _size(rig: CameraRig) -> tuple[int, int]:
    return int(rig.image_size[0, 0]), int(rig.image_size[0, 1])


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def _power(rows: list[dict[str, Any]], stage: str) -> str:
    """Slope of the upper half of a curve in log-log scale."""
    points = np.log([(row["n"], row[stage]) for row in rows if row.get(stage) is not None])
    upper = points[len(points) // 2 :] if len(points) > 3 else points
    return f"{np.polyfit(upper[:, 0], upper[:, 1], 1)[0]:.2f}" if len(upper) > 1 else ""

"""From frames in memory to a calibrated rig, snapshot by snapshot, and how the cost grows."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import estimate
from imgcal.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from imgcal.io import load_object, read_rig
from imgcal.online import RigKeeper
from imgcal.synthesis import FrameModel, PhysicalDrift, Truth, simulate_frames, simulate_truth
from imgcal.types import CalibrationObject, CameraRig, Observations
from renderers import ClutterModel
from scripts.benchmarks import end_to_end_growth as growth
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peer import versions
from scripts.benchmarks.peers import opencv_live, scipy_rig
from scripts.benchmarks.peers.rig_task import RigAnswer, RigTask
from scripts.output import markdown
from scripts.timing import side_by_side, timing_of

RATE, LATER = 60.0, 1e6
"""Snapshots per second, and start time (s) of the endurance run, after all others."""
OURS, QUICK, EXACT = "imgcal", "OpenCV, 1 threshold", "OpenCV, 10 thresholds"
SCIPY = f"{EXACT}, then SciPy for the rig"
RADIUS = (6.0, 24.0)  # px, a generous range for markers of 6 mm
JUDGED = 20  # results per method whose accuracy is measured
NOISE = 0.05  # px, sigma of the centres that SciPy is given


@dataclass(frozen=True)
class Stream:
    """An object that moves smoothly forth and back in front of a drifted rig."""

    factory: CameraRig
    obj: CalibrationObject
    truth: Truth
    frames: list[dict[str, NDArray[np.uint8]]]
    unseen: Truth  # the same rig, other poses

    def order(self) -> Iterator[int]:
        """Yield the snapshots forwards and backwards, endlessly."""
        last = max(len(self.frames) - 1, 1)
        return (last - abs(last - s % (2 * last)) for s in count())


def measure(effort: Effort) -> dict[str, Any]:
    """Run the stream through imgcal and its peers, then measure the growth of the cost."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    stream = make_stream(effort.pick(20, 3))
    with ThreadPoolExecutor(os.cpu_count()) as pool, RigKeeper(stream.factory, stream.obj, horizon=1) as keeper:
        methods: dict[str, Callable[[int], Outcome]] = {
            OURS: Ours(stream, keeper).update,
            QUICK: Classical(stream, pool, 1, joint=False).update,
            EXACT: Classical(stream, pool, 10, joint=False).update,
            SCIPY: Classical(stream, pool, 10, joint=True).update,
        }
        compared = _compared(stream, methods, effort.pick(20.0, 1.0), effort.pick(JUDGED, 2))
        endurance = _endurance(stream, keeper, effort.pick(10_000, 30), effort.pick(1_000, 30))
    return {
        "cores": os.cpu_count(),
        "versions": versions("opencv-contrib-python-headless", "scipy"),
        "methods": compared,
        "endurance": endurance,
        "growth": growth.measure(effort),
    }


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables: from frames to a rig compared with peers, endurance, growth."""
    rows = [
        (
            f"**{name}**" if name == OURS else name,
            f"{row['ms']['p50']:.1f} / {row['ms']['p99']:.1f}",
            f"{row['ms']['p50'] / result['methods'][OURS]['ms']['p50']:.1f}",
            f"{row['rms_px']:.3g}",
            f"{row['re_px']:.3g}",
            f"{row['refused']}",
        )
        for name, row in result["methods"].items()
    ]
    head = ("frames to a rig", "ms p50 / p99", "times imgcal", "own RMS, px", "RE on other poses, px", "refused")
    lasting = result["endurance"]
    memory = [f"{value:.0f}" if value is not None else "unknown" for value in lasting["rss_mb"]]
    lines = [
        ("ms p50 / p99 of the first 1,000", f"{lasting['first']['p50']:.1f} / {lasting['first']['p99']:.1f}"),
        ("ms p50 / p99 of all", f"{lasting['all']['p50']:.1f} / {lasting['all']['p99']:.1f}"),
        ("refused", str(lasting["refused"])),
        (f"resident memory after every {lasting['every']:,}, MB", ", ".join(memory)),
    ]
    return {
        "end to end": markdown(head, rows),
        "endurance": markdown((f"{lasting['snapshots']:,} snapshots in a row", ""), lines),
    } | growth.tables(result["growth"])


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw the growth curves."""
    growth.draw(result["growth"], path)


def make_stream(snapshots: int) -> Stream:
    """Render ten frames of 2048 x 1088 per snapshot: markers of 6 mm, reflections, false blobs, noise, 8 bit."""
    rig, obj, generator = read_rig("O10"), load_object("asymmetric8"), torch.Generator().manual_seed(2)
    start = simulate_truth(rig, obj, 1 + JUDGED, generator, PhysicalDrift())
    pose, times = start.rig_from_object[0], torch.arange(snapshots, dtype=torch.float64)[:, None]
    turn = rotation_from_vector(times * torch.tensor([0.004, 0.006, -0.003], dtype=torch.float64))
    shift = times * torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64)
    poses = RigidTransform(turn @ pose.rotation, pose.translation + shift)
    truth = Truth(start.rig, poses, start.rig.expand(snapshots).project(poses.apply(obj.points)).uv)
    model = FrameModel(clutter=replace(ClutterModel(), occluded=0.0))
    frames: list[Any] = list(simulate_frames(truth, obj, model, generator))
    return Stream(rig, obj, truth, frames, Truth(start.rig, start.rig_from_object[1:], start.uv[1:]))


@dataclass(frozen=True)
class Outcome:
    """Result of a snapshot; None = refused."""

    rig: CameraRig | None
    rms: float = 0.0  # px, RMS length of its own residuals


@dataclass(frozen=True)
class Ours:
    """imgcal in steady state."""

    stream: Stream
    keeper: RigKeeper
    moments: Iterator[int] = field(default_factory=count)

    def update(self, snapshot: int) -> Outcome:
        state = self.keeper.update(self.stream.frames[snapshot], next(self.moments) / RATE)
        if state.refused is not None:
            return Outcome(None)
        return Outcome(state.rig, float(np.sqrt(2 * np.nanmean(np.square(state.residual)))))


class Classical:
    """The peers in steady state; they are given the labels of the first snapshot."""

    def __init__(self, stream: Stream, pool: ThreadPoolExecutor, thresholds: int, joint: bool) -> None:
        self.stream, self.pool, self.joint = stream, pool, joint
        self.points = stream.obj.points.numpy()
        self.finder = opencv_live.detector(RADIUS, thresholds)
        self.views = [_first_view(stream, camera) for camera in range(stream.factory.num_cameras)]

    def update(self, snapshot: int) -> Outcome:
        frames = list(self.stream.frames[snapshot].values())
        self.views, seen = opencv_live.update(frames, self.points, self.views, self.finder, self.pool)
        if self.joint:
            task = self._task(seen)
            answer = scipy_rig.solve(task)
            rig = _rig(answer, self.stream.factory)
            return Outcome(rig, 2**0.5 * misfit(rig, self.stream.obj, torch.from_numpy(task.uv), task.seen))
        squares = [
            ((view.project(self.points)[labels] - uv) ** 2).sum(1)
            for view, (labels, uv) in zip(self.views, seen, strict=True)
        ]
        rms = float(np.sqrt(np.concatenate(squares).mean()))
        return Outcome(_rig(opencv_live.answer(self.views), self.stream.factory), rms)

    def _task(self, seen: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]]) -> RigTask:
        """Formulate the rig's MAP problem, with the first camera's pose as the start."""
        rig, first = self.stream.factory, self.views[0]
        prior = rig.prior
        assert prior is not None
        rotation = rig.cam_from_rig.rotation.numpy()
        translation = rig.cam_from_rig.translation.numpy()
        uv = np.zeros((1, rig.num_cameras, len(self.points), 2))
        shown = np.zeros(uv.shape[:-1], dtype=bool)
        for c, (labels, places) in enumerate(seen):
            uv[0, c, labels], shown[0, c, labels] = places, True
        return RigTask(
            points=self.points,
            uv=uv,
            sigma=NOISE,
            focal_length=rig.focal_length.numpy(),
            principal_point=rig.principal_point.numpy(),
            distortion=rig.distortion.numpy(),
            rotation=rotation,
            translation=translation,
            start_rotation=(rotation[0].T @ cv2.Rodrigues(first.rotation)[0])[None],
            start_translation=(rotation[0].T @ (first.translation - translation[0]))[None],
            prior_std=prior.std(rig).numpy(),
            image_size=(int(rig.image_size[0, 0]), int(rig.image_size[0, 1])),
            seen=shown,
        )


def _first_view(stream: Stream, camera: int) -> opencv_live.View:
    """Factory intrinsics, and the pose that fits the first snapshot with them."""
    rig, points = stream.factory, stream.obj.points.numpy()
    matrix = np.diag([*rig.focal_length[camera].tolist(), 1.0])
    matrix[:2, 2] = rig.principal_point[camera].numpy()
    distortion = rig.distortion[camera].numpy().copy()
    pose = rig.cam_from_rig[camera] @ stream.truth.rig_from_object[0]
    start = opencv_live.View(
        matrix, distortion, vector_from_rotation(pose.rotation).numpy(), pose.translation.numpy().copy()
    )
    labels, uv = np.arange(len(points)), stream.truth.uv[0, camera].numpy()
    size = (int(rig.image_size[camera, 0]), int(rig.image_size[camera, 1]))
    return opencv_live.calibrated(labels, uv, points, start, size)


def _rig(answer: RigAnswer, like: CameraRig) -> CameraRig:
    return replace(
        like,
        focal_length=torch.from_numpy(answer.focal_length),
        principal_point=torch.from_numpy(answer.principal_point),
        distortion=torch.from_numpy(answer.distortion),
        cam_from_rig=RigidTransform(torch.from_numpy(answer.rotation), torch.from_numpy(answer.translation)),
    )


def misfit(rig: CameraRig, obj: CalibrationObject, uv: Tensor, seen: NDArray[np.bool_] | None = None) -> float:
    """RE (px) on image points (S, C, N, 2) with a fixed rig; only the object's poses are fitted."""
    shown = torch.ones(uv.shape[:-1], dtype=torch.bool) if seen is None else torch.from_numpy(seen)
    observations = Observations(uv, torch.full_like(uv[..., 0], NOISE), shown)
    held = torch.zeros(rig.num_cameras, 15, dtype=uv.dtype)
    return float(estimate(observations, rig, obj, prior_std=held).rms) / 2**0.5


def _compared(
    stream: Stream, methods: Mapping[str, Callable[[int], Outcome]], seconds: float, judged: int
) -> dict[str, Any]:
    """Score some results of each method, then time all methods in turn."""
    rows: dict[str, Any] = {}
    orders = {name: stream.order() for name in methods}
    for name, update in methods.items():
        found = [update(next(orders[name])) for _ in range(judged)]
        good = [one for one in found if one.rig is not None]
        errors = [misfit(one.rig, stream.obj, stream.unseen.uv) for one in good if one.rig is not None]
        rows[name] = {
            "refused": len(found) - len(good),
            "rms_px": float(np.mean([one.rms for one in good])) if good else float("nan"),
            "re_px": float(np.sqrt(np.mean(np.square(errors)))) if good else float("nan"),
        }
    calls = {name: lambda name=name: methods[name](next(orders[name])) for name in methods}
    for name, timing in side_by_side(calls, seconds).items():
        rows[name]["ms"] = timing.values()
    return rows


def _endurance(stream: Stream, keeper: RigKeeper, snapshots: int, every: int) -> dict[str, Any]:
    """Run many snapshots in a row, and record the memory from time to time."""
    order, seconds, memory, refused = stream.order(), [], [_resident()], 0
    for number in range(snapshots):
        frames = stream.frames[next(order)]
        begin = time.perf_counter()
        refused += keeper.update(frames, LATER + number / RATE).refused is not None
        seconds.append(time.perf_counter() - begin)
        if (number + 1) % every == 0:
            memory.append(_resident())
    return {
        "snapshots": snapshots,
        "every": every,
        "first": timing_of(seconds[:1000]).values(),
        "all": timing_of(seconds).values(),
        "refused": refused,
        "rss_mb": memory,
    }


def _resident() -> float | None:
    """Resident memory of this process, MB; None if the system does not report it."""
    path = Path("/proc/self/statm")
    return int(path.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6 if path.is_file() else None

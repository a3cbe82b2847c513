"""Which blob is which fiducial? Wrong and refused snapshots over clutter, occlusion and factory error."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import relocalize, track
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, read_rig
from imgcal.synthesis import RelativeDrift, synthesize
from imgcal.types import CalibrationObject, CameraRig, Detections
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peer import peer, versions
from scripts.benchmarks.peers import p3p_hungarian as p3p
from scripts.output import BLUE, GREEN, RED, figure, markdown

T = TypeVar("T")
Labels = NDArray[np.int64]
NOISE = 0.1  # px
LEAST_PEERS = 1  # least number of snapshots per case for the peers
LEAST_PRIOR = 0.01  # relative, least prior of a factory value, since zero would be unrealistic
OURS, EACH, VOTE, ABSENT = "imgcal", "P3P + Hungarian", "the same, rig votes", "absent"
OURS_KNOWN, NEAREST = "imgcal, pose known", "nearest projection + Hungarian"


@dataclass(frozen=True)
class Case:
    """Snapshots of O10, from all over the hemisphere."""

    name: str
    visible: int = 6  # visible fiducials in each camera, chosen at random
    false: int = 2  # false blobs in each camera
    near: bool = False  # false blobs lie in the pattern's bounding box enlarged by half, not in the whole image
    kappa: float = 0.05  # relative factory error of every value
    stated: float | None = None  # relative prior that imgcal is given, if different
    object_name: str = "asymmetric8"


CASES = (
    *(Case(f"6 visible, {n} false anywhere", false=n) for n in (0, 2, 4, 8)),
    *(Case(f"6 visible, {n} false near the pattern", false=n, near=True) for n in (2, 4, 8)),
    *(Case(f"{n} visible, 2 false anywhere", visible=n) for n in (8, 7, 5, 4)),
    *(Case(f"6 visible, 2 false, factory {100 * k:g} % off", kappa=k) for k in (0.0, 0.025, 0.075, 0.1)),
    Case("6 visible, 2 false, factory 10 % off, said to be 5 %", kappa=0.1, stated=0.05),
    Case("cube8, 6 visible, 2 false anywhere", object_name="cube8"),
    Case("cube8, 6 visible, 2 false near the pattern", object_name="cube8", near=True),
)
BASE = CASES[1]
SHOWN = {"wrong_percent": "snapshots wrong, %", "labelled_percent": "labelled, %"}
AXES = {  # of the plot: title, value on the axis, cases
    "false blobs a camera, anywhere": (lambda case: case.false, CASES[:4]),
    "false blobs a camera, near": (lambda case: case.false, (CASES[0], *CASES[4:7])),
    "visible fiducials": (lambda case: case.visible, (CASES[7], CASES[8], BASE, CASES[9], CASES[10])),
    "factory error, %": (lambda case: 100 * case.kappa, (CASES[11], CASES[12], BASE, CASES[13], CASES[14])),
}


@dataclass(frozen=True)
class Snapshot:
    """Blobs of one snapshot, and the ground truth."""

    blobs: Detections
    truth: Labels  # (M,) fiducial of each blob, -1 = false
    pose: RigidTransform  # rig_from_object


def measure(effort: Effort) -> dict[str, Any]:
    """Run all methods on the same snapshots, in turn."""
    torch.set_num_threads(1)
    snapshots, patience = effort.pick(150, 2), effort.pick(6.0, 0.1)
    cases = effort.pick(CASES, (BASE, CASES[-2]))
    rows = {case.name: _case(case, snapshots, patience) for case in cases}
    return {"versions": versions("poselib", "scipy"), "cases": rows}


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables: decisions and times of a cold start, and decisions with a known pose."""
    cold, known = (OURS, VOTE, EACH), (OURS_KNOWN, NEAREST)
    rows = result["cases"]
    decided = [(name, *(_decided(row, method) for method in cold)) for name, row in rows.items()]
    times = [(name, *(_time(row, method) for method in cold)) for name, row in rows.items()]
    tracked = [
        (name, *(f"{_decided(row, method)}, {_time(row, method)} ms" for method in known)) for name, row in rows.items()
    ]
    run = sorted({int(row[VOTE]["snapshots"]) for row in rows.values() if VOTE in row})
    peers = f"{run[0]} to {run[-1]} snapshots" if run else ABSENT
    ours = max(int(row[OURS]["snapshots"]) for row in rows.values())
    amounts = (f"{ours} snapshots a row", *[peers] * 2)
    return {
        "identity": markdown(("a camera sees", *cold), [("", *amounts), *decided]),
        "identity time": markdown(("a camera sees", *(f"{method}, ms p50 / p95" for method in cold)), times),
        "identity known pose": markdown(("a camera sees", *known), tracked),
    }


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw snapshots with a wrong label, and visible blobs with a label, over the difficulty."""
    rows = result["cases"]
    with figure(path, panels=len(AXES), rows=2, size=(11.0, 4.6)) as panels:
        for column, (title, (value, cases)) in enumerate(AXES.items()):
            for row, (key, label) in enumerate(SHOWN.items()):
                axes = panels[row * len(AXES) + column]
                for method, colour in ((OURS, BLUE), (VOTE, GREEN), (EACH, RED)):
                    points = [(value(c), rows[c.name][method][key]) for c in cases if method in rows.get(c.name, {})]
                    axes.plot(*zip(*points, strict=True), "o-", color=colour, markersize=3, label=method)
                axes.set_ylim(-4, 104)
                if row:
                    axes.set_xlabel(title)
                if not column:
                    axes.set_ylabel(label)
        panels[0].legend(fontsize=6)


def _decided(row: Mapping[str, Any], method: str) -> str:
    if method not in row:
        return ABSENT
    found = row[method]
    wrong = f"{found['wrong_percent']:.1f}"
    wrong = f"**{wrong}**" if method.startswith("imgcal") else wrong
    return f"{found['accepted_percent']:.0f} / {wrong} / {found['labelled_percent']:.1f}"


def _time(row: Mapping[str, Any], method: str) -> str:
    return " / ".join(_ms(row[method][key]) for key in ("ms_p50", "ms_p95")) if method in row else ABSENT


def _ms(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def _case(case: Case, snapshots: int, patience: float) -> dict[str, dict[str, float]]:
    """Run all methods on the same snapshots in turn; peers on as many as they can process in `patience` seconds."""
    rig, obj, made = snapshots_of(case, snapshots)
    expected = case.kappa if case.stated is None else case.stated
    std = RelativeDrift(*[max(expected, LEAST_PRIOR)] * 2).std(rig)
    peers = None if peer("poselib") is None else Peers(rig, obj)
    _ours(made[0], rig, obj, std)  # compile
    counts: dict[str, Count] = {}
    for number, snapshot in enumerate(made):
        found = _ours(snapshot, rig, obj, std)
        if peers is not None and (number < LEAST_PEERS or peers.spent < patience):
            found |= peers.decide(snapshot)
        for name, (labels, seconds) in found.items():
            counts.setdefault(name, Count()).add(seconds, labels, snapshot.truth, obj)
    return {name: count.summary() for name, count in counts.items()}


def _timed(run: Callable[[], T]) -> tuple[T, float]:
    begin = time.perf_counter()
    return run(), time.perf_counter() - begin


def _ours(one: Snapshot, rig: CameraRig, obj: CalibrationObject, std: Tensor) -> dict[str, tuple[Labels, float]]:
    return {
        OURS: _timed(lambda: relocalize(one.blobs, rig, obj, std).labels),
        OURS_KNOWN: _timed(lambda: track(one.blobs, rig, obj, std, one.pose).labels),
    }


@dataclass
class Peers:
    """Typical self-written solutions."""

    rig: CameraRig
    obj: CalibrationObject
    spent: float = 0.0  # s

    def decide(self, one: Snapshot) -> dict[str, tuple[Labels, float]]:
        """Return labels and times; both variants with P3P share their results per camera."""
        cameras, points = pinholes(self.rig), self.obj.points.numpy()
        uv = [one.blobs.uv[one.blobs.camera == c] for c in range(len(cameras))]
        count = [len(places) for places in uv]
        pose = (one.pose.rotation.numpy(), one.pose.translation.numpy())
        symmetries = [(motion.rotation, motion.permutation) for motion in self.obj.symmetries]
        seen = list(zip(uv, cameras, strict=True))
        generator = np.random.default_rng(0)
        answers, found = _timed(lambda: [p3p.one_camera(at, points, camera, generator) for at, camera in seen])
        each, chosen = _timed(lambda: p3p.each_camera(answers, count))
        vote, voted = _timed(lambda: p3p.by_vote(answers, count, cameras, symmetries))
        near, placed = _timed(lambda: [p3p.known_pose(at, points, camera, pose) for at, camera in seen])
        self.spent += found + chosen + voted + placed
        return {
            EACH: (np.concatenate(each), found + chosen),
            VOTE: (np.concatenate(vote), found + voted),
            NEAREST: (np.concatenate(near), placed),
        }


def snapshots_of(case: Case, count: int, seed: int = 0) -> tuple[CameraRig, CalibrationObject, list[Snapshot]]:
    """Make the factory rig, the object, and snapshots, each by another drifted rig."""
    rig, obj = read_rig("O10"), load_object(case.object_name)
    made = synthesize(rig, obj, count, torch.Generator().manual_seed(seed), drift=RelativeDrift(case.kappa, case.kappa))
    generator = np.random.default_rng(seed)
    shown = [_blobs(uv, rig, case, generator) for uv in made.projection.uv.numpy()]
    return rig, obj, [Snapshot(*pair, made.rig_from_object[s]) for s, pair in enumerate(shown)]


def _blobs(
    uv: NDArray[np.float64], rig: CameraRig, case: Case, generator: np.random.Generator
) -> tuple[Detections, Labels]:
    """Make the blobs of one snapshot from projections (C, N, 2), in random order, and the fiducial of each."""
    places, labels = [], []
    for projected, size in zip(uv, rig.image_size.numpy(), strict=True):
        seen = generator.permutation(len(projected))[: case.visible]
        low, high = np.zeros(2), size - 1.0
        if case.near:
            middle, half = (projected.min(0) + projected.max(0)) / 2, 0.75 * np.ptp(projected, axis=0)
            low, high = np.maximum(low, middle - half), np.minimum(high, middle + half)
        blobs = projected[seen] + NOISE * generator.standard_normal((case.visible, 2))
        order = generator.permutation(case.visible + case.false)
        places.append(np.concatenate((blobs, generator.uniform(low, high, (case.false, 2))))[order])
        labels.append(np.concatenate((seen, np.full(case.false, -1)))[order])
    count = rig.num_cameras * (case.visible + case.false)
    detections = Detections(
        uv=np.concatenate(places),
        sigma=np.full(count, NOISE),
        camera=np.repeat(np.arange(rig.num_cameras), case.visible + case.false),
        snapshot=np.zeros(count, dtype=np.int64),
        fiducial=np.full(count, -1),
        radius=np.full(count, np.nan),
        flags=np.zeros(count, dtype=np.uint8),
        camera_names=rig.camera_names,
        snapshot_names=("0",),
    )
    return detections, np.concatenate(labels)


def pinholes(rig: CameraRig) -> list[p3p.Pinhole]:
    """Convert cameras to OpenCV's parameters."""
    cameras = []
    for c in range(rig.num_cameras):
        matrix = np.diag([*rig.focal_length[c].tolist(), 1.0])
        matrix[:2, 2] = rig.principal_point[c].numpy()
        pose = rig.cam_from_rig[c]
        cameras.append(p3p.Pinhole(matrix, rig.distortion[c].numpy(), pose.rotation.numpy(), pose.translation.numpy()))
    return cameras


@dataclass
class Count:
    """Decisions of one method so far."""

    snapshots: int = 0
    accepted: int = 0
    wrong: int = 0  # accepted snapshots with a wrong label
    wrong_labels: int = 0
    right_labels: int = 0
    visible: int = 0

    def __post_init__(self) -> None:
        self.seconds: list[float] = []

    def add(self, seconds: float, labels: Labels, truth: Labels, obj: CalibrationObject) -> None:
        """Score labels under the symmetry that fits them best, the same for all cameras."""
        named = labels >= 0
        moved = [np.append(motion.permutation, -1)[truth] for motion in obj.symmetries]
        right = max(int((named & (expected == labels)).sum()) for expected in moved)
        self.seconds.append(seconds)
        self.snapshots += 1
        self.accepted += bool(named.any())
        self.wrong += int(named.sum()) > right
        self.wrong_labels += int(named.sum()) - right
        self.right_labels += right
        self.visible += int((truth >= 0).sum())

    def summary(self) -> dict[str, float]:
        """Percentages of all snapshots, and of all visible blobs."""
        p50, p95 = np.percentile(1e3 * np.array(self.seconds), (50, 95))
        return {
            "snapshots": self.snapshots,
            "accepted_percent": 100 * self.accepted / self.snapshots,
            "wrong_percent": 100 * self.wrong / self.snapshots,
            "wrong_labels": self.wrong_labels,
            "labelled_percent": 100 * self.right_labels / max(self.visible, 1),
            "ms_p50": float(p50),
            "ms_p95": float(p95),
        }

"""Methods of the recalibration benchmark, behind one interface."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import cv2
import numpy as np

from imgcal.estimation import estimate
from scripts.benchmarks.peer import debian_mrcal, peer
from scripts.benchmarks.peers import colmap_rig, opencv_rig, scipy_rig
from scripts.benchmarks.peers.mrcal_rig import Mrcal
from scripts.benchmarks.peers.rig_task import RigAnswer, RigTask
from scripts.benchmarks.recalibration_cases import SQUARED, Cases

HELD = ", distortion held"
IMGCAL, COLD = "imgcal", "imgcal, no start pose"
CERES, SCIPY, COLMAP, MRCAL, OPENCV = (
    "pyceres, COLMAP's costs and the prior",
    "scipy least_squares, same cost",
    "pycolmap rig adjustment",
    "mrcal",
    "OpenCV calibrateCamera",
)
WITH_PRIOR = (IMGCAL, COLD, CERES, SCIPY)
EVERY = (*WITH_PRIOR, COLMAP, COLMAP + HELD, MRCAL, MRCAL + HELD, OPENCV, OPENCV + HELD)
FREE = tuple(name for name in EVERY if HELD not in name)


class Method(Protocol):
    """Solves tasks on demand and keeps the last answer of each; mrcal's can be read only after the `with` block."""

    def solve(self, index: int) -> float:
        """Solve one task; return the seconds that it took; nan = the solver gave up."""

    def answers(self) -> list[RigAnswer]:
        """Return one answer for each task; the factory values for unsolved tasks."""


class InProcess:
    """A method that is a function of a task's index."""

    def __init__(self, tasks: Sequence[RigTask], solve: Callable[[int], RigAnswer]) -> None:
        self._solve = solve
        self._answers = [factory_answer(task) for task in tasks]

    def solve(self, index: int) -> float:
        """Solve one task."""
        try:
            self._answers[index] = self._solve(index)
        except (cv2.error, ValueError, np.linalg.LinAlgError):
            return float("nan")
        return self._answers[index].seconds

    def answers(self) -> list[RigAnswer]:
        """Return the answers."""
        return self._answers


def factory_answer(task: RigTask) -> RigAnswer:
    """Return the factory values."""
    values = (task.focal_length, task.principal_point, task.distortion, task.rotation, task.translation)
    return RigAnswer(*values, float("nan"))


def by_imgcal(cases: Cases, index: int, start: bool = True) -> RigAnswer:
    """Run `imgcal.estimate` on one case."""
    observations, factory = cases.one(index), cases.factory[index]
    poses = cases.start[index] if start else None
    begin = time.perf_counter()
    rig = estimate(observations, factory, cases.obj, poses, prior_std=cases.prior_std, options=SQUARED).rig
    seconds = time.perf_counter() - begin
    intrinsics = (rig.focal_length.numpy(), rig.principal_point.numpy(), rig.distortion.numpy())
    return RigAnswer(*intrinsics, rig.cam_from_rig.rotation.numpy(), rig.cam_from_rig.translation.numpy(), seconds)


@contextmanager
def methods(cases: Cases, names: Sequence[str]) -> Iterator[dict[str, Method]]:
    """Prepare those of `names` that are installed."""
    tasks = [cases.task(index) for index in range(len(cases))]
    solvers: dict[str, Callable[[int], RigAnswer]] = {
        IMGCAL: partial(by_imgcal, cases),
        COLD: partial(by_imgcal, cases, start=False),
        SCIPY: lambda i: scipy_rig.solve(tasks[i]),
        OPENCV: lambda i: opencv_rig.solve(tasks[i]),
        OPENCV + HELD: lambda i: opencv_rig.solve(tasks[i], distortion=False),
    }
    if peer("pycolmap") and peer("pyceres"):
        solvers |= {
            CERES: lambda i: colmap_rig.solve(tasks[i], prior=True),
            COLMAP: lambda i: colmap_rig.solve(tasks[i], prior=False),
            COLMAP + HELD: lambda i: colmap_rig.solve(tasks[i], prior=False, distortion=False),
        }
    with ExitStack() as stack:
        found: dict[str, Method] = {}
        for name in names:
            if name in solvers:
                found[name] = InProcess(tasks, solvers[name])
            elif name.startswith(MRCAL) and debian_mrcal():
                folder = Path(stack.enter_context(TemporaryDirectory()))
                found[name] = stack.enter_context(Mrcal(tasks, folder, distortion=HELD not in name))
        yield found

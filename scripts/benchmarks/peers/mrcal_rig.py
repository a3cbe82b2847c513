"""mrcal, in a process with Debian's Python that waits for tasks, so that it can be timed in turn with the others.

mrcal supports fixed points, but not a moving rig: each camera has a separate pose in each snapshot, and only the
intrinsics are shared. With one snapshot this is the same problem; with more, the extrinsics are averaged afterwards.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from scripts.benchmarks.peer import DEBIAN_PYTHON
from scripts.benchmarks.peers.rig_task import (
    Array,
    RigAnswer,
    RigTask,
    mean_extrinsics,
    rotation_matrices,
    rotation_vectors,
)

WORKER = Path(__file__).with_name("mrcal_worker.py")


class Mrcal:
    """Tasks of one size, solved on demand; answers can be read after the `with` block."""

    def __init__(self, tasks: Sequence[RigTask], folder: Path, *, distortion: bool = True) -> None:
        self._path = folder / "answers.npz"
        given = folder / "tasks.npz"
        lens = [np.hstack((task.focal_length, task.principal_point, task.distortion)) for task in tasks]
        np.savez(
            given,
            uv=np.array([task.uv for task in tasks]),
            points=tasks[0].points,
            image_size=np.array(tasks[0].image_size),
            intrinsics=np.array(lens),
            extrinsics=np.array([_extrinsics(task) for task in tasks]),
            distortion=distortion,
        )
        self._found: tuple[Array, ...] = ()
        self._seconds = dict.fromkeys(range(len(tasks)), np.nan)
        command = [DEBIAN_PYTHON, "-I", str(WORKER), str(given), str(self._path)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def solve(self, index: int) -> float:
        """Solve one task; return the seconds that mrcal took."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(index, file=self._process.stdin, flush=True)
        self._seconds[index] = float(self._process.stdout.readline())
        return self._seconds[index]

    def __enter__(self) -> Mrcal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()
        if error is None:
            with np.load(self._path) as found:
                self._found = (found["intrinsics"], found["extrinsics"])

    def answers(self) -> list[RigAnswer]:
        """Return one answer for each task; the factory values for unsolved tasks."""
        answers = []
        for index, (lens, poses) in enumerate(zip(*self._found, strict=True)):
            rig = mean_extrinsics(rotation_matrices(poses[..., :3]), 1000 * poses[..., 3:])
            answers.append(RigAnswer(lens[:, :2], lens[:, 2:4], lens[:, 4:], *rig, self._seconds[index]))
        return answers


def _extrinsics(task: RigTask) -> Array:
    """cam_from_object of the start: (S, C, 6) rotation vector and translation (m)."""
    rotation = task.rotation @ task.start_rotation[:, None]
    shift = (task.rotation @ task.start_translation[:, None, :, None])[..., 0] + task.translation
    return np.concatenate((rotation_vectors(rotation), shift / 1000), axis=-1)

"""Adapt the network of a running rig to its own frames, in a process beside the loop.

The loop offers snapshots. Those that are chosen go to one process of low priority, which labels them, trains, compares
the adapted network with the running one, and answers with a sentence. One snapshot is under way at a time, and none
during a training, so nothing queues up and the loop never waits.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import struct
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import imgcal
from imgcal.association import Proposer
from imgcal.detection import DetectionOptions, Frame
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.matching import MatchedFilter
from imgcal.messages import plural
from imgcal.online import RigState
from imgcal.pipeline import load_proposer
from imgcal.types import CalibrationObject, CameraRig, Detections

SUBJECTS = ("ir-cnn", "measurer-cnn")
"""The networks that are adapted together: one finds the markers, the other measures their centres."""
LEARNING, DATASET, ADAPTED, CANDIDATE, ADAPTED_CARD = "learning", "dataset", "adapted", "candidate", "README.md"
TURN = 5
"""Number of stretches of time in a row of which the last is held out."""
APART = 0.1
"""RMS motion of the object's points between two kept snapshots, in radii of the object, at least."""
LARGEST_LAG = 0.5
"""Pixels: a camera that exposes so late shows the object elsewhere than its projection."""
CLEAR_HEALTH = frozenset({"ok", "dirty", "defocused"})
"""Health of cameras whose projections hold, however bad the images are."""
LOWEST = 19
"""Priority of the process: how much rather anything else runs."""
LONGEST_END = 30.0
"""Seconds that the process has to write the dataset and end in."""


@dataclass(frozen=True)
class LearningPlan:
    """How many snapshots are kept, and when they suffice."""

    every: float = 1.0  # s between two snapshots
    stretch: float = 10.0  # s: of five stretches in a row, the last is held out
    gap: float = 1.0  # s beside a held-out stretch that are left out
    least_frames: int = 30  # frames of single cameras, for a training
    most: int = 160  # snapshots to train on
    least_held_out: int = 8  # snapshots, for a comparison
    most_held_out: int = 20
    changes: tuple[str, ...] = ()  # to both experiments, as for `imgcal train --set`

    def is_held_out(self, time: float) -> bool | None:
        """Tell to which part a moment (s) belongs; None = to neither, because it is a neighbour of both.

        Examples:
            >>> [LearningPlan().is_held_out(time) for time in (5.0, 38.0, 39.5, 45.0, 50.5, 51.5)]
            [False, False, None, True, None, False]
        """
        if self._in_held_out_stretch(time):
            return True
        beside = self._in_held_out_stretch(time - self.gap) or self._in_held_out_stretch(time + self.gap)
        return None if beside else False

    def _in_held_out_stretch(self, time: float) -> bool:
        return time // self.stretch % TURN == TURN - 1


@dataclass(frozen=True)
class Moment:
    """A snapshot to learn from, or to compare networks on."""

    number: int
    held_out: bool
    frames: Mapping[str, Frame | None]
    blobs: Detections  # of this snapshot, labelled, cameras as in the rig
    rig: CameraRig  # as it was known then
    rig_from_object: RigidTransform  # ()
    displaced: int | None  # number of the kept snapshot whose place it takes


@dataclass(frozen=True)
class LearningTask:
    """What the process needs to know at its start."""

    folder: Path
    obj: CalibrationObject
    detection: DetectionOptions
    plan: LearningPlan
    running: tuple[str, str]  # files, folders or shipped names of the networks that run: see `SUBJECTS`


@dataclass(frozen=True)
class Outcome:
    """What came of a training, or why there will be no more."""

    message: str
    adopted: bool = False
    failed: bool = False
    proposer: Proposer | None = None  # to run from now on


class Spread:
    """Keeps a bounded number of snapshots whose object poses are far from each other.

    Examples:
        >>> spread = Spread(2, least=1.0)
        >>> [spread.add(number, np.array([place])) for number, place in enumerate((0.0, 0.5, 2.0, 9.0, 9.5))]
        [(True, None), (False, None), (True, None), (True, 0), (False, None)]
    """

    def __init__(self, most: int, least: float) -> None:
        """Keep at most `most`, at least `least` apart."""
        self._most, self._least = most, least
        self._kept: dict[int, NDArray[np.float64]] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def nearest(self, place: NDArray[np.float64]) -> float:
        """Distance to the nearest kept snapshot."""
        return min((float(np.linalg.norm(place - other)) for other in self._kept.values()), default=np.inf)

    def add(self, number: int, place: NDArray[np.float64]) -> tuple[bool, int | None]:
        """Keep a snapshot if it widens the spread; also name the one that it displaces."""
        away = self.nearest(place)
        if away < self._least:
            return False, None
        if len(self._kept) < self._most:
            self._kept[number] = place
            return True, None
        numbers, places = list(self._kept), np.stack(list(self._kept.values()))
        apart = np.linalg.norm(places[:, None] - places, axis=-1)
        np.fill_diagonal(apart, np.inf)
        if away <= apart.min():
            return False, None
        oldest = numbers[int(apart.min(1).argmin())]
        del self._kept[oldest]
        self._kept[number] = place
        return True, oldest


class Learning:
    """Chooses snapshots for a process that adapts networks. A context manager: leaving it ends the process."""

    def __init__(self, task: LearningTask, code: str) -> None:
        """Prepare; nothing is started or written before it is entered.

        Args:
            task: what to learn.
            code: the Python statements of the process.
        """
        self.task = task
        self.kept = self.trainings = self.adopted = 0
        """Snapshots taken by the process so far; comparisons of networks; adapted networks that were better."""
        self._code = code
        plan, size = task.plan, task.obj.size
        self._train, self._held_out = (Spread(most, APART * size) for most in (plan.most, plan.most_held_out))
        self._number = 0
        self._last: float | None = None  # s, time of the last snapshot that was sent
        self._waiting: Moment | None = None
        self._busy, self._started = True, False
        self._outcomes: list[Outcome] = []
        self._changed = threading.Condition()
        self._closing = False
        self._writing = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def summary(self) -> str:
        """What was learned, in a few words."""
        why = "" if self.kept else " (none qualified, or the source ended before the learning process was ready)"
        trained = f"{plural(self.trainings, 'training')}, {self.adopted} adopted"
        return f"learning: {plural(self.kept, 'snapshot')}{why}, {trained}"

    @property
    def process_id(self) -> int:
        """Number of the process."""
        assert self._process is not None
        return self._process.pid

    def __enter__(self) -> Learning:
        """Start the process."""
        # Not from the current folder, which anybody may have filled.
        path = os.pathsep.join(filter(None, (str(Path(imgcal.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", self._code],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0,
            env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
            # An interruption of the loop is not its own. In a session of its own, Linux would not compare priorities.
            process_group=None if sys.platform == "win32" else 0,
            creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0),
        )  # fmt: skip
        if hasattr(os, "setpriority"):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, LOWEST)
        self._thread = threading.Thread(target=self._work, name="learning", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """End the process, and a training with it."""
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._writing.acquire(timeout=LONGEST_END):  # a message that is being written goes first
            self._writing.release()
        with contextlib.suppress(OSError):
            process.stdin.close()  # the process ends with it
        if not self._started:  # it still imports libraries: nothing to wait for
            process.kill()
        try:
            process.wait(LONGEST_END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._thread.join(LONGEST_END)
        process.stdout.close()

    def offer(self, state: RigState, frames: Mapping[str, Frame | None]) -> None:
        """Take a snapshot if it is worth learning from; returns at once.

        Args:
            state: after the snapshot.
            frames: by camera, not to be changed from now on.
        """
        plan, pose = self.task.plan, state.rig_from_object
        if self._busy or state.refused is not None or pose is None:
            return
        held_out = plan.is_held_out(state.time)
        if held_out is None or (self._last is not None and abs(state.time - self._last) < plan.every):
            return
        clear = _clear_frames(state, frames)
        if not any(frame is not None for frame in clear.values()):
            return
        place = _place(self.task.obj, pose)
        own, other = (self._held_out, self._train) if held_out else (self._train, self._held_out)
        if other.nearest(place) < APART * self.task.obj.size:
            return
        added, displaced = own.add(self._number, place)
        if not added:
            return
        self._last, self._busy = state.time, True
        blobs = state.detections.select(~np.isin(state.detections.camera, _cameras_without_clear_frame(state, clear)))
        with self._changed:
            self._waiting = Moment(self._number, held_out, clear, blobs, state.rig, pose, displaced)
            self._changed.notify()
        self._number += 1

    def outcomes(self) -> list[Outcome]:
        """What has come of trainings since the last call; returns at once."""
        with self._changed:
            found, self._outcomes = self._outcomes, []
        return found

    def _work(self) -> None:
        """Exchange messages with the process until either ends."""
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        try:
            self._send(process.stdin, self.task)
            while True:
                self._answer(process.stdout)
                with self._changed:
                    self._busy, self._started = False, True
                    self._changed.wait_for(lambda: self._waiting is not None or self._closing)
                    moment, self._waiting = self._waiting, None
                if self._closing or moment is None:
                    return
                self._send(process.stdin, moment)
        except InputError as error:  # the adapted networks cannot be read
            self._add_outcome(Outcome(f"learning has ended: {error}", failed=True))
        except (OSError, EOFError, ValueError):  # the process has ended, or is being ended
            if not self._closing:
                self._add_outcome(Outcome("learning has ended: its process ended unexpectedly", failed=True))

    def _answer(self, stream: Any) -> None:
        """Receive what the process says until it is ready for another snapshot."""
        while (said := receive(stream)) is not None:
            if isinstance(said, int):
                self.kept += said
                continue
            if said.adopted:
                self.adopted += 1
                networks = adapted_networks(self.task.folder)
                said = replace(said, proposer=None if networks is None else run_networks(networks))
            self.trainings += not said.failed
            self._add_outcome(said)

    def _send(self, stream: Any, message: Any) -> None:
        with self._writing:
            send(stream, message)

    def _add_outcome(self, outcome: Outcome) -> None:
        with self._changed:
            self._outcomes.append(outcome)


def adapted_networks(folder: Path) -> tuple[str, str] | None:
    """Folders of the networks that an earlier run in `folder` has adapted; None = there are none."""
    made = folder / LEARNING / ADAPTED
    if not (made / ADAPTED_CARD).is_file():
        return None
    network, measurer = (str(made / name) if (made / name).is_dir() else name for name in SUBJECTS)
    return network, measurer


def run_networks(networks: tuple[str, str]) -> Proposer:
    """Load networks for the loop, with the matched filter where they know no pose."""
    return load_proposer(networks[0], networks[1], MatchedFilter())


def send(stream: Any, message: Any) -> None:
    """Write a message; frames are not copied."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(message, protocol=5, buffer_callback=buffers.append)
    parts = [memoryview(head), *(buffer.raw() for buffer in buffers)]
    stream.write(struct.pack(f"<I{len(parts)}Q", len(parts), *(part.nbytes for part in parts)))
    for part in parts:
        sent = 0
        while sent < part.nbytes:  # a pipe takes as much as it has room for
            sent += stream.write(part[sent:]) or 0
    stream.flush()


def receive(stream: Any) -> Any:
    """Read a message that `send` wrote.

    Raises:
        EOFError: the other side has ended.
    """
    (count,) = struct.unpack("<I", _read(stream, 4))
    sizes = struct.unpack(f"<{count}Q", _read(stream, 8 * count))
    head, *buffers = (_read(stream, size) for size in sizes)
    return pickle.loads(head, buffers=buffers)


def _read(stream: Any, size: int) -> bytearray:
    found = bytearray(size)
    view, filled = memoryview(found), 0
    while filled < size:
        got = stream.readinto(view[filled:])
        if not got:
            raise EOFError
        filled += got
    return found


def _place(obj: CalibrationObject, pose: RigidTransform) -> NDArray[np.float64]:
    """Coordinates whose distance is the RMS motion (mm) of points around the object's middle, at its radius."""
    middle = obj.points.mean(0).to(pose.translation)
    corners = middle + obj.size * torch.cat((torch.eye(3), -torch.eye(3))).to(middle)
    return pose.apply(corners).numpy().ravel() / np.sqrt(len(corners))


def _clear_frames(state: RigState, frames: Mapping[str, Frame | None]) -> dict[str, Frame | None]:
    """Frames of the cameras that see the object where the rig has it."""
    late = np.zeros(len(state.factory.camera_names), dtype=bool)
    off = np.linalg.norm(np.nan_to_num(state.lag, nan=np.inf), axis=1) > LARGEST_LAG
    late[state.detections.camera[off]] = True
    return {
        name: frames.get(name) if state.cameras[name] in CLEAR_HEALTH and not late[camera] else None
        for camera, name in enumerate(state.factory.camera_names)
    }


def _cameras_without_clear_frame(state: RigState, clear: Mapping[str, Frame | None]) -> list[int]:
    """Numbers of the cameras without a clear frame."""
    return [camera for camera, name in enumerate(state.factory.camera_names) if clear[name] is None]

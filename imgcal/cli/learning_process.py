"""The process beside `imgcal watch --learn`: it keeps crops of the snapshots that it is sent, trains, and compares.

It ends with the pipe that feeds it, however the watching process ends, and takes an unfinished training with it.
"""

from __future__ import annotations

import os
import queue
import shutil
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from imgcal.association import PipelineOptions, Proposer, Snapshot, judge, to_observations
from imgcal.cli.harvest import Source, write_dataset
from imgcal.cli.training_folder import train_in
from imgcal.errors import InputError, RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import publishing, write_text
from imgcal.pipeline import load_proposer
from imgcal.training import (
    TRAIN_PATCHES,
    FrameDataset,
    PatchDataset,
    adaptation,
    cut_labelled,
    find_shown,
    is_finished,
    load_experiment,
)
from imgcal.types import RigPrior
from imgcal.watch import (
    ADAPTED,
    ADAPTED_CARD,
    CANDIDATE,
    DATASET,
    LEARNING,
    SUBJECTS,
    LearningTask,
    Moment,
    Outcome,
    adapted_networks,
    receive,
    send,
)

GRACE = 6.0  # s in which a training has to stop after the watching process has ended
NEAR = 5.0  # px within which a claim is right
TURNED_DEG, ASIDE = 1.0, 0.01  # errors of the pose that networks are given: degrees, and parts of the distance
SIGMAS = 2.0  # by which an adapted network must be better
LATEST = 3  # it must not be worse on the latest of the held-out snapshots either, one in three
LESS_EXACT, EXACT = 1.25, 0.3  # largest ratio of its error to the other's, unless it is below EXACT (px)
GROWTH = 1.5  # times the snapshots that had been taken at the last training, until the next

CARD = """# Networks adapted to a rig

Adapted by `imgcal watch --learn` to rig {rig} and object {object}, on {crops} crops of {snapshots} snapshots
(`{dataset}`), from the shipped networks {names}.

Measured on {moments} held-out snapshots of this rig, never neighbours in time of those trained on; the believed pose is
1 degree and 1 % of the distance off. Right: within 5 px, of the markers that the frames show. Wrong: of the claims; a
claim near a hidden marker counts as neither. Off: RMS distance of the right ones from the rig's projections. Decided:
snapshots whose claims identification accepts.

| | right % | wrong % | off, px | decided |
|---|---|---|---|---|
| before | {before} |
| adapted | {after} |

To use them: `imgcal calibrate CAPTURE --detector {network} --measurer {measurer} ...`.
"""


@dataclass(frozen=True)
class Scores:
    """What networks make of M held-out snapshots."""

    shown: NDArray[np.int64]  # (M,) markers
    right: NDArray[np.int64]  # (M,) of these
    claimed: NDArray[np.int64]  # (M,) without claims near hidden markers
    squared: NDArray[np.float64]  # (M,) px^2, summed squared distances of the right ones from their projections
    decided: NDArray[np.bool_]  # (M,) identification accepts the claims

    @property
    def quality(self) -> NDArray[np.float64]:
        """Right less wrong, as a share of the markers shown: (M,)."""
        return (2 * self.right - self.claimed) / np.maximum(self.shown, 1)

    def shares(self) -> tuple[float, float]:
        """Right % of the markers shown, wrong % of the claims."""
        right, claimed = int(self.right.sum()), int(self.claimed.sum())
        return 100 * right / max(int(self.shown.sum()), 1), 100 * (claimed - right) / max(claimed, 1)

    @property
    def off(self) -> float:
        """RMS distance of the right ones from their projections, px."""
        return float(np.sqrt(self.squared.sum() / max(self.right.sum(), 1)))

    def row(self) -> str:
        """Cells of a table."""
        right, wrong = self.shares()
        return f"{right:.1f} | {wrong:.1f} | {self.off:.2f} | {int(self.decided.sum())} of {len(self.decided)}"

    def is_better(self, other: Scores) -> bool:
        """Tell whether this is better than `other` on the same snapshots by more than its uncertainty.

        It must be more often right and as exact, or as often right and more exact. The light may have changed since
        most snapshots were kept, so it must not be worse on the latest, either.

        Examples:
            >>> scores = lambda right: Scores(*(np.full(4, n) for n in (8, right, 8, 0.1)), np.full(4, True))
            >>> scores(8).is_better(scores(7)), scores(8).is_better(scores(8))
            (True, False)
        """
        gain = self.quality - other.quality
        latest = gain[-max(len(gain) // LATEST, 1) :]
        if latest.mean() < 0 or self.decided.sum() < other.decided.sum():
            return False
        exact = self.off < EXACT or not other.right.any() or self.off < LESS_EXACT * other.off
        closer = LESS_EXACT * max(self.off, EXACT) < other.off and _is_positive(self._log_ratio(other))
        return bool((_is_positive(gain) and exact) or (gain.mean() >= 0 and closer))

    def _log_ratio(self, other: Scores) -> NDArray[np.float64]:
        """Log of how many times nearer this is than `other`, in each snapshot in which both are right somewhere."""
        both = (self.right > 0) & (other.right > 0)
        mine, others = (np.maximum(np.sqrt(each.squared[both] / each.right[both]), EXACT) for each in (self, other))
        return np.log(others / mine)


def _is_positive(values: NDArray[np.float64]) -> bool:
    """Tell whether the mean of values exceeds zero by more than its uncertainty."""
    return len(values) > 1 and bool(values.mean() > SIGMAS * values.std(ddof=1) / np.sqrt(len(values)))


class Learner:
    """Keeps crops of snapshots, and adapts networks when there are enough."""

    def __init__(self, task: LearningTask, tell: Callable[[Any], None], ended: threading.Event) -> None:
        """Start with nothing kept.

        Args:
            task: what to learn.
            tell: gets the outcomes, and the number of snapshots taken.
            ended: ends a training when set.
        """
        self.task, self._tell, self._ended = task, tell, ended
        self.folder = task.folder / LEARNING
        self._running = task.running
        self._crops: dict[int, FrameDataset] = {}
        self._patches: dict[int, PatchDataset] = {}
        self._held_out: dict[int, Moment] = {}  # with packed frames
        self._latest: Moment | None = None
        self._unwritten = False
        self.writing = threading.Lock()  # held while files are written that the user may look at
        self._taken = self._next = 0  # snapshots to train on that were taken; how many for the next training

    @property
    def _train(self) -> list[int]:
        return [number for number in self._crops if number not in self._held_out]

    @property
    def _frames(self) -> int:
        """Number of frames to train on."""
        return sum(len(self._crops[number].camera.unique()) for number in self._train)

    def take(self, moment: Moment) -> None:
        """Cut crops out of a snapshot; train if there are enough."""
        if moment.displaced is not None:
            for kept in (self._crops, self._patches, self._held_out):
                kept.pop(moment.displaced, None)
        try:
            crops, patches = cut_labelled(
                lambda _: moment.frames, moment.blobs, moment.rig, self.task.obj,
                detection=self.task.detection, seed=moment.number,
            )  # fmt: skip
        except RefusedError:
            return
        if not len(crops):
            return
        self._crops[moment.number] = replace(crops, snapshot=torch.full_like(crops.snapshot, moment.number))
        self._patches[moment.number] = replace(patches, snapshot=torch.full_like(patches.snapshot, moment.number))
        self._latest, self._unwritten = moment, True
        if moment.held_out:
            self._held_out[moment.number] = replace(moment, frames=_pack(moment.frames))
        self._taken += not moment.held_out
        self._tell(1)
        if self._has_enough():
            self._next = int(np.ceil(GROWTH * self._taken))
            self._adapt()

    def _has_enough(self) -> bool:
        plan = self.task.plan
        enough = self._frames >= plan.least_frames and len(self._held_out) >= plan.least_held_out
        return enough and self._taken >= self._next

    def write(self) -> None:
        """Write the dataset, if it has both parts and has changed."""
        train = self._train
        if not (self._unwritten and train and self._held_out):
            return
        assert self._latest is not None
        numbers = (train, list(self._held_out))
        splits = [FrameDataset.cat([self._crops[number] for number in part]) for part in numbers]
        patches = [PatchDataset.cat([self._patches[number] for number in part]) for part in numbers]
        said = ("imgcal watch --learn", "a running rig", len(self._crops), 0)
        source = Source(*said, self._latest.rig, self.task.obj)
        known = patches if all(len(part) for part in patches) else []
        with self.writing:
            write_dataset(self.folder / DATASET, splits, known, source)
        self._unwritten = False

    def _adapt(self) -> None:
        """Train, compare, and keep what is better."""
        try:
            self.write()
            self._tell(self._compare(self._train_networks()))
        except (InputError, RefusedError) as error:
            self._tell(Outcome(f"the network was not adapted: {error}", failed=True))
        finally:
            shutil.rmtree(self.folder / CANDIDATE, ignore_errors=True)

    def _train_networks(self) -> tuple[str, str]:
        """Train what the dataset has data for; the names or folders of both networks.

        Raises:
            _EndedError: the watching process has ended.
        """
        found = []
        for name in SUBJECTS:
            if name != SUBJECTS[0] and not (self.folder / DATASET / TRAIN_PATCHES).is_file():
                found.append(name)
                continue
            changes = adaptation(name, self.folder / DATASET)
            own = ("training.threads=1", "training.device=cpu", *self.task.plan.changes)
            out = self.folder / CANDIDATE / name
            run = train_in(out, load_experiment(name, [*changes, *own]), should_stop=self._ended.is_set)
            if not is_finished(run, run.seconds):
                raise _EndedError
            found.append(str(out))
        return found[0], found[1]

    def _compare(self, candidate: tuple[str, str]) -> Outcome:
        """Compare the adapted networks with the running ones, and publish them if they are better."""
        before, after = (self._scores(load_proposer(*each)) for each in (self._running, candidate))
        frames = self._frames
        (right, wrong), (right_before, wrong_before) = after.shares(), before.shares()
        decided = f"{int(after.decided.sum())} of {len(after.decided)} held-out snapshots decided"
        figures = (
            f"right {right:.1f} % of the markers shown (before: {right_before:.1f}), wrong {wrong:.1f} % of its "
            f"claims ({wrong_before:.1f}), {after.off:.2f} px off ({before.off:.2f}), {decided} "
            f"({int(before.decided.sum())})"
        )
        if not after.is_better(before):
            return Outcome(f"the network adapted to {frames} frames is no better and is dropped: {figures}")
        self._publish(before, after)
        message = f"the network adapted to {frames} frames runs from now on: {figures}; {self.folder / ADAPTED}"
        return Outcome(message, adopted=True)

    def _scores(self, proposer: Proposer) -> Scores:
        """Ask a proposer about the held-out snapshots."""
        rows = []
        for moment in self._held_out.values():
            if self._ended.is_set():
                raise _EndedError
            rows.append(ask(proposer, replace(moment, frames=_unpack(moment.frames)), self.task))
        return Scores(*(np.array(column) for column in zip(*rows, strict=True)))

    def _publish(self, before: Scores, after: Scores) -> None:
        """Put the adapted networks and their card where the user finds them, in one step."""
        folder, train = self.folder / ADAPTED, self._train
        assert self._latest is not None
        with self.writing, publishing(folder, (*SUBJECTS, ADAPTED_CARD), mark=ADAPTED_CARD) as out:
            for name in SUBJECTS:
                if (self.folder / CANDIDATE / name).is_dir():
                    shutil.move(self.folder / CANDIDATE / name, out / name)
            measurer = folder / SUBJECTS[1] if (out / SUBJECTS[1]).is_dir() else SUBJECTS[1]
            card = CARD.format(
                rig=self._latest.rig.name, object=self.task.obj.name, names=" and ".join(SUBJECTS),
                crops=sum(len(self._crops[number]) for number in train), snapshots=len(train),
                dataset=self.folder / DATASET, moments=len(self._held_out), before=before.row(), after=after.row(),
                network=folder / SUBJECTS[0], measurer=measurer,
            )  # fmt: skip
            write_text(out / ADAPTED_CARD, card)
        found = adapted_networks(self.task.folder)
        assert found is not None
        self._running = found


class _EndedError(Exception):
    """The watching process has ended, and a training with it."""


def ask(proposer: Proposer, moment: Moment, task: LearningTask) -> tuple[int, int, int, float, bool]:
    """Ask a proposer about a snapshot whose pose is known, from a pose nearby.

    Returns:
        Markers that the frames show, right ones, claims, summed squared distances (px^2) of the right ones, and whether
        identification accepts the claims. A claim near a hidden marker does not count: it may be no more than what the
        others predict.
    """
    rig, obj, pose, options = moment.rig, task.obj, moment.rig_from_object, PipelineOptions()
    nothing = np.full(len(moment.blobs), -1, dtype=np.int64)
    snapshot = Snapshot(
        moment.frames, replace(moment.blobs, fiducial=nothing), rig, obj, (rig.prior or RigPrior()).std(rig),
        (_believe(pose, moment, task),), task.detection,
    )  # fmt: skip
    proposal = proposer.propose(snapshot)
    uv = rig.project(pose.apply(obj.points)).uv.numpy()
    labels = to_observations(moment.blobs.select(moment.blobs.fiducial >= 0), rig, obj)
    shown = find_shown(moment.frames, rig, obj, pose.reshape(1), labels, task.detection).numpy()
    claims = proposal.detections
    off = np.linalg.norm(claims.uv - uv[claims.camera, claims.fiducial], axis=1)
    near = off < NEAR
    of_shown = shown[claims.camera, claims.fiducial]
    found, _ = judge(proposal, snapshot, options.identity, error=options.identity_error, pose_known=True)
    right, counted = near & of_shown, of_shown | ~near
    squared = float(np.square(off[right]).sum())
    return int(shown.sum()), int(right.sum()), int(counted.sum()), squared, found.accepted


def _believe(pose: RigidTransform, moment: Moment, task: LearningTask) -> RigidTransform:
    """A pose near the true one, the same for every network."""
    draw = torch.Generator().manual_seed(moment.number)
    axis, way = functional.normalize(torch.randn(2, 3, generator=draw, dtype=torch.float64), dim=1)
    rotation = rotation_from_vector(axis * np.deg2rad(TURNED_DEG)) @ pose.rotation
    middle = task.obj.points.mean(0).to(pose.rotation)
    place = pose.apply(middle[None])[0]
    far = (moment.rig.positions - place).norm(dim=-1).mean()
    return RigidTransform(rotation, place + ASIDE * far * way - rotation @ middle)


def _pack(frames: Any) -> dict[str, Any]:
    """Compress frames without loss."""
    packed = {}
    for name, frame in frames.items():
        packed[name] = None if frame is None else cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    return packed


def _unpack(frames: Any) -> dict[str, Any]:
    return {name: None if one is None else cv2.imdecode(one, cv2.IMREAD_UNCHANGED) for name, one in frames.items()}


def main() -> None:
    """Learn from the snapshots on standard input until it ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # it ends with its pipe, and leaves nothing behind
        signal.signal(number, signal.SIG_IGN)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what a library prints is no answer
    source = os.fdopen(os.dup(0), "rb", buffering=0)
    moments: queue.Queue[Moment | None] = queue.Queue()
    ended = threading.Event()
    task: LearningTask = receive(source)
    unfinished = task.folder / LEARNING / CANDIDATE

    def listen() -> None:
        try:
            while True:
                moments.put(receive(source))
        except EOFError:
            ended.set()
            moments.put(None)

    def tell(answer: Any) -> None:
        if not ended.is_set():
            send(answers, answer)

    shutil.rmtree(unfinished, ignore_errors=True)  # of a run that was killed
    threading.Thread(target=listen, daemon=True).start()
    learner = Learner(task, tell, ended)
    threading.Thread(target=_leave, args=(ended, learner.writing, unfinished), daemon=True).start()
    try:
        tell(None)
        while (moment := moments.get()) is not None:
            learner.take(moment)
            tell(None)
        learner.write()
    except (_EndedError, BrokenPipeError):
        learner.write()
    except InputError as error:
        tell(Outcome(f"learning has ended: {error}", failed=True))


def _leave(ended: threading.Event, writing: threading.Lock, unfinished: Path) -> None:
    """End the process a while after its pipe has closed, between two files."""
    ended.wait()
    time.sleep(GRACE)
    with writing:
        shutil.rmtree(unfinished, ignore_errors=True)
        os._exit(1)

"""`imgcal watch`: keep a running rig calibrated, and report what happens to it."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from rich.console import Console

from imgcal.association import Proposer
from imgcal.cli import arguments
from imgcal.cli.common import RESULT, check_folder, check_inputs_survive, open_rig
from imgcal.cli.watch_display import Display
from imgcal.errors import InputError, RefusedError
from imgcal.extras import advice, missing
from imgcal.io import Fiducials, holding, load_objects, open_input
from imgcal.live_page import parse_address
from imgcal.messages import plural, shorten
from imgcal.online import Event, RigKeeper
from imgcal.pipeline import DETECTORS, DetectorName, LearnedMeasurer, choose_proposer
from imgcal.types import CalibrationObject, CameraRig, Detections, object_difference, rig_difference
from imgcal.watch import (
    CURRENT,
    EVENTS,
    LEARNING,
    STATE,
    SUBJECTS,
    Bag,
    BlobTable,
    FirstRefusals,
    Folder,
    Hook,
    JsonLines,
    Known,
    LabStreaming,
    Learning,
    LearningPlan,
    LearningTask,
    MarkerFile,
    Metrics,
    OpenIGTLink,
    PoseFile,
    PosePublisher,
    Poses,
    PoseSink,
    Progress,
    Qualisys,
    Source,
    SourceReader,
    Tally,
    Timing,
    Videos,
    ZeroMQ,
    adapted_networks,
    forget_after,
    holds_videos,
    listening_address,
    put_aside,
    run_networks,
)
from imgcal.watch import Watch as Loop

MARKER_SUFFIXES, TABLE_SUFFIXES = (".c3d", ".trc"), (".csv", ".jsonl")
POSE_OUTPUTS = "FILE.csv, FILE.jsonl, FILE.c3d, FILE.trc, tcp://HOST:PORT, ipc://PATH or igtl://[HOST:]PORT"
BLOBS_ONLY = (BlobTable, JsonLines, LabStreaming, Qualisys)
LEARNING_CODE = "from imgcal.cli.learning_process import main; main()"
USUAL_RATE = 30.0  # snapshots a second of a table of blobs

# What kind of input an option is for.
ONLY_FOR = {
    "rate": "a table of blobs",
    "topic": "a recording",
    "videos-differ": "a folder of videos",
    "until-idle": "a folder of frames",
    "remove": "a folder of frames",
}


class Watch(arguments.Watch):
    """Run `imgcal watch`."""

    def run(self) -> None:
        """Watch until the end."""
        rig, given = open_rig(self.rig), load_objects(self.object)
        self._check_out()
        _check_poses(self.poses, given.as_unknown(), self.out)
        if self.learn:
            self._check_learning(given)
        detector = self._detector()
        with holding(self.out) as folder:
            self._watch(rig, given, detector, folder)

    def _watch(self, rig: CameraRig, given: CalibrationObject, detector: DetectorName | Proposer, folder: Path) -> None:
        obj = given.as_unknown()
        page_at = None if self.serve is None else parse_address(self.serve)
        metrics_at = None if self.metrics is None else parse_address(self.metrics, "--metrics", None)
        with _explain_unusable_state():
            progress = None if self.fresh else Progress.load(folder)
        source, origin = self._source(rig, given.rows, progress), self._origin()
        if self.learn and isinstance(source, BLOBS_ONLY):
            raise InputError(f"--learn: found blobs without frames ({shorten(self.input)}), expected frames of cameras")
        rate = source.rate if isinstance(source, BlobTable) else None
        goes_on = source.live and not self.keep_all  # what came since the last state is gone
        knows = goes_on or isinstance(source, Folder)  # a folder knows which files have been read
        known = None if progress is None or knows else self._find_progress(folder, progress, source)
        intake = SourceReader(source, rig, Timing(self.tolerance, self.patience), self.keep_all, known=known)
        hook = None if self.hook is None else Hook(self.hook)
        display = Display(Console(file=sys.stdout, soft_wrap=True), intake, hook)
        with contextlib.ExitStack() as stack:
            keeper, restored = self._keeper(folder, rig, obj, detector)
            stack.enter_context(keeper)
            stack.enter_context(intake).wait_until_open()  # before anything is written
            if len(given.points) > 1 and obj is not given:
                note = f"note: markers of {given.name} are followed one by one; where their distances fit, they count"
                print(note, file=sys.stderr)
            poses = [
                stack.enter_context(Poses(name, _pose_sink(name, rig, obj)))
                for name in sorted(self.poses, key=_is_table)
            ]
            learning = None
            if self.learn:
                running = (None if self.fresh else adapted_networks(folder)) or SUBJECTS
                task = LearningTask(folder, obj, self.detection, LearningPlan(), running)
                learning = stack.enter_context(Learning(task, LEARNING_CODE))
                if running != SUBJECTS:
                    keeper.use_proposer(run_networks(running))
                print(f"learning from the frames of this rig: {folder / LEARNING}")
            page = None
            if page_at is not None:
                from imgcal.live_page import LivePage  # brings a server along, which is not in the core

                page = stack.enter_context(LivePage(rig, obj, page_at, problem=display.warn))
                print(page.notice)
            loop = Loop(
                keeper, folder, hook, page, display.show_event, display.warn, _make_remover(source), source=origin,
                rate=rate,
                poses=poses, learning=learning,
            )  # fmt: skip
            if metrics_at is not None:
                stack.enter_context(Metrics(loop.tally, intake, hook, metrics_at))
            logged = None if progress is None else progress.logged
            if not (goes_on or self.fresh or logged is None or self._is_another(progress)):
                forget_after(folder / EVENTS, logged)  # what came after will come again
            anew = self.fresh and put_aside(folder)
            stack.enter_context(loop)
            stopped = stack.enter_context(_stop_at_signals())
            stack.enter_context(display.show_tally(loop.tally))
            if restored or anew:
                how = "resumed from the saved state" if restored else "started anew from the factory calibration"
                loop.publish_event(Event(time.time(), 0, "restart", message=how))
            if rate is not None and self.rate is None:
                print(f"note: {rate:g} snapshots a second are assumed; --rate says otherwise", file=sys.stderr)
            refusals = FirstRefusals(rig, obj)

            def looked() -> None:
                display.draw()
                if cause := refusals.add(loop.tally.latest, restored or loop.tally.learnt > 0):
                    display.warn(f"nothing could be learned yet: {cause}")

            loop.run(intake, stopped, looked)
        tally = loop.tally
        said = display.result(self.out / CURRENT)
        if lost := [f"{output.name}: {plural(output.lost, 'pose')}" for output in poses if output.lost]:
            said = f"{said} | not written: {'; '.join(lost)}"
        if learning is not None:
            said = f"{said} | {learning.summary}"
        if loop.unwritten:
            said = f"{said} | not written: {'; '.join(loop.unwritten.values())}"
        if stopped.interrupted:
            there = "the last state that was written" if STATE in loop.unwritten else "there"
            raise KeyboardInterrupt(f"interrupted after {said}; the same command resumes from {there}")
        if loop.unwritten:
            raise InputError(f"watch: {said}")
        before = intake.known_before + (source.count_processed() if isinstance(source, Folder) else 0)
        if tally.snapshots == 0 and before:
            read = f"all {plural(before, 'snapshot')} of {self.input} had been read before"
            said = f"{read}; --fresh starts from the factory rig | {said}"
        elif tally.latest is None or tally.learnt == 0:
            raise RefusedError(_explain_no_learning(tally, intake, refusals))
        elif before:
            said = f"{said} | {before:,} had been read before"
        print(said)

    def _check_out(self) -> None:
        """The inputs must survive, and a calibration."""
        check_folder(self.out)
        check_inputs_survive(self.out, (CURRENT,), [("--rig", Path(self.rig))])
        if (self.out / RESULT).exists():
            raise InputError(f"--out: {self.out} holds a calibration ({RESULT}), expected another folder")

    def _origin(self) -> str:
        """Which source it is, wherever the command is run."""
        return self.input if self.input == "-" or "://" in self.input else str(Path(self.input).resolve())

    def _is_another(self, progress: Progress | None) -> bool:
        """Whether INPUT is another one than before; what a version noted that did not note it is taken for the same."""
        return progress is not None and progress.source not in (None, self._origin())

    def _find_progress(self, folder: Path, progress: Progress, source: Source) -> Known:
        """How far an earlier run has worked on this recording, or that it was another one."""
        another = self._is_another(progress)
        rate = source.rate if isinstance(source, BlobTable) else None
        if not another and rate is not None and progress.rate not in (None, rate):
            expected = f"{progress.rate:g} as in {folder / STATE}"
            raise InputError(f"--rate: found {rate:g}, expected {expected}; --fresh starts over")
        gone = isinstance(source, BlobTable) and progress.name not in source.blobs.snapshot_names
        return Known(progress.time, None if gone else progress.name, another)

    def _source(self, rig: CameraRig, labels: Fiducials, progress: Progress | None) -> Source:
        """Find out what INPUT is; tables call the fiducials by `labels`."""
        if self.input == "-":
            self._check_options("standard input")
            return JsonLines(sys.stdin.fileno())
        if "://" in self.input:
            self._check_options("an address")
            if self.input.startswith("qtm://"):
                return Qualisys(self.input, rig)
            if self.input.startswith("lsl://"):
                self._require("pylsl", "an address")
                return LabStreaming(self.input)
            if not self.input.startswith(("tcp://", "ipc://")):
                known = "tcp://host:port, ipc://path, qtm://host or lsl://name"
                raise InputError(f"{shorten(self.input)}: expected an address {known}")
            self._require("zmq", "an address")
            return ZeroMQ((self.input,))
        path = Path(self.input)
        if path.suffix.lower() == ".mcap" or (path / "metadata.yaml").is_file():
            self._check_options("a recording")
            self._require("rosbags", "a recording")
            return Bag(path, rig, _topics(self.topic))
        if path.is_dir() and not holds_videos(path):
            self._check_options("a folder of frames")
            name = None if progress is None or self._is_another(progress) else progress.name
            return Folder(path, rig, self.remove, name, self.until_idle)
        if path.is_dir():
            self._check_options("a folder of videos")
            return Videos(path, rig, self.videos_differ)
        if path.exists():
            self._check_options("a table of blobs")
        rate = USUAL_RATE if self.rate is None else self.rate
        if not 0 < rate < 1e6:
            raise InputError(f"--rate: found {rate:g}, expected more than 0 and less than 1e6 snapshots per second")
        source = open_input(path, rig, labels)
        assert isinstance(source, Detections)  # folders are seen to above
        return BlobTable(source, rate)

    def _check_options(self, kind: str) -> None:
        """Refuse options that have no effect on this kind of input.

        Raises:
            InputError: names the first of them, and what it is for.
        """
        for option, meant in ONLY_FOR.items():
            given = getattr(self, option.replace("-", "_"))
            if meant != kind and not (given is None or given is False or given == ()):
                raise InputError(f"--{option}: needs {meant}, found {kind} ({shorten(self.input)})")

    def _detector(self) -> DetectorName | Proposer:
        """Combine the network of `--detector` with `--measurer`.

        Raises:
            InputError: no network leaves anything to measure, or there is no such measurer.
        """
        if self.measurer is None:
            return self.detector
        if self.detector in DETECTORS and self.detector != "learned":
            raise InputError(
                f"--measurer: found --detector {self.detector}, expected --detector learned or a network of your own"
            )
        return choose_proposer(self.detector, LearnedMeasurer.load(self.measurer))[0]

    def _check_learning(self, obj: CalibrationObject) -> None:
        """Refuse to learn where no network runs, or none can learn.

        Raises:
            InputError: says what `--learn` needs.
        """
        if self.measurer is not None:
            found = f"found --measurer {shorten(self.measurer)}"
            raise InputError(f"--learn: {found}, expected none: it begins with the shipped measurer, and adapts it")
        if self.detector != "learned":
            found = f"found --detector {shorten(self.detector)}"
            raise InputError(f"--learn: {found}, expected --detector learned: it adapts the network that this runs")
        if obj.board is not None or obj.as_unknown().unknown_markers or obj.parts:
            found = f"found {shorten(obj.name)}"
            raise InputError(f"--learn: {found}, expected one object whose markers keep their distances")

    def _keeper(
        self, folder: Path, rig: CameraRig, obj: CalibrationObject, detector: DetectorName | Proposer
    ) -> tuple[RigKeeper, bool]:
        """Begin, or go on with what an earlier run knew; says whether it did."""
        path = folder / STATE
        if self.fresh or not path.is_file():
            return RigKeeper(rig, obj, detection=self.detection, detector=detector), False
        with _explain_unusable_state():
            keeper = RigKeeper.restore(path, detection=self.detection, detector=detector)
        for option, difference in (
            (f"--rig {self.rig}", _rig_difference(rig, keeper.given)),
            (f"--object {' '.join(self.object)}", _object_difference(obj, keeper.obj)),
        ):
            if difference is not None:
                known = f"{path}: found a state that does not belong to {option}"
                raise InputError(f"{known} ({difference}); --fresh starts over")
        return keeper, True

    def _require(self, library: str, what: str) -> None:
        if missing(library):
            raise InputError(f"{shorten(self.input)}: {what} {advice(library)}")


def _rig_difference(rig: CameraRig, known: CameraRig) -> str | None:
    """Say in what a rig differs from the one that was begun with: also in its prior, and how fast it drifts."""
    if rig.prior != known.prior:
        return "prior"
    return "drift rate" if rig.drift_rate != known.drift_rate else rig_difference(rig, known)


def _object_difference(obj: CalibrationObject, known: CalibrationObject) -> str | None:
    """Say in what an object differs from the one that was begun with: also in its tolerances."""
    difference = object_difference(obj, known)
    if difference is None and len(obj.parts) != len(known.parts):
        return f"{len(known.parts)} objects, not {len(obj.parts)}"
    for part, other in zip(obj.parts, known.parts, strict=difference is None):
        difference = difference or _object_difference(part, other)
    if difference is None and (
        obj.scale_tolerance != known.scale_tolerance or not torch.allclose(obj.granted, known.granted.to(obj.granted))
    ):
        return "tolerance"
    return difference


def _explain_no_learning(tally: Tally, intake: SourceReader, refusals: FirstRefusals) -> str:
    """Say why nothing was learned."""
    if tally.latest is not None:
        cause = refusals.find_cause() or tally.latest.refused
        return f"watch: nothing could be learned from any snapshot: {cause}"
    if intake.reasons:
        return f"watch: no snapshot came: {intake.reasons[-1]}"
    return "watch: no snapshot came"


def _make_remover(source: Source) -> Callable[[Progress], None]:
    """What deletes frames that have been learnt from."""
    if not isinstance(source, Folder):
        return lambda progress: None
    return lambda progress: None if progress.name is None else source.delete_read(progress.name)


@contextlib.contextmanager
def _explain_unusable_state() -> Iterator[None]:
    """Say what to do where what an earlier run left cannot be used."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{error}; --fresh starts over") from error


class _Stopped(threading.Event):
    """Set by Ctrl-C, or by SIGTERM."""

    interrupted = False


@contextlib.contextmanager
def _stop_at_signals() -> Iterator[_Stopped]:
    """End cleanly at SIGINT and SIGTERM; a second Ctrl-C does not wait."""
    stopped = _Stopped()

    def stop(number: int, frame: FrameType | None) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt
        stopped.interrupted = number == signal.SIGINT
        stopped.set()

    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) != signal.SIG_IGN:  # in the background of a shell, Ctrl-C is not for us
                before[number] = signal.signal(number, stop)
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check_poses(names: tuple[str, ...], obj: CalibrationObject, out: Path) -> None:
    """Refuse outputs of poses that cannot be, before anything is written.

    Raises:
        InputError: names the first of them, and what it could be.
    """
    for number, name in enumerate(names):
        path, (scheme, separator, _) = Path(name), name.partition("://")
        is_file, suffix = not separator, path.suffix.lower()
        if name in names[:number]:
            raise InputError(f"--poses: found {shorten(name)} twice, expected each output once")
        if not is_file and scheme not in ("tcp", "ipc", "igtl"):
            raise InputError(f"--poses: found {shorten(name)!r}, expected {POSE_OUTPUTS}")
        if is_file and suffix not in (*MARKER_SUFFIXES, *TABLE_SUFFIXES):
            raise InputError(f"--poses: found {shorten(name)!r}, expected {POSE_OUTPUTS}")
        if obj.pose_rank == 3 and not (is_file and suffix in MARKER_SUFFIXES):
            found = f"found {shorten(name)!r} with {shorten(obj.name or 'a light')}, which has no pose"
            raise InputError(f"--poses: {found}, expected FILE.c3d or FILE.trc: points")
        if is_file and path.is_dir():
            raise InputError(f"--poses: {shorten(name)}: found a folder, expected a file")
        if is_file and not (path.parent.is_dir() or out.resolve().is_relative_to(path.parent.resolve())):
            raise InputError(f"--poses: {shorten(name)}: found no folder {path.parent}, expected one")
        if is_file and path.parent.is_dir() and not os.access(path.parent, os.W_OK):
            raise InputError(f"--poses: {shorten(name)}: no permission to write to {path.parent}")


def _is_table(name: str) -> bool:
    """Whether opening this output makes a file; those come last, when all others are known to work."""
    return "://" not in name and Path(name).suffix.lower() in TABLE_SUFFIXES


def _pose_sink(name: str, rig: CameraRig, obj: CalibrationObject) -> PoseSink:
    """Open what poses are to go to, by its name.

    Raises:
        InputError: it cannot be opened.
    """
    scheme, separator, _ = name.partition("://")
    if not separator and Path(name).suffix.lower() in MARKER_SUFFIXES:
        return MarkerFile(Path(name), rig, obj)
    if not separator:
        return PoseFile(Path(name))
    if scheme == "igtl":
        return OpenIGTLink(*listening_address(name))
    if missing("zmq"):
        raise InputError(f"--poses: {shorten(name)} {advice('zmq')}")
    return PosePublisher(name)


def _topics(given: tuple[str, ...]) -> dict[str, str]:
    pairs = [text.partition("=") for text in given]
    wrong = [camera for camera, _, topic in pairs if not camera or not topic]
    if wrong:
        raise InputError(f"--topic: found {shorten(wrong[0])!r}, expected CAMERA=TOPIC")
    cameras = [camera for camera, _, _ in pairs]
    twice = [camera for camera in dict.fromkeys(cameras) if cameras.count(camera) > 1]
    if twice:
        raise InputError(f"--topic: found camera {shorten(twice[0])} twice, expected one topic per camera")
    return {camera: topic for camera, _, topic in pairs}

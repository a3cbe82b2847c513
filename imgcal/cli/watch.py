"""`imgcal watch`: keep a running rig calibrated, and report what happens to it."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from imgcal.association import Proposer
from imgcal.cli import arguments
from imgcal.cli.common import RESULT, check_folder, check_inputs_survive, open_rig
from imgcal.cli.interruption import stop_at_signals
from imgcal.cli.watch_display import Display, Output
from imgcal.cli.watch_poses import check_pose_outputs, open_pose_outputs
from imgcal.cli.watch_sources import identify_source, open_source
from imgcal.errors import InputError, RefusedError
from imgcal.io import holding, load_objects
from imgcal.live_page import Address, parse_address
from imgcal.messages import plural, shorten
from imgcal.online import Event, RigKeeper
from imgcal.pipeline import DETECTORS, DetectorName, LearnedMeasurer, choose_proposer, unit_doubt
from imgcal.types import CalibrationObject, CameraRig, object_difference, rig_difference
from imgcal.watch import (
    CURRENT,
    EVENTS,
    LEARNING,
    STATE,
    SUBJECTS,
    BlobTable,
    EarlierRun,
    Folder,
    Hook,
    JsonLines,
    LabStreaming,
    Learning,
    LearningPlan,
    LearningTask,
    Metrics,
    Page,
    Poses,
    Progress,
    Qualisys,
    RefusalCauses,
    Source,
    SourceReader,
    Tally,
    Timing,
    forget_after,
    forget_rows,
    put_aside,
    run_networks,
)
from imgcal.watch import Watch as Loop

BLOBS_ONLY = (BlobTable, JsonLines, LabStreaming, Qualisys)
LEARNING_CODE = "from imgcal.cli.learning_process import main; main()"


class Watch(arguments.Watch):
    """Run `imgcal watch`."""

    def run(self) -> None:
        """Watch until the end."""
        rig, given = open_rig(self.rig), load_objects(self.object)
        self._check_out()
        check_pose_outputs(self.poses, given.as_unknown(), self.out)
        if self.learn:
            self._check_learning(given)
        detector = self._detector()
        try:
            with holding(self.out) as folder:
                self._watch(rig, given, detector, folder)
        except BrokenPipeError as error:  # a service must learn that nobody watches any more
            sys.stdout = None
            said = "whatever read the standard output is gone; the same command resumes from the saved state"
            raise InputError(f"watch: {said}") from error

    def _watch(self, rig: CameraRig, given: CalibrationObject, detector: DetectorName | Proposer, folder: Path) -> None:
        """Open the input, then the outputs; follow the input to its end, and say what came of it."""
        obj = given.as_unknown()
        page_at = None if self.serve is None else parse_address(self.serve)
        metrics_at = None if self.metrics is None else parse_address(self.metrics, "--metrics", None)
        source, earlier = self._open_source(rig, given, folder)
        rate = source.rate if isinstance(source, BlobTable) else None
        intake = SourceReader(source, rig, Timing(self.tolerance, self.patience), self.keep_all, known=earlier.known)
        hook = None if self.hook is None else Hook(self.hook)
        display = Display(Output(file=sys.stdout, soft_wrap=True), intake, hook)
        refusals = RefusalCauses(rig, obj)
        with contextlib.ExitStack() as stack:
            keeper = stack.enter_context(self._open_keeper(earlier.state, rig, obj, detector))
            stack.enter_context(intake).wait_until_open()  # before anything is written
            if earlier.known is not None and not intake.resumes:
                earlier = earlier.as_another()
            if len(given.points) > 1 and obj is not given:
                note = f"note: markers of {given.name} are followed one by one; where their distances fit, they count"
                print(note, file=sys.stderr)
            if doubt := unit_doubt(rig, given):
                print(f"note: {doubt}", file=sys.stderr)
            poses = stack.enter_context(open_pose_outputs(self.poses, rig, obj))
            learning = stack.enter_context(self._learning(keeper, obj, folder, earlier.networks))
            page = stack.enter_context(_serve(page_at, rig, obj, display))
            loop = Loop(
                keeper, folder, hook, page, display.show_event, display.warn, _make_remover(source),
                source=identify_source(self.input), rate=rate, poses=poses, learning=learning,
            )  # fmt: skip
            if metrics_at is not None:
                stack.enter_context(Metrics(loop.tally, intake, hook, metrics_at))
            restart = self._prepare(folder, earlier, poses)
            stack.enter_context(loop)
            stopped = stack.enter_context(stop_at_signals())
            stack.enter_context(display.show_tally(loop.tally))
            if restart is not None:
                loop.publish_event(Event(time.time(), 0, "restart", message=restart))
            if rate is not None and self.rate is None:
                print(f"note: {rate:g} snapshots a second are assumed; --rate says otherwise", file=sys.stderr)

            def looked() -> None:
                display.draw()
                if cause := refusals.add(loop.tally.latest):
                    when = "any more" if earlier.state is not None or loop.tally.learnt else "yet"
                    display.warn(f"nothing could be learned {when}: {cause}")

            loop.run(intake, stopped, looked)
        said = " | ".join([display.result(self.out / CURRENT), *_describe_outputs(loop)])
        print(self._conclude(said, loop, intake, source, refusals, stopped.interrupted))

    def _open_source(self, rig: CameraRig, given: CalibrationObject, folder: Path) -> tuple[Source, EarlierRun]:
        """Open the input, and find out what an earlier run left of it in the output folder."""
        source = open_source(self, rig, given.rows)
        if self.learn and isinstance(source, BLOBS_ONLY):
            raise InputError(f"--learn: found blobs without frames ({shorten(self.input)}), expected frames of cameras")
        if self.fresh:
            return source, EarlierRun()
        with _explain_unusable_state():
            earlier = EarlierRun.find(folder, source, identify_source(self.input), self.keep_all)
        return replace(source, after=earlier.after) if isinstance(source, Folder) else source, earlier

    def _open_keeper(
        self, state: Path | None, rig: CameraRig, obj: CalibrationObject, detector: DetectorName | Proposer
    ) -> RigKeeper:
        """Begin with the factory rig, or resume from the state of an earlier run if it is of this rig and object."""
        if state is None:
            return RigKeeper(rig, obj, detection=self.detection, detector=detector)
        with _explain_unusable_state():
            keeper = RigKeeper.restore(state, detection=self.detection, detector=detector)
        for option, difference in (
            (f"--rig {self.rig}", _rig_difference(rig, keeper.given)),
            (f"--object {' '.join(self.object)}", _object_difference(obj, keeper.obj)),
        ):
            if difference is not None:
                known = f"{state}: found a state that does not belong to {option}"
                raise InputError(f"{known} ({difference}); --fresh starts over")
        return keeper

    @contextlib.contextmanager
    def _learning(
        self, keeper: RigKeeper, obj: CalibrationObject, folder: Path, adapted: tuple[str, str] | None
    ) -> Iterator[Learning | None]:
        """With `--learn`, adapt networks in a process of its own; begin with those that an earlier run has adapted."""
        if not self.learn:
            yield None
            return
        task = LearningTask(folder, obj, self.detection, LearningPlan(), adapted or SUBJECTS)
        with Learning(task, LEARNING_CODE) as learning:
            if task.running != SUBJECTS:
                keeper.use_proposer(run_networks(task.running))
            print(f"learning from the frames of this rig: {folder / LEARNING}")
            yield learning

    def _prepare(self, folder: Path, earlier: EarlierRun, poses: Sequence[Poses]) -> str | None:
        """Remove from the output folder what this run does not continue, and say how it starts after an earlier one."""
        if earlier.logged is not None:
            forget_after(folder / EVENTS, earlier.logged)
        for path, _ in (output.table for output in poses if output.table is not None):
            if path in earlier.tables:
                forget_rows(Path(path), earlier.tables[path], earlier.snapshot)
        if self.fresh and put_aside(folder):
            return "started anew from the factory calibration"
        return None if earlier.state is None else "resumed from the saved state"

    def _conclude(
        self, said: str, loop: Loop, intake: SourceReader, source: Source, refusals: RefusalCauses, interrupted: bool
    ) -> str:
        """Return the last line: `said`, and what had been read before.

        Raises:
            KeyboardInterrupt: Ctrl-C ended it.
            InputError: something could not be written.
            RefusedError: nothing could be learned from what came.
        """
        if interrupted:
            there = "the last state that was written" if STATE in loop.unwritten else "there"
            raise KeyboardInterrupt(f"interrupted after {said}; the same command resumes from {there}")
        if loop.unwritten:
            raise InputError(f"watch: {said}")
        tally = loop.tally
        before = intake.known_before + (source.count_processed() if isinstance(source, Folder) else 0)
        if tally.snapshots == 0 and before:
            read = f"all {plural(before, 'snapshot')} of {self.input} had been read before"
            return f"{read}; --fresh starts from the factory rig | {said}"
        if tally.latest is None or tally.learnt == 0:
            raise RefusedError(_explain_no_learning(tally, intake, refusals))
        return f"{said} | {before:,} had been read before" if before else said

    def _check_out(self) -> None:
        """The inputs must survive, and a calibration."""
        check_folder(self.out)
        check_inputs_survive(self.out, (CURRENT,), [("--rig", Path(self.rig))])
        if (self.out / RESULT).exists():
            raise InputError(f"--out: {self.out} holds a calibration ({RESULT}), expected another folder")

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


def _describe_outputs(loop: Loop) -> list[str]:
    """Say what could not be written, and what came of `--learn`."""
    parts = []
    if lost := [f"{output.name}: {plural(output.lost, 'pose')}" for output in loop.poses if output.lost]:
        parts.append(f"not written: {'; '.join(lost)}")
    if loop.learning is not None:
        parts.append(loop.learning.summary)
    if loop.unwritten:
        parts.append(f"not written: {'; '.join(loop.unwritten.values())}")
    return parts


def _explain_no_learning(tally: Tally, intake: SourceReader, refusals: RefusalCauses) -> str:
    """Say why nothing was learned."""
    if tally.latest is not None:
        cause = refusals.find_cause() or tally.latest.refused
        return f"watch: nothing could be learned from any snapshot: {cause}"
    if intake.reasons:
        return f"watch: no snapshot came: {intake.reasons[-1]}"
    return "watch: no snapshot came"


def _make_remover(source: Source) -> Callable[[Progress], None]:
    """What deletes frames that have been learned from."""
    if not isinstance(source, Folder):
        return lambda progress: None
    return lambda progress: None if progress.name is None else source.delete_read(progress.name)


@contextlib.contextmanager
def _serve(address: Address | None, rig: CameraRig, obj: CalibrationObject, display: Display) -> Iterator[Page | None]:
    """With `--serve`, show the live page at this address."""
    if address is None:
        yield None
        return
    from imgcal.live_page import LivePage  # brings a server along, which is not in the core

    with LivePage(rig, obj, address, problem=display.warn) as page:
        print(page.notice)
        yield page


@contextlib.contextmanager
def _explain_unusable_state() -> Iterator[None]:
    """Say what to do where what an earlier run left cannot be used."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{error}; --fresh starts over") from error

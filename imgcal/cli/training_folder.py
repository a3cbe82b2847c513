"""The folder of a training run: what `imgcal train` writes and shows."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from imgcal.errors import InputError, RefusedError
from imgcal.io import MODEL, holding, read_metrics, write_tensors, write_text
from imgcal.messages import plural
from imgcal.training import (
    Callbacks,
    DivergedError,
    Experiment,
    Result,
    Run,
    TrainingState,
    is_finished,
    load_state,
    progress,
    save_experiment,
    save_state,
    train,
)

RESULT, STATE, RESOLVED, METRICS = MODEL, "state.safetensors", "resolved.yaml", "metrics.jsonl"
BAD_BATCH = "bad_batch.safetensors"
EVERY = 60.0  # s between two lines where there is no terminal
EXTRA = "extra"  # key of a row that a longer run does not have


def train_in(
    folder: str | Path, experiment: Experiment, resume: bool = False, should_stop: Callable[[], bool] = lambda: False
) -> Run:
    """Train, and write model, state, resolved experiment and metrics into a folder.

    Args:
        folder: made if need be, once all input has been found usable.
        experiment: what to train, on what, for how long.
        resume: go on from the state in the folder.
        should_stop: see `imgcal.training.train`.

    Raises:
        InputError: unusable experiment, state or folder.
        RefusedError: the loss or its gradient is not finite, and the batch is saved; or the result is of no use.
    """
    folder = Path(folder)
    state = load_state(folder / STATE, experiment) if resume else None
    try:
        return train(experiment, TrainingFolder(folder), state, should_stop)
    except DivergedError as error:
        name = BAD_BATCH if error.process is None else f"{error.process}_{BAD_BATCH}"
        write_tensors(folder / name, error.batch.tensors(), "imgcal-batch/1", {"step": str(error.step - 1)})
        raise RefusedError(
            f"{folder}: {error}; the batch is in {name}; {STATE}, if there, is from before this step: change the "
            "experiment and continue with --resume, or start again"
        ) from error
    except RefusedError as error:
        raise RefusedError(f"{folder}: {error}; files written before this step are kept") from error


class TrainingFolder(Callbacks):
    """Writes the progress of a training into a folder, and shows it on standard error."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.metrics = folder / METRICS

    def on_start(self, run: Run) -> None:
        """Take the folder and open the logs; drop rows that an uninterrupted run would not have logged."""
        with ExitStack() as stack:
            stack.enter_context(holding(self.folder))
            self._open(run)
            self._held = stack.pop_all()

    def _open(self, run: Run) -> None:
        save_experiment(run.experiment, self.folder / RESOLVED)
        kept = [row for row in read_metrics(self.metrics) if row["step"] <= run.step and not row.get(EXTRA)]
        write_text(self.metrics, "".join(json.dumps(row) + "\n" for row in (kept if run.step else [])))
        self.board = SummaryWriter(str(self.folder / "tensorboard"), purge_step=run.step + 1)
        self.console = Console(file=sys.stderr)
        words, times = TextColumn("{task.description}"), (TimeElapsedColumn(), TimeRemainingColumn())
        columns = (words, BarColumn(), TaskProgressColumn(), *times)
        self.said = run.elapsed
        self.bar = Progress(*columns, console=self.console, disable=not self.console.is_terminal)
        self.shown = self.bar.add_task("training", total=1.0)
        self.bar.start()
        self._announce(run)

    def on_metrics(self, run: Run, row: dict[str, Any], due: bool) -> None:
        """Append a row to metrics.jsonl and to TensorBoard; show it."""
        try:
            with open(self.metrics, "a") as file:
                file.write(json.dumps(row if due else row | {EXTRA: True}) + "\n")
        except OSError as error:
            raise InputError(f"{self.metrics}: cannot be written: {error.strerror or error}") from error
        for name, value in row.items():
            if name != "step" and isinstance(value, float | int):
                self.board.add_scalar(name, value, row["step"])
        self.bar.update(self.shown, description=_summary(run))
        if self.console.is_terminal and "seconds" not in row:  # a validation stays above the bar
            self._say(_summary(run))

    def on_step(self, run: Run, seconds: float) -> None:
        """Move the bar; without a terminal, print a line every minute."""
        done = progress(run, seconds)
        self.bar.update(self.shown, completed=done, description=_summary(run))
        if not self.console.is_terminal and seconds - self.said >= EVERY and not is_finished(run, seconds):
            self.said = seconds
            left = seconds * (1 - done) / max(done, 1e-9) / 60
            self._say(f"{_summary(run)}  {100 * done:.0f} %, {left:.0f} min left")

    def on_checkpoint(self, run: Run, state: TrainingState, result: Result) -> None:
        """Write both, the model first: it is never older than the state. What cannot be written survives as it was."""
        result.save(self.folder / RESULT)
        save_state(self.folder / STATE, state)

    def on_end(self, run: Run) -> None:
        """Close the logs, and print the state of the training."""
        self.bar.update(self.shown, description=_summary(run))
        self.bar.stop()
        if not self.console.is_terminal:
            self._say(_summary(run))
        self.board.close()
        self._held.close()

    def _announce(self, run: Run) -> None:
        count = sum(parameter.numel() for parameter in run.plain.parameters())
        where = f"{run.accelerator.num_processes} x {run.accelerator.device.type}"
        again = f", from step {run.step} on" if run.step else ""
        if run.step and is_finished(run, run.seconds):
            again = f", complete already after {plural(run.step, 'step')}"
        self._say(f"{run.experiment.name}: {count:,} parameters, {where}{again}")
        if run.task.untrained:
            parts = ", ".join(sorted({name.partition(".")[0] for name in run.task.untrained}))
            start = run.experiment.training.init_from
            self._say(f"{start}: nothing fits {len(run.task.untrained)} tensors of {parts}: untrained")

    def _say(self, text: str) -> None:
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)


def _summary(run: Run) -> str:
    """Put the latest numbers into one line."""
    latest, task = run.latest, run.task
    words = [f"step {run.step}"]
    words += [shown.format(latest[name]) for name, shown in task.headline.items() if name in latest]
    if (rate := latest.get(f"{task.unit}_per_s")) is not None:
        words.append(f"{rate:.0f} {task.unit}/s")
    return "  ".join(words)

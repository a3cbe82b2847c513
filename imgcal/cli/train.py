"""`imgcal train`: an experiment file in, a trained network out."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from types import FrameType

from imgcal.cli import arguments
from imgcal.cli.common import check_folder
from imgcal.errors import InputError
from imgcal.messages import plural

PATIENCE = 2.0  # s, between two signals that are not one and the same


class Train(arguments.Train):
    """Run `imgcal train`."""

    def run(self) -> None:
        """Train and write."""
        # Imported late: accelerate and TensorBoard take seconds, which the other commands should not wait.
        import torch

        from imgcal.cli.training_folder import RESULT, STATE, train_in
        from imgcal.training import adaptation, change_experiment, is_finished, load_experiment

        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise InputError(f"--minutes: found {self.minutes:g}, expected more than 0")
        changes = [change for changes in self.set for change in changes]
        changes += [] if self.minutes is None else [f"training.minutes={float(self.minutes)!r}"]
        own = [] if self.dataset is None else adaptation(self.experiment, self.dataset)
        experiment = change_experiment(load_experiment(self.experiment, own), *changes)
        check_folder(self.out)
        there = (self.out / STATE).exists()
        if there and not self.resume:
            raise InputError(f"{self.out}: found a training there already, expected a new folder, or --resume")
        if self.resume and not there:
            raise InputError(
                f"{self.out}: found no {STATE} there, expected one to --resume from; omit --resume to begin"
            )
        if experiment.training.threads is not None:
            torch.set_num_threads(experiment.training.threads)
        if experiment.training.tf32:
            torch.set_float32_matmul_precision("high")
        with _stop_on_signal() as stop:
            run = train_in(self.out, experiment, self.resume, stop)
        run.accelerator.end_training()
        if not is_finished(run, run.seconds):
            raise KeyboardInterrupt(
                f"interrupted and saved at step {run.step}; to continue, repeat the command with --resume"
            )
        if run.accelerator.is_main_process:
            print(f"{plural(run.step, 'step')}, {run.seconds:.0f} s: {self.out / RESULT}", file=sys.stderr)


@contextmanager
def _stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C or SIGTERM into a stop request; repeated after a while, it interrupts at once.

    After a while, because a launcher of several processes passes on the Ctrl-C that they have had already.
    """
    asked: list[float] = []

    def note(number: int, frame: FrameType | None) -> None:
        asked.append(monotonic())
        if asked[-1] - asked[0] > PATIENCE:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

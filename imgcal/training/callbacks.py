"""Callbacks of a training."""

from __future__ import annotations

from typing import Any

from imgcal.errors import RefusedError
from imgcal.training.run import Run
from imgcal.training.state import TrainingState
from imgcal.training.task import Batch, Result


class Callbacks:
    """Base class that does nothing; override what you need. With several processes, only the main one calls it.

    `imgcal train` uses one of these to write files and show a progress bar.
    """

    def on_start(self, run: Run) -> None:
        """Handle the start of training: the run is built, either new or from a state."""

    def on_metrics(self, run: Run, row: dict[str, Any], due: bool) -> None:
        """Handle the numbers of the last steps.

        Args:
            run: the run so far.
            row: plain values by name: `step`, and the means since the last such row (`loss`, `re_px`, `lr`,
                `rigs_per_s`, `seconds`), or the validation errors (`validation_re_px`, ...); the task names them.
            due: False = only reported because the run ends here, for now; a longer run would not have reported it.
        """

    def on_step(self, run: Run, seconds: float) -> None:
        """Handle a finished step, after `seconds` of training. Called often, so it must return fast."""

    def on_checkpoint(self, run: Run, state: TrainingState, result: Result) -> None:
        """Handle a checkpoint: the state that the rest of the run depends on, and the current result network.

        Both share the run's own tensors: copy or write them before returning.
        """

    def on_end(self, run: Run) -> None:
        """Handle the end of training, also if it is interrupted or fails."""


class DivergedError(RefusedError):
    """Raise when the loss or its gradient is not finite."""

    def __init__(self, step: int, loss: float, norm: float, batch: Batch, process: int | None) -> None:
        """Keep the data for finding the cause.

        Args:
            step: steps taken, this one included.
            loss: of the batch.
            norm: of the gradient.
            batch: input of the network.
            process: index of the process; None = there is only one.
        """
        super().__init__(f"step {step}: loss {loss:g}, norm of its gradient {norm:g}")
        self.step, self.batch, self.process = step, batch, process

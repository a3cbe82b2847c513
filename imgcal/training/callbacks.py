"""Callbacks of a training."""

from __future__ import annotations

from typing import Any

from imgcal.errors import RefusedError
from imgcal.training.run import Run
from imgcal.training.state import TrainingState
from imgcal.training.task import Batch, Result


class Callbacks:
    """Does nothing; override what you need. With several processes, only the main one calls it.

    `imgcal train` writes files and shows a progress bar by one of these.
    """

    def on_start(self, run: Run) -> None:
        """Note that a run is built, new or as a state had it, and that the training begins."""

    def on_metrics(self, run: Run, row: dict[str, Any], due: bool) -> None:
        """Receive the numbers of the last steps.

        Args:
            run: where the training stands.
            row: plain values by name: `step`, and the means since the last such row (`loss`, `re_px`, `lr`,
                `rigs_per_s`, `seconds`), or the errors in validation (`validation_re_px`, ...); the task names them.
            due: False = only told because the run ends here, for now; a longer one would not have told.
        """

    def on_step(self, run: Run, seconds: float) -> None:
        """Note that a step was taken, after so many seconds of training: called often, and must not wait."""

    def on_checkpoint(self, run: Run, state: TrainingState, result: Result) -> None:
        """Take all that the rest of the run depends on, and the network as it would be the result now.

        Both show the run's own tensors: copy or write them before returning.
        """

    def on_end(self, run: Run) -> None:
        """Note that the training ends, or ends for now, or fails."""


class DivergedError(RefusedError):
    """Raise where the loss or its gradient is not finite."""

    def __init__(self, step: int, loss: float, norm: float, batch: Batch, process: int | None) -> None:
        """Keep what is needed to find the reason.

        Args:
            step: steps taken, this one included.
            loss: of the batch.
            norm: of the gradient.
            batch: what the network saw.
            process: which of several it was; None = there is only one.
        """
        super().__init__(f"step {step}: loss {loss:g}, norm of its gradient {norm:g}")
        self.step, self.batch, self.process = step, batch, process

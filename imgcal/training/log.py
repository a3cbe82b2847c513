"""What a training run tells: metrics.jsonl, TensorBoard, a progress bar on standard error."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from imgcal.errors import InputError
from imgcal.io import read_json, write_text

EXTRA = "extra"  # key of a row that a longer run does not have


class Log:
    """Writes and shows numbers; a log that is not `active` (a second process) does nothing."""

    def __init__(self, folder: Path, step: int, active: bool) -> None:
        """Open the logs of a run that stands at `step`; what it would not have logged without a stop is dropped."""
        self.active = active
        self.last: dict[str, Any] = {}
        if not active:
            return
        self.path = folder / "metrics.jsonl"
        kept = [row for row in read_metrics(self.path) if row["step"] <= step and not row.get(EXTRA)] if step else []
        for row in kept:
            self.last |= row
        write_text(self.path, "".join(json.dumps(row) + "\n" for row in kept))
        self.board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1 if step else None)
        self.console = Console(file=sys.stderr)
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self.bar = Progress(*columns, console=self.console, disable=not self.console.is_terminal)
        self.task = self.bar.add_task("training", total=1.0)

    def __enter__(self) -> Log:
        if self.active:
            self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.active:
            self.bar.stop()
            self.board.close()

    def write(self, row: dict[str, Any], extra: bool = False) -> None:
        """Append plain values; `step` is one of them. An `extra` row is not due: the run ends here, for now."""
        if not self.active:
            return
        self.last |= row
        row = row | {EXTRA: True} if extra else row
        try:
            with open(self.path, "a") as file:
                file.write(json.dumps(row) + "\n")
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        for name, value in row.items():
            if name not in ("step", EXTRA) and isinstance(value, float | int):
                self.board.add_scalar(name, value, row["step"])

    def show(self, progress: float) -> None:
        """Move the bar, with the error in pixels."""
        if self.active:
            self.bar.update(self.task, completed=progress, description=self._summary())

    def say(self, text: str) -> None:
        """Print a line on standard error."""
        if self.active:
            self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def say_summary(self) -> None:
        """Print the latest numbers as a line."""
        self.say(self._summary())

    def _summary(self) -> str:
        words = [f"step {self.last.get('step', 0)}"]
        for name, label in (("re_px", "RE"), ("validation_re_px", "validation RE")):
            if name in self.last:
                words.append(f"{label} {self.last[name]:.3g} px")
        if "rigs_per_s" in self.last:
            words.append(f"{self.last['rigs_per_s']:.0f} rigs/s")
        return "  ".join(words)


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """Read metrics.jsonl up to the first line that is none, as one that a kill cut off; no file is no metrics."""
    path = Path(path)
    rows: list[dict[str, Any]] = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        try:
            row = read_json(line)
        except ValueError:
            break
        if not (isinstance(row, dict) and isinstance(row.get("step"), int)):
            break
        rows.append(row)
    return rows

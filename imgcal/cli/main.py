"""`imgcal COMMAND`: parses the command line, runs the command, turns failures into one line and an exit code."""

from __future__ import annotations

import sys
from typing import Annotated, Protocol

import tyro

from imgcal.cli.calibrate import Calibrate
from imgcal.cli.detect import Detect
from imgcal.cli.evaluate import Compare, Evaluate
from imgcal.cli.render import Render
from imgcal.cli.score import Score
from imgcal.cli.simulate import Simulate
from imgcal.cli.train import Train
from imgcal.errors import InputError, RefusedError

DONE, UNUSABLE, REFUSED, INTERRUPTED = 0, 2, 3, 130

Command = (
    Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Detect, tyro.conf.subcommand("detect")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Score, tyro.conf.subcommand("score")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
)

DESCRIPTION = """Recalibrate infrared multi-camera rigs from images of a known calibration object.

Exit codes: 0 done, 2 unusable input, 3 refused (the data cannot decide)."""


class Runnable(Protocol):
    """A parsed command."""

    def run(self) -> None:
        """Do the work."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    try:
        command: Runnable = tyro.cli(Command, prog="imgcal", description=DESCRIPTION, args=arguments)
        command.run()
    except InputError as error:
        return _fail(error, UNUSABLE)
    except RefusedError as error:
        return _fail(error, REFUSED)
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stdout = None
        return DONE
    except OSError as error:
        return _fail(error, UNUSABLE)
    except KeyboardInterrupt as stop:
        return _fail(RuntimeError(str(stop) or "interrupted"), INTERRUPTED)
    return DONE


def _fail(error: Exception, code: int) -> int:
    print(f"imgcal: {' '.join(str(error).split())}", file=sys.stderr)
    return code


def run() -> None:
    """Entry point of the installed command."""
    sys.exit(main())

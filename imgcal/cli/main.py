"""`imgcal COMMAND`: parses the command line, runs the command, turns failures into one line and an exit code."""

from __future__ import annotations

import sys
from dataclasses import make_dataclass
from importlib import import_module
from typing import Annotated, Any, Protocol, Union

import tyro

from imgcal.errors import InputError, RefusedError

DONE, UNUSABLE, REFUSED, INTERRUPTED = 0, 2, 3, 130

COMMANDS = {
    "simulate": (
        "imgcal.cli.simulate",
        "Make a capture: one rig that has drifted from its factory calibration, seen through realistic infrared "
        "frames.",
    ),
    "detect": ("imgcal.cli.detect", "Find blobs in captured frames and measure their centres."),
    "calibrate": (
        "imgcal.cli.calibrate",
        "Recalibrate a rig from captured frames (or a table of blobs) of a known object.",
    ),
    "score": (
        "imgcal.cli.score",
        "Measure the reprojection error of a rig that is held fixed; only the object's pose is fitted in each "
        "snapshot.",
    ),
    "render": (
        "imgcal.cli.render",
        "Redraw captured frames as colour-coded images: every fiducial a soft dot in its own colour, nothing else.",
    ),
    "train": ("imgcal.cli.train", "Train a network as an experiment file says."),
    "evaluate": (
        "imgcal.cli.evaluate",
        "Measure networks and classical methods on random rigs, alone and refined.",
    ),
    "compare": (
        "imgcal.cli.evaluate",
        "Compare networks side by side on the same random rigs: accuracy alone and refined, time, parameters, size.",
    ),
}
"""Module and summary of each command; the class has the command's name. Imported only when it is asked for."""

DESCRIPTION = """Recalibrate infrared multi-camera rigs from images of a known calibration object.

imgcal COMMAND --help tells more. Exit codes: 0 done, 2 unusable input, 3 refused (the data cannot decide)."""


class Runnable(Protocol):
    """A parsed command."""

    def run(self) -> None:
        """Do the work."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    try:
        parse(sys.argv[1:] if arguments is None else arguments).run()
    except InputError as error:
        return _fail(error, UNUSABLE)
    except RefusedError as error:
        return _fail(RuntimeError(error.for_command), REFUSED)
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stdout = None
        return DONE
    except OSError as error:
        return _fail(error, UNUSABLE)
    except KeyboardInterrupt as stop:
        return _fail(RuntimeError(str(stop) or "interrupted"), INTERRUPTED)
    return DONE


def parse(arguments: list[str]) -> Runnable:
    """Turn a command line into its command; imports that command alone.

    Raises:
        SystemExit: help was asked for, or the command line is not understood.
    """
    first = arguments[0] if arguments else ""
    if first in COMMANDS:
        return tyro.cli(_load(first), prog=f"imgcal {first}", args=arguments[1:])
    # The shell's completion knows the options of every command; all else ends here, and names and summaries will do.
    load = _load if first.startswith("--tyro-") else _summary
    commands: Any = Union[tuple(Annotated[load(name), tyro.conf.subcommand(name)] for name in COMMANDS)]  # noqa: UP007
    return tyro.cli(commands, prog="imgcal", description=DESCRIPTION, args=arguments)


def _load(name: str) -> Any:
    return getattr(import_module(COMMANDS[name][0]), name.capitalize())


def _summary(name: str) -> Any:
    return make_dataclass(name.capitalize(), (), namespace={"__doc__": COMMANDS[name][1]})


def _fail(error: Exception, code: int) -> int:
    print(f"imgcal: {' '.join(str(error).split())}", file=sys.stderr)
    return code


def run() -> None:
    """Entry point of the installed command."""
    sys.exit(main())

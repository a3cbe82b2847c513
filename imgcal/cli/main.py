"""`imgcal COMMAND`: parses the command line, runs the command, turns failures into one line and an exit code."""

from __future__ import annotations

import ast
import contextlib
import difflib
import inspect
import io
import re
import sys
import traceback
import warnings
from dataclasses import fields, is_dataclass, make_dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Protocol, Union, get_type_hints

import tyro

import imgcal
from imgcal.cli.compiling import announce_compilation, help_to_compile
from imgcal.cli.interruption import end_at_once
from imgcal.errors import InputError, RefusedError
from imgcal.extras import advice
from imgcal.machine import without_garbage_collection
from imgcal.messages import one_line, quote, shorten

ONE_OF = {"calibrate": ("--rig", "--cameras")}
"""Groups of options, one of which a command needs; the parser knows each as optional."""

SEVERAL_OBJECTS = ("simulate", "calibrate", "score")
"""Commands whose `--object` may be several."""

DONE, UNUSABLE, REFUSED, INTERRUPTED = 0, 2, 3, 130

DEBUG, VERSION = "--debug", "--version"

COMMANDS = (
    "simulate", "rig", "detect", "calibrate", "watch", "score", "render", "convert", "export", "describe", "harvest",
    "train", "evaluate", "compare", "fleet", "demo", "warmup",
)  # fmt: skip
"""Each has a class of its name, among the arguments and in the module of its name."""
HELPED = ("calibrate", "detect")
"""Those that interpret functions until they are compiled."""
DESCRIPTION = """Recalibrate infrared multi-camera rigs from images of a known calibration object.

A first try: imgcal calibrate sample:O10 --rig sample:O10 --object sample:O10 --out result

imgcal COMMAND --help describes a command, imgcal --version prints the version. Exit codes: 0 done, 2 unusable input (or
an internal error), 3 refused (the data cannot decide), 130 interrupted. With --debug anywhere on the command line, a
failure also shows its traceback."""


class Runnable(Protocol):
    """A parsed command."""

    def run(self) -> None:
        """Do the work."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command line; returns the exit code, whatever happens."""
    given = sys.argv[1:] if arguments is None else arguments
    debug = DEBUG in given
    try:
        with contextlib.ExitStack() as stack:
            command = parse([argument for argument in given if argument != DEBUG], stack)
            if "warmup" not in given[:2]:
                stack.enter_context(announce_compilation())
            command.run()
    except SystemExit as stop:  # help was asked for
        return DONE if stop.code is None else int(stop.code)
    except BrokenPipeError:  # the reader of our output has seen enough
        sys.stdout = None
        return DONE
    except BaseException as error:
        if debug:
            traceback.print_exc()
        code, message = _verdict(error, given)
        print(f"imgcal: {one_line(message)}", file=sys.stderr)
        return code
    return DONE


def parse(arguments: list[str], stack: contextlib.ExitStack | None = None) -> Runnable:
    """Turn a command line into its command; imports that command alone, once its arguments are understood.

    Args:
        arguments: the command line.
        stack: gets what helps the command until it ends; None = no help.

    Raises:
        InputError: the command line is not understood.
        SystemExit: help was asked for.
    """
    if any("\0" in argument for argument in arguments):
        raise InputError("found a zero byte in the command line, expected text")
    drawn = io.StringIO()
    try:
        with contextlib.redirect_stderr(drawn):
            return _parse(arguments, stack)
    except SystemExit as stop:
        if stop.code in (None, DONE):
            raise
        raise InputError(_strip_boxes(drawn.getvalue(), arguments)) from None


def _parse(arguments: list[str], stack: contextlib.ExitStack | None) -> Runnable:
    if not arguments:
        raise InputError(f"no command given, expected one of {', '.join(COMMANDS)}; see imgcal --help")
    first = arguments[0]
    if first == VERSION:
        print(f"imgcal {imgcal.__version__}")
        raise SystemExit(DONE)
    if first in COMMANDS:
        options = _move_objects_last(first, arguments[1:])
        if {"-h", "--help"} & {*options}:
            _join_help_lines()
        given = tyro.cli(_arguments(first), prog=f"imgcal {first}", args=options)
        _check_values(given, options)
        with end_at_once(), without_garbage_collection():  # imports take a while
            if first in HELPED and stack is not None:
                stack.enter_context(help_to_compile())
            command = getattr(import_module(f"imgcal.cli.{first}"), first.capitalize())
        return command(**vars(given))
    # The shell's completion knows the options of every command; all else ends here, and names and summaries will do.
    load = _arguments if first.startswith("--tyro-") else _summary
    if first and not first.startswith("-"):
        near = difflib.get_close_matches(first, COMMANDS, 1)
        hint = f"did you mean `{near[0]}`?" if near else "see imgcal --help"
        raise InputError(f"unknown command `{shorten(first)}`; {hint}")
    commands: Any = Union[tuple(Annotated[load(name), tyro.conf.subcommand(name)] for name in COMMANDS)]  # noqa: UP007
    return tyro.cli(commands, prog="imgcal", description=DESCRIPTION, args=arguments)


def _move_objects_last(command: str, arguments: list[str]) -> list[str]:
    """Move the names of objects to the end, where nothing else can be taken for one more.

    Several may follow `--object` where the input stands first. Elsewhere what follows the first name is the input.
    """
    several = command == "simulate" or not arguments[:1] or not arguments[0].startswith("-")
    if command not in SEVERAL_OBJECTS:
        return arguments
    others, names, most = list[str](), list[str](), 0
    for argument in arguments:
        if argument == "--object":
            most = len(arguments) if several else 1
        elif most and not argument.startswith("-"):
            names.append(argument)
            most -= 1
        else:
            others.append(argument)
            most = 0
    return [*others, "--object", *names] if names else arguments


def _check_values(given: Any, arguments: list[str]) -> None:
    """Refuse options of several values that were given without any: they would have no effect.

    Raises:
        InputError: names the first of them.
    """
    for entry in fields(given):
        option = f"--{entry.name.replace('_', '-')}"
        if entry.default == () and getattr(given, entry.name) == () and option in arguments:
            raise InputError(f"{option}: found no value, expected one or more")


def _arguments(name: str) -> Any:
    with end_at_once():
        return getattr(import_module("imgcal.cli.arguments"), name.capitalize())


def _join_help_lines() -> None:
    """Give tyro the help of every option on one line: it would keep the line breaks of a docstring in the source."""
    kinds = import_module("imgcal.cli.arguments")
    for node in ast.parse(inspect.getsource(kinds)).body:
        if not isinstance(node, ast.ClassDef):
            continue
        options = {option.name: option for option in fields(getattr(kinds, node.name))}
        for entry, after in pairwise(node.body):
            match entry, after:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(words))):
                    options[name].metadata = MappingProxyType({"help": " ".join(words.split())})


def _summary(name: str) -> Any:
    """A command without options, and the first paragraph of its help."""
    words = (_arguments(name).__doc__ or "").partition("\n\n")[0]
    return make_dataclass(name.capitalize(), (), namespace={"__doc__": words})


def _strip_boxes(box: str, arguments: list[str]) -> str:
    """Strip the box that tyro draws around a message about a command line."""
    rows = (line.strip("│╭╮╰╯─| ") for line in box.splitlines()[1:])
    text = " ".join(row for row in rows if row.strip("-+"))
    problem, _, hint = text.partition("For full helptext, ")
    problem = problem.partition("Argument helptext:")[0].replace("__tyro-dummy-inner__.", "")
    command = re.search(r"imgcal[a-z ]* --help", hint)
    short = _shorten(problem.strip(), arguments)
    return f"{short}{' See' if short.endswith('?') else '; see'} {command[0] if command else 'imgcal --help'}"


def list_options(command: str) -> list[str]:
    """List the options of a command, without importing the command itself."""
    if command not in COMMANDS:
        return []

    def names(kind: Any) -> list[str]:
        hints = get_type_hints(kind)
        nested = [name for hint in hints.values() if is_dataclass(hint) for name in names(hint)]
        return [f"--{field.name.replace('_', '-')}" for field in fields(kind)] + nested

    return names(_arguments(command))


def _shorten(problem: str, arguments: list[str]) -> str:
    """Describe the first problem of a command line in a few words."""
    command = arguments[0]
    if unknown := re.search(r"Unrecognized options: (.*?)(?: Perhaps you meant:? (.*))?$", problem):
        words, near = unknown[1].split(", "), re.search(r"--[\w.-]+", unknown[2] or "")
        options = [word for word in words if word.startswith("-")]
        if not options:
            word, _, kinds = " ".join(words).partition(" Available subcommands: ")
            if not kinds:
                return f"unexpected argument `{quote(word)}`"
            close = difflib.get_close_matches(word, kinds.split(), 1)
            return f"unknown `imgcal {command} {quote(word)}`" + (
                f"; did you mean `{close[0]}`?" if close else f", expected {_list_alternatives(kinds.split())}"
            )
        option = options[0].split()[0]
        close = [near[0]] if near else difflib.get_close_matches(option.partition("=")[0], list_options(command), 1)
        return f"unknown option `{shorten(option)}`" + (f"; did you mean `{close[0]}`?" if close else "")
    if problem.startswith("Missing from"):
        entries = problem.partition(": ")[2].split("(required)")[:-1]
        parts = [entry.split() for entry in entries]
        named = [p[0] if p[0].startswith("--") else f"{p[0]} ({' '.join(p[1:])})" for p in parts if p]
        needed = ONE_OF.get(command, ())
        if needed and not set(needed) & {argument.partition("=")[0] for argument in arguments}:
            named.append(" or ".join(needed))
        return f"missing {', '.join(named)}"
    if choice := re.search(r"[Ii]nvalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*?),?\)", problem):
        words = {word.strip("' ") for word in choice[3].split(",")} - {"None", ""}
        known = sorted(words, key=lambda word: (word.isdigit() and int(word), word))
        close = difflib.get_close_matches(choice[1], known, 1)
        hint = f"; did you mean {close[0]}?" if close else ""
        option = f"{choice[2]}: " if choice[2].startswith("-") else ""
        return f"{option}found {shorten(choice[1])}, expected {_list_alternatives(known)}{hint}"
    if group := re.match(r"Expected one of \{(.*)\}", problem):
        return f"expected {_list_alternatives(group[1].split(', '))} after `imgcal {command}`"
    if short := re.search(r"Missing value for argument '(\S+)'\. Expected (\d+) values", problem):
        return f"{short[1]}: found too few values, expected {short[2]}"
    if count := re.search(
        r"Error parsing (\S+): .*input length (\d+) did not match expected argument count (\d+)", problem
    ):
        return f"{count[1]}: found {count[2]} values, expected {count[3]}"
    if number := re.search(r"Error parsing (\S+): .*(?:base 10|to float): '(.*?)'", problem):
        kind = "an integer" if "base 10" in problem else "a number"
        return f"{number[1]}: found {shorten(number[2])}, expected {kind}"
    if union := re.search(r"Error parsing (\S+): no type matching .* from \[(.*?)\]\. Got errors", problem):
        numbers = re.search(r"tuple\[((?:(?:float|int)(?:, )?)+)\]", problem)
        expected = f"{len(numbers[1].split(', '))} numbers" if numbers else "another value"
        return f"{union[1]}: found {shorten(union[2].replace(chr(39), '').replace(',', ''))}, expected {expected}"
    return re.sub(r"\[/?[a-z ]+\]|^Error parsing \w+: ", "", problem)


def _list_alternatives(words: list[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}" if len(words) > 1 else words[0]


def _verdict(error: BaseException, given: list[str]) -> tuple[int, str]:
    """Translate a failure into an exit code and a message."""
    match error:
        case InputError():
            return UNUSABLE, str(error)
        case OSError():
            place = f"{quote(str(error.filename))}: " if error.filename else ""
            return UNUSABLE, place + (error.strerror or quote(str(error)))
        case RefusedError():
            return REFUSED, error.for_command
        case KeyboardInterrupt():
            return INTERRUPTED, str(error) or "interrupted"
        case ModuleNotFoundError() if lacking := advice(error.name):
            return UNUSABLE, f"{next((word for word in given if word in COMMANDS), 'this')} {lacking}"
        case MemoryError():
            return UNUSABLE, f"not enough memory for this input ({str(error) or 'MemoryError'}); {DEBUG} shows where"
    ours = [frame for frame in traceback.extract_tb(error.__traceback__) if "imgcal" in Path(frame.filename).parts]
    place = f" ({Path(ours[-1].filename).name}:{ours[-1].lineno})" if ours else ""
    what = quote(f"{type(error).__name__}: {error}")
    return UNUSABLE, f"internal error{place}: {what}; this is a bug in imgcal; {DEBUG} shows where"


def run() -> None:
    """Run the command line of this process, and end it."""
    if not sys.warnoptions and DEBUG not in sys.argv:
        warnings.simplefilter("ignore")  # remarks of other libraries; what matters to the user is in our one line
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # paths may hold bytes that are no text
    sys.exit(main())

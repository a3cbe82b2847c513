"""Notice and speed up compilation: the first run of a command on a machine compiles its functions."""

from __future__ import annotations

import contextlib
import hashlib
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import imgcal
from imgcal.machine import usable_cores

HELPER = "helper"
"""Lock of the process that compiles in the background."""
GO_ON = b"go on"
"""Sent to the helper when the command has ended."""
LOOKS = 9
"""Counts of running processes, of which the median counts."""
THREADS = "OMP_NUM_THREADS"
HINT = "compiling for this machine: 10 to 60 s, once; `imgcal warmup` compiles everything ahead of time"
WAIT = "waiting for another process that compiles for this machine"


class Helper(subprocess.Popen[bytes]):
    """A process that goes on after the command that started it."""

    def __del__(self) -> None:
        """Leave it alone; Python would warn that it is forgotten."""


_helpers: list[Helper] = []  # processes that compile for this one


@contextlib.contextmanager
def announce_compilation(hint: str = HINT) -> Iterator[list[object]]:
    """Print one notice on standard error when the first function is compiled, here or in another process.

    Args:
        hint: what to say.

    Yields:
        A list that gets an entry for each function that is compiled.
    """
    compiled: list[object] = []
    if "numba" not in sys.modules:  # nothing that this command does is compiled
        yield compiled
        return
    from numba.core import event

    from renderers.compiling import WAITING

    said: list[str] = []

    def say(notice: str) -> None:
        if not said:
            print(f"imgcal: {notice}", file=sys.stderr, flush=True)
        said.append(notice)

    class Told(event.Listener):
        def on_start(self, happening: event.Event) -> None:
            say(hint)
            compiled.append(happening.data)

        def on_end(self, happening: event.Event) -> None:
            pass

    class Waiting(event.Listener):
        def on_start(self, happening: event.Event) -> None:
            say(hint if _helpers else WAIT)

        def on_end(self, happening: event.Event) -> None:
            pass

    listeners = {"numba:compile": Told(), WAITING: Waiting()}
    for kind, listener in listeners.items():
        event.register(kind, listener)
    try:
        yield compiled
    finally:
        for kind, listener in listeners.items():
            event.unregister(kind, listener)


@contextlib.contextmanager
def help_to_compile() -> Iterator[None]:
    """Compile in a second process, while this one imports modules and interprets what is not compiled yet.

    The second process goes on until all that a calibration needs is compiled, but ends if the command is interrupted.
    Without one, every function is compiled before it is called.
    """
    with contextlib.ExitStack() as stack:
        helped = is_helped()
        if not helped and is_useful():
            with contextlib.suppress(OSError):  # alone, then
                stack.enter_context(_run_helper())
                helped = True
        if helped:
            stack.enter_context(_interpret())
        yield


@contextlib.contextmanager
def _run_helper() -> Iterator[None]:
    helper = start_helper()
    _helpers.append(helper)
    said = GO_ON
    try:
        yield
    except KeyboardInterrupt:
        said = b""  # it ends, too
        raise
    finally:
        _helpers.remove(helper)
        if helper.stdin is not None:
            with contextlib.suppress(BrokenPipeError), helper.stdin:
                helper.stdin.write(said)


@contextlib.contextmanager
def _interpret() -> Iterator[None]:
    from renderers.interpreting import interpret_first

    # PyTorch's threads wait for one another in busy loops, and the helper has one of the cores.
    given = os.environ.get(THREADS)
    os.environ[THREADS] = given or str(max(1, usable_cores() - 1))
    try:
        with interpret_first():
            yield
    finally:
        if given is None:
            os.environ.pop(THREADS, None)
        else:
            os.environ[THREADS] = given


def is_useful() -> bool:
    """Tell whether a second process can compile beside this one, and leave it where this one finds it."""
    return bool(sys.executable) and is_lacking() and usable_cores() - _load() > 1


def is_lacking() -> bool:
    """Tell whether the machine code of a calibration is incomplete in the folder that processes share."""
    import numba

    from renderers.compiling import is_shared

    return not numba.config.DISABLE_JIT and is_shared() and not completion_mark().exists()  # type: ignore[attr-defined]


def completion_mark() -> Path:
    """The file that says, in the folder of compiled code, that all that a calibration needs is there.

    Its name depends on what the code depends on: Python, numba, the processor and the sources.
    """
    import numba
    from llvmlite.binding import get_host_cpu_name  # type: ignore[import-untyped]

    from renderers.compiling import cache_folder

    package = Path(imgcal.__file__).parents[1]
    files = sorted(path for name in ("imgcal", "renderers") for path in (package / name).rglob("*.py"))
    state = [sys.implementation.cache_tag, numba.__version__, get_host_cpu_name()]
    for path in files:
        status = path.stat()
        state.append(f"{path.relative_to(package)} {status.st_size} {status.st_mtime_ns}")
    return Path(cache_folder(), f"complete-{hashlib.sha256(repr(state).encode()).hexdigest()[:16]}")


def is_helped() -> bool:
    """Tell whether the helper of an earlier command is still compiling."""
    from renderers.compiling import is_held

    return is_held(HELPER)


def _load() -> float:
    """Other processes that want a core: this one and a helper gain nothing if they have to share one.

    The average of the last minute would count the installation that comes right before the first command.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):  # not Linux
        return statistics.median(_count_running() for _ in range(LOOKS))
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):  # not known on this system
        return 0.0


def _count_running() -> int:
    """Count the other processes of this machine that are running or waiting for a core, in a millisecond."""
    time.sleep(0.001)
    return int(Path("/proc/loadavg").read_text("ascii").split()[3].split("/")[0]) - 1


def start_helper() -> Helper:
    """Start `imgcal.cli.background_compiler` in a second process, which has this package and says nothing."""
    # Not from the current folder, which anybody may have filled.
    path = os.pathsep.join(filter(None, (str(Path(imgcal.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    environment = os.environ | {"PYTHONPATH": path, THREADS: "1"}
    command, nothing = [sys.executable, "-P", "-m", "imgcal.cli.background_compiler"], subprocess.DEVNULL
    return Helper(
        command, stdin=subprocess.PIPE, stdout=nothing, stderr=nothing, env=environment, start_new_session=True
    )

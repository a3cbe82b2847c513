"""Compile functions by numba's `njit`, with one folder for the machine code.

Machine code is kept in NUMBA_CACHE_DIR if that is set, else in `imgcal/<version>` in the user's cache folder: an
installation may be read-only, and code of an earlier version must not be used for this one. A read-only folder, such as
one in a container image that was warmed up when it was built, is used as it is.

Machine code includes the functions it calls and the constants. Numba compiles a function again when its own file
changes. Here it is also compiled again when one of the files that its file imports changes.

Processes that share a folder wait for each other: one compiles a function, the others load it.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import event, sigutils
from numba.core.compiler_lock import global_compiler_lock

from renderers.interpreting import Interpretable
from renderers.sources import source_digest

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Function = TypeVar("Function", bound=Callable[..., Any])

LOCKS = ".locks"
WAITING = "imgcal:waiting"
"""Kind of the event that lasts while another process compiles what this one needs."""


def njit(*, heavy: bool = False, **options: Any) -> Callable[[Function], Function]:
    """Apply `numba.njit` with the cache of this package.

    Args:
        heavy: the function treats every pixel or pair, and is too slow to be interpreted (`renderers.interpreting`).
        options: of `numba.njit`.
    """
    # Functions are called from Python or compiled code only: a wrapper for C costs a tenth of the compilation.
    options = {"cache": True, "no_cfunc_wrapper": True} | options

    def decorate(function: Function) -> Function:
        if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # for coverage and debuggers
            return function
        _RESTING.ours.add(function)
        # Numba chooses the folder when it decorates. Restore the setting afterwards: other packages use their own.
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, cache_folder()  # type: ignore[attr-defined]
        try:
            compiled = numba.njit(**options)(function)
            if options["cache"]:
                _keep_cached(compiled)
            Interpretable(compiled, heavy, partial(is_held, _name(compiled)))
            return cast(Function, compiled)
        except RuntimeError:  # nowhere to write: compiled in every process
            return cast(Function, numba.njit(**(options | {"cache": False}))(function))
        finally:
            numba.config.CACHE_DIR = before  # type: ignore[attr-defined]

    return decorate


def _name(compiled: Any) -> str:
    return f"{compiled.py_func.__module__}.{compiled.py_func.__qualname__}"


def _keep_cached(compiled: Any) -> None:
    """Keep machine code until one of its sources changes, and let one process at a time compile the function.

    The others load what that one has saved. Numba numbers the files of a function's signatures without a lock: if two
    processes saved at once, one might find the code of the other under its own name.
    """
    compiled._cache._cache_file._source_stamp = source_digest(compiled.py_func.__module__)
    name = _name(compiled)
    compile_now = compiled.compile

    def compile_alone(signature: Any) -> Any:
        if tuple(sigutils.normalize_signature(signature)[0]) in compiled.overloads:
            return compile_now(signature)
        # Numba's own lock comes first, as it does for a function that is compiled on behalf of another: threads that
        # took the two in different orders would wait for each other.
        with global_compiler_lock, hold(name, wait=True):
            return compile_now(signature)

    compiled.compile = compile_alone


@contextlib.contextmanager
def hold(name: str, wait: bool = False) -> Iterator[bool]:
    """Hold a lock that all processes with the same folder know, unless another holds it.

    Args:
        name: of the lock; functions are locks while they are compiled.
        wait: until the other gives it up.

    Yields:
        Whether the lock is held. True also on systems without such locks.
    """
    free = True
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a file system without locks, or a folder that cannot be written
            if fcntl and cache_folder():
                lock = stack.enter_context(_lock_file(name).open("a"))
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    free = wait
                    if wait:
                        with event.trigger_event(WAITING, data=name):
                            fcntl.flock(lock, fcntl.LOCK_EX)
        yield free


def is_held(name: str) -> bool:
    """Tell whether a lock is held, by another process or another thread."""
    with contextlib.suppress(FileNotFoundError):
        if fcntl and cache_folder():
            with Path(cache_folder(), LOCKS, name).open() as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
                except BlockingIOError:
                    return True
                except OSError:  # a file system without locks
                    return False
    return False


def _lock_file(name: str) -> Path:
    folder = Path(cache_folder(), LOCKS)
    folder.mkdir(exist_ok=True)
    return folder / name


class _Rest(event.Listener):
    """Pause Python's garbage collector while a function of ours is compiled: it takes an eighth of that time."""

    def __init__(self) -> None:
        self.ours: set[Callable[..., Any]] = set()
        self.depth, self.enabled = 0, False

    def on_start(self, happening: event.Event) -> None:
        if self.depth or happening.data["dispatcher"].py_func in self.ours:
            if not self.depth:
                self.enabled = gc.isenabled()
                gc.disable()
            self.depth += 1

    def on_end(self, happening: event.Event) -> None:
        if self.depth:
            self.depth -= 1
            if not self.depth and self.enabled:
                gc.enable()


_RESTING = _Rest()
event.register("numba:compile", _RESTING)


@cache
def cache_folder() -> str:
    """The folder of compiled code; empty = numba chooses it."""
    given = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    folder = Path(given) if given else _user_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        return given
    return str(folder) if writable else _link_folder(folder)


def is_shared() -> bool:
    """Tell whether this process shares compiled code with others."""
    given = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    return fcntl is not None and cache_folder() == str(Path(given) if given else _user_folder())


def _user_folder() -> Path:
    user = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path("~/.cache").expanduser()
    try:
        release = version("imgcal")
    except PackageNotFoundError:  # a checkout that is not installed
        release = "0"
    return Path(user) / "imgcal" / release


def _link_folder(folder: Path) -> str:
    """Make a writable folder for this process, with links to all files of a read-only folder, for numba to use."""
    links = Path(tempfile.mkdtemp(prefix="imgcal-compiled-"))
    shutil.copytree(folder, links, copy_function=os.symlink, dirs_exist_ok=True)
    process = os.getpid()
    atexit.register(lambda: shutil.rmtree(links, ignore_errors=True) if os.getpid() == process else None)
    return str(links)

"""Interpret compiled functions until their machine code is there, so that a first, small task need not wait for it.

A compiled function is Python source, and Python can run that, too: hundreds of times more slowly, but a capture of a
few snapshots needs seconds for what takes half a minute to compile. Within `interpret_first`, a function without
machine code is interpreted. It is compiled once interpreting it has taken as long as compiling it would, or where its
arrays are large, and loaded once another process has compiled it.
"""

from __future__ import annotations

import contextlib
import inspect
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Result = TypeVar("Result")

SECONDS_PER_BYTE = 6e-4
"""Seconds that a function takes to compile for each byte of its bytecode, roughly."""
MOST_ELEMENTS = 20_000
"""Elements of 8 bytes in the arrays of a call that is interpreted; pixels, which have fewer bytes, do not count."""
LOOK_EVERY = 0.05
"""Seconds between looks for machine code of another process."""

_patience: float | None = None  # as in `interpret_first`; None = compile every function before its first call


@contextlib.contextmanager
def interpret_first(patience: float = 1.0) -> Iterator[None]:
    """Let functions without machine code be interpreted.

    Args:
        patience: a function is compiled once interpreting it has taken this many times the estimated time of its
            compilation, or if its arrays are large; 0 = at once; infinite = only if they are large.
    """
    global _patience
    before, _patience = _patience, patience
    try:
        yield
    finally:
        _patience = before


class _Thread(threading.local):
    """What a thread is doing."""

    interpreting = False
    called = 0.0  # seconds in functions that the one being interpreted has called


_thread = _Thread()


class Interpretable:
    """A compiled function that can be interpreted, and how long that has taken so far."""

    def __init__(self, compiled: Any, heavy: bool, is_being_compiled: Callable[[], bool]) -> None:
        """Decide from now on, whenever there is no machine code for the arguments of a call, what is called.

        Args:
            compiled: numba's dispatcher.
            heavy: interpret it only while it is being compiled.
            is_being_compiled: tells whether another process, or another thread, is compiling it.
        """
        self.compiled, self.is_being_compiled = compiled, is_being_compiled
        self.compile_for, compiled._compile_for_args = compiled._compile_for_args, self.choose
        self.function, code = compiled.py_func, compiled.py_func.__code__
        self.variadic = bool(code.co_flags & inspect.CO_VARARGS)
        self.seconds = SECONDS_PER_BYTE * len(code.co_code)  # of compilation
        self.limit = 0.0 if heavy else self.seconds
        self.spent, self.last_look = 0.0, 0.0
        self.index: tuple[int, set[Any]] = (0, set())  # when machine code was stored last, and for which arguments
        compiled.interpretable = self

    def choose(self, *arguments: Any, **named: Any) -> Any:
        """Return what is to be called with these arguments: machine code, or Python."""
        if _patience is None or named or self.function.__defaults__:
            return self.compile_for(*arguments, **named)
        if self._is_stored(arguments):
            return self._compile(*arguments)
        is_due = self._has_been_patient(self.limit) or _count_elements(arguments) > MOST_ELEMENTS
        return self._compile(*arguments) if is_due and not self.is_being_compiled() else self.interpret

    def interpret(self, *arguments: Any) -> Any:
        """Call the function as Python, and count the time without that of the functions that it calls."""
        if self.variadic:  # numba packs the rest
            arguments = (*arguments[:-1], *arguments[-1])
        outermost, around = not _thread.interpreting, _thread.called
        _thread.interpreting, _thread.called = True, 0.0
        started = time.thread_time()
        try:
            if not outermost:
                return self.function(*arguments)
            with np.errstate(all="ignore"):  # machine code does not warn
                return self.function(*arguments)
        finally:
            taken = time.thread_time() - started
            self.spent += taken - _thread.called
            _thread.interpreting, _thread.called = not outermost, around + taken

    def call_twin(self, twin: Callable[..., Result], *arguments: Any) -> Result:
        """Call another function that does the same, and count its time."""
        started = time.thread_time()
        try:
            return twin(*arguments)
        finally:
            self.spent += time.thread_time() - started

    def _compile(self, *arguments: Any) -> Any:
        started = time.thread_time()
        try:
            return self.compile_for(*arguments)
        finally:
            _thread.called += time.thread_time() - started

    def is_ready(self) -> bool:
        """Tell whether to call the function rather than its twin: it has machine code, or is to be compiled now."""
        if _patience is None or self.compiled.overloads:
            return True
        seconds = sum(one.seconds for one in self._with_callees if not one.compiled.overloads)
        return self._has_been_patient(seconds) and not self.is_being_compiled()

    def _has_been_patient(self, seconds: float) -> bool:
        """Tell whether calls without machine code have taken long enough, if compiling it takes some seconds."""
        return _patience is not None and not math.isinf(_patience) and self.spent >= _patience * seconds

    @cached_property
    def _with_callees(self) -> set[Interpretable]:
        """The function and those that it calls, directly or not."""
        found, new = {self}, [self]
        while new:
            function = new.pop().function
            named = inspect.getclosurevars(function)
            values = [*named.globals.values(), *named.nonlocals.values()]
            modules = filter(inspect.ismodule, values)
            values += [getattr(module, name, None) for module in modules for name in named.unbound]
            for value in values:
                called: Interpretable | None = getattr(value, "interpretable", None)
                if called is not None and called not in found:
                    found.add(called)
                    new.append(called)
        return found

    def _is_stored(self, arguments: tuple[Any, ...]) -> bool:
        """Tell whether machine code for these arguments was in the cache at the last look."""
        cache, now = self.compiled._cache, time.perf_counter()
        if now - self.last_look > LOOK_EVERY:
            self.last_look = now
            try:
                stored = Path(cache._cache_file._index_path).stat().st_mtime_ns
            except (AttributeError, OSError):  # a function that is not kept; nothing stored yet
                return False
            if stored != self.index[0]:
                self.index = stored, set(cache._cache_file._load_index())
        if not self.index[1]:
            return False
        types = tuple(map(self.compiled.typeof_pyval, arguments))
        return cache._index_key(types, self.compiled.targetctx.codegen()) in self.index[1]


def without_machine_code(function: Any) -> Interpretable | None:
    """Return what counts the calls of a function's twin; None = call the function itself.

    Examples:
        >>> from renderers.compiling import njit
        >>> add = njit(cache=False)(lambda x, y: x + y)
        >>> without_machine_code(add) is None
        True
    """
    interpretable: Interpretable | None = getattr(function, "interpretable", None)
    return None if interpretable is None or interpretable.is_ready() else interpretable


def _count_elements(arguments: Iterable[Any]) -> int:
    """Count those elements of arrays, also of arrays in tuples, that have 8 bytes."""
    count = 0
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            count += argument.size if argument.itemsize == 8 else 0
        elif isinstance(argument, tuple):
            count += _count_elements(argument)
    return count

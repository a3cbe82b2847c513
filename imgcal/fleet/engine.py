"""Distribute work over the cores of this machine or of a cluster with Ray, in batches.

What is done depends on the items alone, never on who does them: seeds belong to items, and results come with them.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from imgcal.errors import InputError, RefusedError
from imgcal.fleet.manifest import short_reason
from imgcal.machine import usable_cores
from imgcal.messages import quote

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Batches in flight for each core: one that runs and one that waits."""
ATTEMPTS = 2
"""Of an item by itself, before its process's death is taken for its fault."""
GRACE = 120.0  # s that a batch may take beyond the limits of its items: starting a process on a machine that is busy
PATIENCE = 15.0  # s until somebody at an address must have answered
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + b"\4" + bytes(5)
"""What an HTTP/2 client begins with, empty settings included; a gRPC server answers it with settings of its own."""
QUIET = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "TQDM_DISABLE": "1"}


@dataclass(frozen=True)
class Done(Generic[Item, Result]):
    """Results of a batch, one an item."""

    items: Sequence[Item]
    results: Sequence[Result]


@dataclass(frozen=True)
class Lost(Generic[Item]):
    """An item that kills its process, or does not end."""

    item: Item
    timed_out: bool
    reason: str


@dataclass
class _Batch(Generic[Item]):
    items: Sequence[Item]
    attempts: int = 0
    deadline: float = field(default=float("inf"))


class Engine:
    """A Ray cluster for the duration of a block: this machine's cores, or a running cluster.

    Examples:
        >>> with Engine(cores=1) as engine:  # doctest: +SKIP
        ...     list(engine.map(len, ["a", "bb"]))
        [1, 2]
    """

    def __init__(self, address: str | None = None, cores: int | None = None) -> None:
        """Choose where to run.

        Args:
            address: of a running cluster's head; None = start processes here.
            cores: of this machine; None = all that this process may use.
        """
        self.address = address
        self.cores = cores or usable_cores()
        self._ours = False

    def __enter__(self) -> Engine:
        """Connect, or start.

        Raises:
            InputError: there is no cluster at the address.
        """
        import ray

        if not ray.is_initialized():
            if self.address is not None:
                _ask(self.address)
            where: dict[str, Any] = {"address": self.address}
            if self.address is None:
                os.environ.setdefault("RAY_worker_niceness", "0")  # as nice as who calls, not 15 more
                where = {"address": "local", "num_cpus": self.cores, "include_dashboard": False}
            handler = signal.getsignal(signal.SIGTERM)
            try:
                ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
                if handler is not None and threading.current_thread() is threading.main_thread():
                    signal.signal(signal.SIGTERM, handler)  # instead of Ray's, which prints a stack and aborts
            except Exception as error:
                if self.address is None:
                    raise InputError(f"Ray cannot be started on this machine: {short_reason(error)}") from error
                raise InputError(f"--address: found no cluster at {self.address}: {short_reason(error)}") from error
            self._ours = True
        self.cores = int(ray.cluster_resources().get("CPU", self.cores))
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the cluster, or end it."""
        import ray

        if self._ours:
            ray.shutdown()
            self._ours = False

    def run(
        self,
        function: Callable[..., Sequence[Result]],
        batches: Iterable[Sequence[Item]],
        *shared: Any,
        seconds: float | None = None,
    ) -> Iterator[Done[Item, Result] | Lost[Item]]:
        """Do batches, whichever is ready first; no more are read than are needed to keep all cores busy.

        Args:
            function: takes a batch and what is shared, returns a result for each item. Called in other processes.
            batches: read as they are needed.
            shared: further arguments, sent once to each machine.
            seconds: that an item may take; one that takes longer is stopped with its process. None = no limit.

        Yields:
            Results, and each item that is lost. A batch whose process died is done again, item by item.
        """
        import ray

        task = ray.remote(function).options(num_cpus=1, max_retries=0, runtime_env={"env_vars": QUIET})
        references = [ray.put(value) for value in shared]
        source, again = iter(batches), deque[_Batch[Item]]()
        running: dict[Any, _Batch[Item]] = {}
        ended = False
        try:
            while True:
                while len(running) < AHEAD * self.cores and not (ended and not again):
                    batch = again.popleft() if again else _next(source)
                    if batch is None:
                        ended = True
                        continue
                    if seconds is not None:  # it may wait for those ahead of it
                        waiting = sum(len(other.items) for other in running.values()) + len(batch.items)
                        batch.deadline = time.monotonic() + seconds * waiting + GRACE
                    running[task.remote(batch.items, *references)] = batch
                if not running:
                    return
                ready, _ = ray.wait(list(running), num_returns=1, timeout=1.0)
                for reference in ready:
                    yield from self._settle(reference, running.pop(reference), again)
                for reference in [r for r, batch in running.items() if time.monotonic() > batch.deadline]:
                    batch = running.pop(reference)
                    with contextlib.suppress(Exception):
                        ray.cancel(reference, force=True)
                    yield from _split(batch, again, timed_out=True, reason="did not end")
        finally:
            for reference in running:
                with contextlib.suppress(Exception):
                    ray.cancel(reference, force=True)

    def _settle(
        self, reference: Any, batch: _Batch[Item], again: deque[_Batch[Item]]
    ) -> Iterator[Done[Item, Result] | Lost[Item]]:
        import ray

        try:
            yield Done(batch.items, ray.get(reference))
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, InputError | RefusedError):  # one line, for people
                raise error.cause from None
            raise error.as_instanceof_cause() from None
        except ray.exceptions.NodeDiedError:
            again.append(batch)  # no fault of its own
        except ray.exceptions.RayError as error:
            yield from _split(batch, again, timed_out=False, reason=short_reason(error))

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        arrived: Callable[[Item, Result], None] = lambda item, result: None,
    ) -> Iterator[Result]:
        """Do items one at a time, results in the order of the items: the numbers of one process, only sooner.

        Args:
            function: of an item; sent once to each machine.
            items: read as they are needed.
            arrived: told of each result at once, whichever comes first.

        Raises:
            RuntimeError: an item takes its process down.
        """
        results: dict[int, Result] = {}
        numbered = ([(number, item)] for number, item in enumerate(items))
        first = 0
        for outcome in self.run(_each, numbered, function):
            if isinstance(outcome, Lost):
                raise RuntimeError(f"item {outcome.item[0]} took its process down: {outcome.reason}")
            for (number, item), (_, result) in zip(outcome.items, outcome.results, strict=True):
                arrived(item, result)
                results[number] = result
            while first in results:
                yield results.pop(first)
                first += 1


def _ask(address: str) -> None:
    """Make sure that a gRPC server listens at an address: Ray would wait for one for minutes.

    Raises:
        InputError: no cluster answers.
    """
    if address in ("auto", "local"):
        return
    expected = "expected the head of a running Ray cluster, HOST:PORT as printed by `ray start --head`"
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdecimal():
        raise InputError(f"--address: found {quote(address)}, {expected}")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), PATIENCE) as connection:
            if os.environ.get("RAY_USE_TLS", "0") != "1":
                connection.settimeout(PATIENCE)
                connection.sendall(PREFACE)
                if connection.recv(4)[3:] != b"\4":
                    raise InputError(f"--address: found something that is not Ray at {address}, {expected}")
    except (OSError, OverflowError) as error:
        raise InputError(f"--address: found no cluster at {address} ({short_reason(error)}), {expected}") from error


def _each(items: Sequence[tuple[int, Item]], function: Callable[[Item], Result]) -> list[tuple[int, Result]]:
    return [(number, function(item)) for number, item in items]


def _next(source: Iterator[Sequence[Item]]) -> _Batch[Item] | None:
    items = next(source, None)
    return None if items is None else _Batch(items)


def _split(batch: _Batch[Item], again: deque[_Batch[Item]], *, timed_out: bool, reason: str) -> Iterator[Lost[Item]]:
    """Find the item that made a batch fail: run each by itself."""
    if len(batch.items) > 1:
        again.extend(_Batch([item]) for item in batch.items)
    elif timed_out or batch.attempts + 1 >= ATTEMPTS:
        yield Lost(batch.items[0], timed_out, reason)
    else:
        again.append(_Batch(batch.items, batch.attempts + 1))

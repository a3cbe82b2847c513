"""Work items of sweeps and campaigns: in this process, on this machine's cores or on a cluster, the same bit for bit.

What comes of an item depends on the item: seeds and random numbers travel with it. It is computed by one thread
wherever that is, and results come in the order of the items; so the worker of an item does not matter.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

import imgcal
from imgcal.errors import InputError
from imgcal.extras import advice, missing
from imgcal.fleet.engine import Engine
from imgcal.io import write_bytes

Item = TypeVar("Item")
Result = TypeVar("Result")


class Mapper(Protocol):
    """The function that `workers` yields, called like `map`."""

    def __call__(self, function: Callable[[Item], Result], items: Iterable[Item], /) -> Iterator[Result]:
        """Call the function for each item; results come in the order of the items."""
        ...


@dataclass(frozen=True)
class StoredResults:
    """Results of items in a folder, a file each, so that stopped work can resume.

    An item is known by its attribute `key` or, without one, by its `repr`; results are dicts, lists, numbers, strings
    and tensors.
    """

    folder: Path
    scope: str  # what results depend on beside the items and the code of imgcal

    def path(self, item: Any) -> Path:
        """Where the result of an item lies."""
        said = f"{_code()}\n{self.scope}\n{getattr(item, 'key', None) or repr(item)}"
        return self.folder / f"{hashlib.blake2b(said.encode(), digest_size=16).hexdigest()}.pt"

    def get(self, item: Any) -> Any | None:
        """Read the result of an item; None if it is not done, or its file is damaged."""
        try:
            return torch.load(io.BytesIO(self.path(item).read_bytes()), weights_only=True)
        except Exception:
            return None  # it is done again

    def put(self, item: Any, result: Any) -> None:
        """Store the result of an item, in one step.

        Raises:
            InputError: the folder cannot be written.
        """
        content = io.BytesIO()
        torch.save(result, content)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_bytes(self.path(item), content.getvalue())
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be written: {error.strerror or error}") from error

    def clear(self) -> None:
        """Delete everything: the work is done, and its result is stored elsewhere."""
        shutil.rmtree(self.folder, ignore_errors=True)


@lru_cache(maxsize=1)
def _code() -> str:
    """Digest of the package's code: results of other code are not reused."""
    digest = hashlib.blake2b(imgcal.__version__.encode(), digest_size=16)
    for path in sorted(Path(imgcal.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@contextlib.contextmanager
def workers(
    address: str | None = None, cores: int | None = None, kept: StoredResults | None = None
) -> Iterator[Mapper]:
    """Return a function that maps over items, in this process or in workers.

    Args:
        address: of a running Ray cluster; None = this machine.
        cores: of this machine; None = all; 1 = this process does it, without Ray.
        kept: what has been done before, and where to keep what is done now.

    Yields:
        A function that takes a function and items, like `map`.

    Raises:
        InputError: the engine is not installed, or there is no cluster at the address.

    Examples:
        >>> with workers(cores=1) as mapped:
        ...     list(mapped(len, ["a", "bb"]))
        [1, 2]
    """
    if address is None and cores == 1:
        yield _resume(_run_here, kept)
        return
    if cores is not None and cores < 1:
        raise InputError(f"--cores: found {cores}, expected at least 1")
    if lacking := missing("ray"):
        raise InputError(f"{'--cores' if address is None else '--address'} {advice(lacking)}")
    with Engine(address, cores) as engine:
        yield _resume(engine.map, kept)


def _run_here(
    function: Callable[[Item], Result], items: Iterable[Item], arrived: Callable[[Item, Result], None]
) -> Iterator[Result]:
    for item in items:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            result = function(item)
        finally:
            torch.set_num_threads(threads)
        arrived(item, result)
        yield result


def _resume(mapped: Callable[..., Iterator[Any]], kept: StoredResults | None) -> Mapper:
    """Skip stored results, and merge them back in order."""

    def plainly(function: Callable[[Item], Result], items: Iterable[Item], /) -> Iterator[Result]:
        return mapped(function, items, lambda item, result: None)

    def resumed(function: Callable[[Item], Result], items: Iterable[Item], /) -> Iterator[Result]:
        assert kept is not None
        known: deque[Any] = deque()  # in the order of the items; None = somebody is at it

        def unknown() -> Iterator[Item]:
            for item in items:
                known.append(kept.get(item))
                if known[-1] is None:
                    yield item

        for result in mapped(function, unknown(), kept.put):
            while known[0] is not None:
                yield known.popleft()
            known.popleft()
            yield result
        yield from known

    return plainly if kept is None else resumed

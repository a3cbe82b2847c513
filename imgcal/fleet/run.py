"""A manifest in, a dataset of recalibrations out: what is missing or changed, once."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from imgcal.fleet.dataset import ROWS, SECONDS, Dataset, Keys
from imgcal.fleet.engine import Engine, Lost
from imgcal.fleet.job import Settings, Status, current_key, failed_row, process
from imgcal.fleet.manifest import Item, Manifest

BATCH = 32
"""Captures that travel together."""


@dataclass
class FleetCount:
    """Progress of a run."""

    total: int | None = None  # rows of the manifest, where that is known
    read: int = 0  # rows of the manifest that came back
    known: int = 0  # of these done before, unchanged
    status: Counter[str] = field(default_factory=Counter)  # of the others


def recalibrate_fleet(
    manifest: Manifest,
    dataset: Dataset,
    engine: Engine,
    settings: Settings = Settings(),
    *,
    again: bool = False,
    tell: Callable[[FleetCount], None] = lambda count: None,
    batch: int = BATCH,
) -> FleetCount:
    """Recalibrate every capture of a manifest that the dataset does not have yet.

    Args:
        manifest: which captures.
        dataset: where results go.
        engine: who does it.
        settings: how each is treated.
        again: try once more what timed out, crashed or ran out of memory.
        tell: called as results come.
        batch: captures that travel together.

    Raises:
        InputError: the manifest cannot be read, or the dataset not be written. What was written stays.
    """
    count = FleetCount(manifest.count())
    known = dataset.keys(again=again, rigs=settings.keep_rig)
    with dataset.open_writer() as writer:
        flushed = time.monotonic()
        outcomes = engine.run(_process, manifest.batches(batch), settings, known.freeze(), seconds=settings.seconds)
        for outcome in outcomes:
            if isinstance(outcome, Lost):
                status: Status = "timed_out" if outcome.timed_out else "crashed"
                row = failed_row(outcome.item, status, outcome.reason)  # its process took the key along
                rows: Sequence[dict[str, Any] | None] = [row | {"key": current_key(outcome.item, settings)}]
            else:
                rows = outcome.results
            fresh = list(_new_rows(rows, known))
            count.read += len(rows)
            count.known += len(rows) - len(fresh)
            count.status.update(row["status"] for row in fresh)
            writer.add(fresh)
            if writer.waiting >= ROWS or time.monotonic() - flushed > SECONDS:
                writer.flush()
                flushed = time.monotonic()
            tell(count)
    return count


def _new_rows(rows: Sequence[dict[str, Any] | None], known: Keys) -> Iterator[dict[str, Any]]:
    """Rows without a result; a capture that occurs twice in a manifest is processed once."""
    for row in rows:
        if row is not None and row["key"] not in known:
            known.add([row["key"]])
            yield row


def _process(items: Sequence[Item], settings: Settings, known: Keys) -> list[dict[str, Any] | None]:
    torch.set_num_threads(1)
    return [process(item, settings, known) for item in items]

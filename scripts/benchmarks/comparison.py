"""Compare benchmarks with the committed ones, cell by cell; fail if imgcal has become slower relative to its peers.

Usage: scripts/benchmark --compare [benchmark ...], which measures first; for existing results:
python -m scripts.benchmarks.comparison out/compare

The machine's speed differs between runs. Each time of imgcal is therefore divided by that of the peers in the same
table and run, and a cell reports the growth of this ratio. A table without peers uses the peers of its file, a file
without any those of all files. Sizes (megabytes) are compared directly.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from imgcal.errors import InputError
from scripts.output import ROOT, command, markdown, read_json

COMMITTED = ROOT / "docs" / "benchmarks"
LIMIT = 1.15
"""Growth from which a cell fails; the same code stays below it on a busy machine."""
PEERS = (
    "clearing", "cv2", "hungarian", "kornia", "mrcal", "nearest projection", "numpy", "opencv", "photutils", "pyceres",
    "pycolmap", "python", "rig votes", "scipy", "skimage", "threshold", "trackpy", "warp",
)  # fmt: skip
"""Substrings of the names of peers; a name with "imgcal" is not a peer."""
MEDIANS = ("p50", "ms_p50")
SIZES = ("megabytes", "memory_mb")
LABELS = ("name", "n", "kind", "count", "points", "side", "fiducials", "cell")
"""Keys that identify the rows of a list."""

Key = tuple[str, ...]


@dataclass(frozen=True)
class Cells:
    """Numbers of one result, by their keys."""

    ms: Mapping[Key, float]
    megabytes: Mapping[Key, float]

    @property
    def ours(self) -> list[Key]:
        """Keys of imgcal's times."""
        return [key for key in self.ms if not is_peer(key)]


@dataclass(frozen=True)
class Change:
    """Change of one cell."""

    benchmark: str
    cell: str
    before: float
    after: float
    growth: float  # of the ratio to the peers; inf = no longer measured


def is_peer(key: Key) -> bool:
    """Tell whether a number belongs to a peer."""
    return any(peer in part.lower() for part in key for peer in PEERS if "imgcal" not in part.lower())


def cells_of(result: Mapping[str, Any]) -> Cells:
    """Collect all medians and sizes of a result."""
    ms, megabytes = {}, {}
    for key, value in _leaves(result, ()):
        if key[-1] in MEDIANS:
            ms[key[:-1]] = value
        elif key[-1] in SIZES:
            megabytes[key] = value
        elif key[0] == "growth" and key[-1] not in LABELS:  # tables whose numbers are ms
            ms[key] = value
    return Cells(ms, megabytes)


def _leaves(part: Any, key: Key) -> Iterator[tuple[Key, float]]:
    if isinstance(part, Mapping):
        for name, value in part.items():
            yield from _leaves(value, (*key, str(name)))
    elif isinstance(part, list):
        for number, value in enumerate(part):
            yield from _leaves(value, (*key, _label(value, number)))
    elif isinstance(part, (int, float)) and not isinstance(part, bool):
        yield key, float(part)


def _label(row: Any, number: int) -> str:
    told = [str(row[name]) for name in LABELS if name in row] if isinstance(row, Mapping) else []
    return " ".join(told) or str(number)


def compare(before: Mapping[str, Mapping[str, Any]], after: Mapping[str, Mapping[str, Any]]) -> list[Change]:
    """Compare results of the same benchmarks, by name; return the change of each cell of imgcal, the worst first.

    Peers' cells that are in only one of the runs (if a peer is not installed) are not used.
    """
    old, new = ({name: cells_of(result) for name, result in results.items()} for results in (before, after))
    slower = {
        name: {
            key: _ratio(new[name].ms[key], ms) for key, ms in cells.ms.items() if is_peer(key) and key in new[name].ms
        }
        for name, cells in old.items()
    }
    everywhere = [ratio for ratios in slower.values() for ratio in ratios.values()]
    changes = []
    for name, cells in old.items():
        for key in cells.ours:
            found = new[name].ms.get(key)
            beside = [ratio for other, ratio in slower[name].items() if _table(other) == _table(key)]
            machine = _typical(beside or [*slower[name].values()] or everywhere)
            growth = math.inf if found is None else _ratio(found, cells.ms[key]) / machine
            changes.append(Change(name, ", ".join(key), cells.ms[key], math.nan if found is None else found, growth))
        for key, size in cells.megabytes.items():
            if not is_peer(key):
                found = new[name].megabytes.get(key, math.nan)
                growth = math.inf if math.isnan(found) else _ratio(found, size)
                changes.append(Change(name, ", ".join(key), size, found, growth))
    return sorted(changes, key=lambda change: -change.growth)


def _table(key: Key) -> Key:
    """Key of the group that a cell is compared in: a row of a table, or the rows of a list."""
    names = [
        number for number, part in enumerate(key) if part in ("methods", "rows", "time", "rig", "finders", "start-up")
    ]
    if names:
        return (*key[: names[-1] + 1], *key[names[-1] + 2 :])
    return key[:-1]


def _ratio(after: float, before: float) -> float:
    return after / before if before > 0 else (1.0 if after <= 0 else math.inf)


def _typical(ratios: Sequence[float]) -> float:
    """Geometric mean; 1 for no values."""
    known = [math.log(ratio) for ratio in ratios if 0 < ratio < math.inf]
    return math.exp(sum(known) / len(known)) if known else 1.0


def table(changes: Sequence[Change], limit: float) -> str:
    """Make a table of the cells that fail, and of the ten with the largest growth."""
    shown = [change for number, change in enumerate(changes) if number < 10 or change.growth > limit]
    rows = [
        (change.benchmark, change.cell, f"{change.before:.4g}", _figure(change.after), _grown(change.growth, limit))
        for change in shown
    ]
    return markdown(("benchmark", "cell", "committed", "now", "growth beside the peers"), rows)


def _figure(value: float) -> str:
    return "not measured" if math.isnan(value) else f"{value:.4g}"


def _grown(growth: float, limit: float) -> str:
    text = "gone" if math.isinf(growth) else f"{growth:.2f}"
    return f"**{text}**" if growth > limit else text


def results_in(folder: Path, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Read results of benchmarks.

    Raises:
        InputError: one is missing.
    """
    for name in names:
        if not (folder / f"{name}.json").is_file():
            raise InputError(f"{folder}: found no {name}.json, expected the result of that benchmark")
    return {name: read_json(folder / f"{name}.json") for name in names}


def report(measured: Path, names: Sequence[str], committed: Path = COMMITTED, limit: float = LIMIT) -> int:
    """Print the changes of the cells; return the number of those that fail."""
    changes = compare(results_in(committed, names), results_in(measured, names))
    failed = sum(change.growth > limit for change in changes)
    print(table(changes, limit))
    print(f"\n{len(changes)} cells compared, {failed} beyond {limit:g} times the committed ratio to their peers")
    return failed


@dataclass(frozen=True)
class Options:
    """Compare results of benchmarks with the committed ones; fail if imgcal is slower relative to its peers."""

    measured: Annotated[Path, tyro.conf.Positional]
    """Folder of the results of a run: NAME.json."""
    names: tuple[str, ...] = ()
    """Benchmarks to compare; default: all that are in both folders."""
    committed: Path = COMMITTED
    """Folder of the results to compare with."""
    limit: float = LIMIT
    """Growth of the ratio to the peers beyond which a cell fails."""


def main() -> int:
    """Compare results according to the command line.

    Raises:
        InputError: there is nothing to compare.
    """
    options = tyro.cli(Options, description=__doc__)
    suite = [path.stem for path in sorted(options.measured.glob("*.json"))]
    names = options.names or [name for name in suite if (options.committed / f"{name}.json").is_file()]
    if not names:
        raise InputError(f"{options.measured}: found no result of a benchmark that is also in {options.committed}")
    return report(options.measured, names, options.committed, options.limit)


if __name__ == "__main__":
    command(lambda: sys.exit(bool(main())))

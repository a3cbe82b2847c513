"""Compare benchmarks with the committed ones, cell by cell, and fail where imgcal has become slower than its peers.

Usage: scripts/benchmark --compare [benchmark ...], which measures first; of results that lie in a folder already:
python -m scripts.benchmarks.comparison out/compare

Two runs never meet the same machine. So each time of imgcal is divided by that of the peers in its own table and run:
what a cell reports is by how much that ratio has grown. A table without peers takes the peers of its file, a file
without any takes those of all files. Sizes (megabytes) are compared as they are.
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
"""Growth of a cell that fails: what a busy machine makes of the same code stays below."""
PEERS = (
    "clearing", "cv2", "hungarian", "kornia", "mrcal", "nearest projection", "numpy", "opencv", "photutils", "pyceres",
    "pycolmap", "python", "rig votes", "scipy", "skimage", "threshold", "trackpy", "warp",
)  # fmt: skip
"""What names of peers contain; a name with "imgcal" is none."""
MEDIANS = ("p50", "ms_p50")
SIZES = ("megabytes", "memory_mb")
LABELS = ("name", "n", "kind", "count", "points", "side", "fiducials", "cell")
"""What tells rows of a list apart."""

Key = tuple[str, ...]


@dataclass(frozen=True)
class Cells:
    """Figures of one result, by their place in it."""

    ms: Mapping[Key, float]
    megabytes: Mapping[Key, float]

    @property
    def ours(self) -> list[Key]:
        """Times that are imgcal's."""
        return [key for key in self.ms if not is_peer(key)]


@dataclass(frozen=True)
class Change:
    """What has become of one cell."""

    benchmark: str
    cell: str
    before: float
    after: float
    growth: float  # of the ratio to the peers; inf = it is measured no more


def is_peer(key: Key) -> bool:
    """Tell whether a figure is that of a peer."""
    return any(peer in part.lower() for part in key for peer in PEERS if "imgcal" not in part.lower())


def cells_of(result: Mapping[str, Any]) -> Cells:
    """Find all medians and sizes of a result."""
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
    """Compare results of the same benchmarks, by name: what has become of each cell of imgcal, the worst first.

    Cells that only one of the peers' runs has (a peer that is not installed) make no ratio.
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
    """What stands beside each other: figures of one row of a table, or of rows of one list."""
    names = [
        number for number, part in enumerate(key) if part in ("methods", "rows", "time", "rig", "finders", "start-up")
    ]
    if names:
        return (*key[: names[-1] + 1], *key[names[-1] + 2 :])
    return key[:-1]


def _ratio(after: float, before: float) -> float:
    return after / before if before > 0 else (1.0 if after <= 0 else math.inf)


def _typical(ratios: Sequence[float]) -> float:
    """Geometric mean, 1 of none."""
    known = [math.log(ratio) for ratio in ratios if 0 < ratio < math.inf]
    return math.exp(sum(known) / len(known)) if known else 1.0


def table(changes: Sequence[Change], limit: float) -> str:
    """Table of the cells that fail, and of the ten that have grown most."""
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
        InputError: one is not there.
    """
    for name in names:
        if not (folder / f"{name}.json").is_file():
            raise InputError(f"{folder}: found no {name}.json, expected the result of that benchmark")
    return {name: read_json(folder / f"{name}.json") for name in names}


def report(measured: Path, names: Sequence[str], committed: Path = COMMITTED, limit: float = LIMIT) -> int:
    """Print what has become of the cells; return the number of those that fail."""
    changes = compare(results_in(committed, names), results_in(measured, names))
    failed = sum(change.growth > limit for change in changes)
    print(table(changes, limit))
    print(f"\n{len(changes)} cells compared, {failed} beyond {limit:g} times the committed ratio to their peers")
    return failed


@dataclass(frozen=True)
class Options:
    """Compare results of benchmarks with the committed ones; fail where imgcal has lost against its peers."""

    measured: Annotated[Path, tyro.conf.Positional]
    """Folder of the results of a run: NAME.json."""
    names: tuple[str, ...] = ()
    """Benchmarks to compare; all that lie in both folders if none is named."""
    committed: Path = COMMITTED
    """Folder of the results to compare with."""
    limit: float = LIMIT
    """Growth of the ratio to the peers beyond which a cell fails."""


def main() -> int:
    """Compare as the command line says.

    Raises:
        InputError: there is nothing to compare.
    """
    options = tyro.cli(Options, description=__doc__)
    suite = [path.stem for path in sorted(options.measured.glob("*.json"))]
    names = options.names or [name for name in suite if (options.committed / f"{name}.json").is_file()]
    if not names:
        raise InputError(f"{options.measured}: found no result of a benchmark that {options.committed} has, too")
    return report(options.measured, names, options.committed, options.limit)


if __name__ == "__main__":
    command(lambda: sys.exit(bool(main())))

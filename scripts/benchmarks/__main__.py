"""Benchmark imgcal and its peers: ``scripts/benchmark``, or ``... blobs splatting``.

Rewrites docs/benchmarks/tables.md.

A benchmark is a module of this folder with three functions: ``measure(effort)`` returns plain values,
``tables(result)`` makes Markdown tables by the names of their markers in the page,
``draw(result, path)`` writes one plot.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from subprocess import run
from typing import Annotated, Any, Protocol

import tyro

from imgcal.errors import InputError
from imgcal.io import write_text
from scripts.benchmarks import comparison
from scripts.benchmarks.effort import Effort
from scripts.output import ROOT, command, make_folder, markdown, read_json, replaced, surroundings, write_json

# In the order of the page, with their duration in minutes.
BENCHMARKS = {
    "recalibration": 8,
    "blobs": 2,
    "projection": 2,
    "splatting": 2,
    "identity": 3,
    "end_to_end": 3,
    "networks": 2,
    "footprint": 1,
}
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
RESULTS = ROOT / "docs" / "benchmarks"


class Benchmark(Protocol):
    """Interface of the modules of this folder."""

    def measure(self, effort: Effort) -> dict[str, Any]: ...
    def tables(self, result: Mapping[str, Any]) -> dict[str, str]: ...
    def draw(self, result: Mapping[str, Any], path: Path) -> None: ...


@dataclass(frozen=True)
class Options:
    """Measure imgcal and its peers, on the same data in the same run."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Benchmarks to run; default: all."""
    smoke: bool = False
    """Run a minimal version of each, in two minutes, to check that it works."""
    compare: bool = False
    """Measure into out/compare, leaving the committed results and the page unchanged, and fail if a cell is slower
    relative to its peers than in the committed results (1.15 times). For every change, and before a release."""
    out: Path | None = None
    """Folder of the results, NAME.json and NAME.png; docs/benchmarks, or out/benchmarks for a smoke run."""

    @property
    def folder(self) -> Path:
        """Folder of the results."""
        if self.out is not None:
            return self.out
        aside = "compare" if self.compare else "benchmarks" if self.smoke else None
        return RESULTS if aside is None else ROOT / "out" / aside

    @property
    def page(self) -> Path:
        """Page of all tables, rewritten from the results in its folder."""
        return self.folder / "tables.md"


def main(arguments: list[str]) -> int:
    """Run the named benchmarks, each in its own process, and rewrite the page.

    Raises:
        InputError: unknown name, or nothing to compare with.
    """
    options = tyro.cli(Options, args=arguments, prog="scripts/benchmark", description=__doc__)
    for name in options.names:
        if name not in BENCHMARKS:
            raise InputError(f"{name}: not a benchmark, expected one of {', '.join(BENCHMARKS)}")
    make_folder(options.folder)
    failed = []
    if len(options.names) == 1:  # in this process, to show the traceback of an error
        _measure(options.names[0], options)
    else:
        for name in options.names or BENCHMARKS:
            again = [name, "--out", str(options.folder), *["--smoke"] * options.smoke]
            failed += [name] * bool(run([sys.executable, "-m", "scripts.benchmarks", *again], cwd=ROOT).returncode)
    if not options.compare:
        _rewrite(options)
    for name in failed:
        print(f"{name}: failed; its old result is kept", file=sys.stderr)
    if options.compare and not failed:
        return comparison.report(options.folder, options.names or tuple(BENCHMARKS))
    return len(failed)


def _measure(name: str, options: Options) -> None:
    module, begin = _module(name), time.monotonic()
    print(f"{name}: about {BENCHMARKS[name]} minutes" * (not options.smoke) or f"{name}: smoke", file=sys.stderr)
    before = surroundings()
    result = module.measure(Effort(smoke=options.smoke))
    result = before | {"seconds": round(time.monotonic() - begin)} | result
    write_json(options.folder / f"{name}.json", result)
    module.draw(result, options.folder / f"{name}.png")
    for title, table in module.tables(read_json(options.folder / f"{name}.json")).items():
        print(f"\n{title}\n\n{table}", flush=True)


def _rewrite(options: Options) -> None:
    found = {name: path for name in BENCHMARKS if (path := options.folder / f"{name}.json").is_file()}
    results = {name: read_json(path) for name, path in found.items()}
    rows = [
        (name, *(str(result[key]) for key in ("machine", "load_average", "seconds")))
        for name, result in results.items()
    ]
    texts = {"machine": markdown(("benchmark", "machine", "load average before", "seconds"), rows)}
    for name, result in results.items():
        texts |= _module(name).tables(result)
    page = options.page if options.page.is_file() else PAGE
    write_text(options.page, replaced(page.read_text("utf-8"), texts, page))


def _module(name: str) -> Benchmark:
    return import_module(f"scripts.benchmarks.{name}")


if __name__ == "__main__":
    command(lambda: sys.exit(main(sys.argv[1:])))

"""Choose the slow tests, which a default run skips, from the durations of a full run.

    python -m pytest --slow --numprocesses auto --dist loadfile --durations=0 > durations.log
    python -m scripts.slow_tests durations.log          # rewrites tests/slow_tests.txt

Tests are added to the list, slowest first, until the rest fits into the budget.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imgcal.io import write_text
from scripts.output import ROOT

LIST = ROOT / "tests" / "slow_tests.txt"
LINE = re.compile(r"^\s*([\d.]+)s (?:call|setup|teardown)\s+(\S+?)(?:\[.*\])?\s*$")
HEAD = """# Slow tests, by the start of their node ids, and their seconds: several workers begin with the slowest files.
# CI=true or `scripts/test --slow` runs them.
# Generated from measured durations by: python -m scripts.slow_tests DURATIONS.log
"""


@dataclass(frozen=True)
class Options:
    """Rewrite the list of slow tests."""

    log: Annotated[Path, tyro.conf.Positional]  #: output of pytest with --durations=0
    seconds: float = 400.0  #: time budget for the rest, on one core
    out: Path = LIST


def slowest(log: str, seconds: float) -> dict[str, float]:
    """List the slowest tests and their seconds, until the others fit into `seconds`.

    Parametrized cases of a test count together.
    """
    spent: dict[str, float] = {}
    for line in log.splitlines():
        if found := LINE.match(line):
            spent[found[2]] = spent.get(found[2], 0.0) + float(found[1])
    left, named = sum(spent.values()), dict[str, float]()
    for name, took in sorted(spent.items(), key=lambda one: -one[1]):
        if left <= seconds:
            break
        named[name] = took
        left -= took
    return named


def main() -> None:
    """Read the durations, choose the slow tests, and write the list."""
    options = tyro.cli(Options, description=__doc__)
    named = slowest(options.log.read_text(), options.seconds)
    write_text(options.out, HEAD + "".join(f"{name} {took:.1f}\n" for name, took in sorted(named.items())))
    print(f"{len(named)} tests in {options.out}")


if __name__ == "__main__":
    main()

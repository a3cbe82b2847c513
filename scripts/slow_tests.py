"""Choose the slow tests, which a default run skips, from the durations of a full run.

    python -m pytest --slow --numprocesses auto --dist loadfile --durations=0 > durations.log
    python -m scripts.slow_tests durations.log          # rewrites tests/slow_tests.txt

Tests are added to the list, slowest first, until the rest fits into the budget. A file whose tests share a long setup
is listed as a whole: whichever test came first would need it.
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
LINE = re.compile(r"^\s*([\d.]+)s (call|setup|teardown)\s+(\S+?)(?:\[.*\])?\s*$")
LONG_SETUP = 5.0
"""Seconds of a setup that makes a file one entry."""
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

    Parametrized cases of a test count together, and so do all tests of a file with a long setup.
    """
    lines = [(float(found[1]), found[2], found[3]) for line in log.splitlines() if (found := LINE.match(line))]
    whole = {name.partition("::")[0] for took, part, name in lines if part == "setup" and took >= LONG_SETUP}
    spent: dict[str, float] = {}
    for took, _, name in lines:
        file = name.partition("::")[0]
        entry = file if file in whole else name
        spent[entry] = spent.get(entry, 0.0) + took
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

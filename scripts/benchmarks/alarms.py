"""Can the alarms be trusted? Long runs of steady and drifting rigs, and rigs with bumped cameras.

Work is divided into items, each with its own seed, for the cores of a machine or a cluster. Finished items are kept in
a file, one per line, so that a run can be stopped and resumed. `monitor` items feed labelled fiducials to `RigMonitor`,
`keeper` items unlabelled blobs among false ones to `RigKeeper`.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import tyro

from imgcal.fleet import Mapper, workers
from scripts.benchmarks.alarms_runs import Item, run
from scripts.benchmarks.alarms_tables import draw, summarized, tables
from scripts.benchmarks.rig_streams import Conditions
from scripts.output import ROOT, command, fill, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "alarms.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
PLOT = ROOT / "docs" / "benchmarks" / "alarms.png"
ITEMS = ROOT / "out" / "alarms" / "items.jsonl"

COUNTS = {
    "monitor steady": 145, "monitor drifting": 145, "monitor bump": 500, "monitor sweep": 240, "monitor two": 60,
    "monitor away": 60, "monitor half degree": 60, "monitor creep": 4, "monitor whole rig": 40,
    "keeper steady": 20, "keeper drifting": 20, "keeper bump": 120,
    "monitor shaking": 20, "keeper shaking": 20, "keeper shaking bump": 40, "keeper knock bump": 60,
    "keeper noisy": 20, "keeper lens": 20,
}  # fmt: skip
"""Items of each experiment; those without a bump add up to eight hours of snapshots."""

PACE = {"monitor bump": 1.0, "monitor steady": 3.0, "monitor drifting": 3.0}
"""When all bumps are done, a third of the long experiments is done, and a fifth of the others."""
OTHERS = 5.0


def items(share: float, only: tuple[str, ...] = tuple(COUNTS)) -> list[Item]:
    """All items or a share of them, in an order in which all experiments proceed together, each at its `PACE`."""
    wanted = {name: max(1, round(share * count)) for name, count in COUNTS.items() if name in only}
    every = [
        (seed / count * PACE.get(name, OTHERS), Item(name, seed))
        for name, count in wanted.items()
        for seed in range(count)
    ]
    return [item for _, item in sorted(every, key=lambda pair: pair[0])]


def done(path: Path) -> list[dict[str, Any]]:
    """Finished items; a truncated line is ignored."""
    if not path.exists():
        return []
    lines = path.read_text("utf-8").splitlines()
    entries = [json.loads(line) for line in lines if line.endswith("}")]
    return list({entry["key"]: entry for entry in entries}.values())


def go_on(options: Options, mapped: Mapper = map) -> None:
    """Run the unfinished items."""
    path = options.items
    known = {entry["key"] for entry in done(path)}
    left = [item for item in items(options.share, options.only) if item.key not in known]
    path.parent.mkdir(parents=True, exist_ok=True)
    until = time.monotonic() + 60 * options.minutes
    in_time = takewhile(lambda item: time.monotonic() < until, left)
    with path.open("a", encoding="utf-8") as out:
        for found in mapped(run, in_time):
            out.write(json.dumps(found) + "\n")
            out.flush()
            print(found["key"], found["cpu_s"], "s", file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Options:
    """Run unfinished items, and write the results so far."""

    minutes: float = 60.0
    """Start no item later than this; the next run resumes."""
    address: str | None = None  #: running Ray cluster to run on; None = this machine
    cores: int | None = 1  #: of this machine; 1 = this process alone; None = all
    share: float = 1.0
    """Share of the items of each experiment."""
    only: tuple[str, ...] = tuple(COUNTS)  #: experiments to run; the results of others are kept
    items: Path = ITEMS  #: file with a line for each finished item
    out: Path = RESULT  #: only this path also rewrites the page and the plot


def main() -> None:
    """Run the items, then count, write and print the results."""
    options = tyro.cli(Options, description=__doc__)
    with workers(options.address, options.cores) as mapped:
        go_on(options, mapped)
    official = options.out.resolve() == RESULT
    known = json.loads(RESULT.read_text("utf-8"))["found"] if official and RESULT.exists() else {}
    anew = summarized([entry for entry in done(options.items) if entry["name"] in options.only])
    result: dict[str, Any] = {
        **surroundings(),
        "noise_px": Conditions().noise,
        "found": {name: (known | anew)[name] for name in COUNTS if name in known | anew},
    }
    write_json(options.out, result)
    written = tables(result)
    if official:
        draw(result, PLOT)
        fill(PAGE, written)
    print("\n\n".join(written.values()))


if __name__ == "__main__":
    command(main)

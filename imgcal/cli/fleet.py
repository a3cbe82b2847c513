"""`imgcal fleet`: many captures, recalibrated on all cores or a cluster, and what they teach together."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from imgcal.cli import arguments
from imgcal.cli.common import EVERY, check_folder, open_rig
from imgcal.cli.interruption import unwind_at_termination
from imgcal.errors import InputError, RefusedError
from imgcal.extras import advice, missing
from imgcal.fleet import (
    HOURS,
    Dataset,
    Engine,
    FleetCount,
    KindOfRig,
    LearntPrior,
    Manifest,
    Settings,
    Spread,
    rig_kinds,
)
from imgcal.fleet import recalibrate_fleet as recalibrate
from imgcal.io import load_object, write_text, yaml_text
from imgcal.messages import plural
from imgcal.types import RigPrior

NEEDED = ("ray", "pyarrow", "fsspec", "filelock")


class Fleet(arguments.Fleet):
    """Run `imgcal fleet`."""

    def run(self) -> None:
        """Recalibrate, then learn."""
        if lacking := missing(*NEEDED):
            raise InputError(f"imgcal fleet {advice(lacking)}")
        check_folder(self.out)
        for name, value in (("--seconds", self.seconds), ("--memory-mb", self.memory_mb), ("--batch", self.batch)):
            if not 0 < value < 1e9:
                raise InputError(f"{name}: found {value:g}, expected more than 0")
        before = RigPrior() if self.rig is None else open_rig(self.rig).prior or RigPrior()
        if self.object is not None:
            load_object(self.object)  # an error that concerns all captures is reported now
        manifest, dataset = Manifest(self.manifest, self.rig, self.object), Dataset(self.out)
        if self.cores is not None and self.cores < 1:
            raise InputError(f"--cores: found {self.cores}, expected at least 1")
        manifest.check()
        with dataset.open_writer():
            pass  # it can be written, and no other run is using it
        settings = Settings(self.blind_cameras, self.detector, self.seconds, self.memory_mb, self.keep_rigs)
        started = time.perf_counter()
        with unwind_at_termination(), Engine(self.address, self.cores) as engine, _show_progress() as tell:
            count = recalibrate(manifest, dataset, engine, settings, again=self.again, tell=tell, batch=self.batch)
        print(f"{_print_line(count)}, {time.perf_counter() - started:.0f} s: {dataset.folder}")
        if self.keep_rigs:
            dataset.write_rigs(self.out / "rigs")
        self._learn(dataset, before)

    def _learn(self, dataset: Dataset, before: RigPrior) -> None:
        """Write the prior and the page."""
        taught: list[tuple[KindOfRig, LearntPrior | None, str]] = []
        kinds = rig_kinds(dataset)
        for name in self.covariates if kinds else ():
            if not any(name in (*kind.given, *kind.lacking) for kind in kinds):
                kinds[0].covariate(name)  # raises, and names those that there are
        for kind in kinds:
            try:
                taught.append((kind, kind.learn(self.covariates, by_camera=self.by_camera), ""))
            except (InputError, RefusedError) as error:
                taught.append((kind, None, str(error)))
        if taught and (learnt := taught[0][1]) is not None:
            found = {"prior": learnt.prior(), "drift_rate": learnt.drift_rate()}
            blocks = {name: _round(asdict(values)) for name, values in found.items() if values is not None}
            write_text(self.out / "prior.yaml", yaml_text(blocks))
            write_text(self.out / "lessons.json", json.dumps(_summary(taught[0][0], learnt), indent=2) + "\n")
            for spread in learnt.spreads:
                print(_describe(spread, learnt.hours))
            print(f"{plural(len(learnt.outliers), 'outlier camera')}; prior {self.out / 'prior.yaml'}")
        for kind in kinds:
            if HOURS in kind.lacking:
                print(f"note: {HOURS}: {kind.explain_lacking(HOURS)}; no rates were learned", file=sys.stderr)
        for _, _, reason in taught:
            if reason:
                print(f"note: no prior: {reason}", file=sys.stderr)
        if lacking := missing("jinja2"):
            print(f"note: no report.html, which {advice(lacking)}", file=sys.stderr)
            return
        from imgcal.report import Taught, write_fleet_report

        write_fleet_report(dataset, [Taught(*one) for one in taught], before, self.out / "report.html")
        print(f"report {self.out / 'report.html'}")


def _describe(spread: Spread, hours: float | None) -> str:
    camera = "" if spread.camera is None else f" of {spread.camera}"
    if not math.isfinite(spread.sigma):
        return f"{spread.kind}{camera}: no capture shows it; the prior keeps {spread.value:.4g}"
    shown = f"{spread.kind}{camera}: spread {spread.value:.4g} +- {spread.sigma:.1g}"
    if hours is None:
        return shown
    growth = f"{spread.rate:.4g} +- {spread.rate_sigma:.1g} in an hour"
    return f"{shown}, {growth}; {spread.variance(hours) ** 0.5:.4g} after {hours:.4g} h, the mean age"


def _round(values: dict[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.6g}") for name, value in values.items()}


def _without_infinity(values: dict[str, Any]) -> dict[str, Any]:
    """Values that JSON can hold: None for a standard deviation of what was not seen."""
    return {name: None if value == math.inf else value for name, value in values.items()}


def _summary(kind: KindOfRig, learnt: LearntPrior) -> dict[str, Any]:
    """What scripts read: every spread, outlier and slope."""
    outliers = [asdict(one) | {"device": kind.devices[one.device]} for one in learnt.outliers]
    return {
        "cameras": list(kind.cameras),
        "lenses": list(kind.lenses),
        "devices": len(kind.devices),
        "hours": learnt.hours,
        "spreads": [_without_infinity(asdict(spread)) for spread in learnt.spreads],
        "outliers": outliers,
        "trends": [
            asdict(trend) | {"name": name} for trend in learnt.trends if (name := kind.parameter_name(trend)) != "-"
        ],
    }


def _print_line(count: FleetCount) -> str:
    parts = [f"{number} {status.replace('_', ' ')}" for status, number in count.status.most_common()]
    known = f"{count.known} done before" if count.known else ""
    return ", ".join([plural(count.read, "capture"), *parts, *([known] if known else [])])


@contextmanager
def _show_progress() -> Iterator[Callable[[FleetCount], None]]:
    """Show the progress: a bar on a terminal, a line a minute elsewhere."""
    console = Console(file=sys.stderr)
    started = last = time.monotonic()
    if not console.is_terminal:

        def line(count: FleetCount) -> None:
            nonlocal last
            if time.monotonic() - last > EVERY:
                last = time.monotonic()
                print(f"{_print_line(count)}, {count.read / (last - started):.1f}/s", file=sys.stderr, flush=True)

        yield line
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=None)

        def show(count: FleetCount) -> None:
            rate = count.read / max(time.monotonic() - started, 1e-9)
            bar.update(task, description=f"{_print_line(count)}, {rate:.1f}/s", completed=count.read, total=count.total)

        yield show

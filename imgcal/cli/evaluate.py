"""`imgcal evaluate`: how good networks and classical methods are on random rigs."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from imgcal.cli import arguments
from imgcal.cli.arguments import Setting
from imgcal.cli.common import check_folder, open_rig, progress_bar
from imgcal.cli.interruption import unwind_at_termination
from imgcal.errors import InputError
from imgcal.extras import advice, missing
from imgcal.fleet import StoredResults, workers
from imgcal.io import load_object, publishing
from imgcal.messages import plural

if TYPE_CHECKING:
    from imgcal.evaluation import Conditions, Facts, Method, Model, Protocol, Summary
    from imgcal.fleet import Mapper
    from imgcal.types import CameraRig

CHECKED_RIGS = 32
"""On which encoders are checked."""
TIMED_RIGS, TIMED_RIGS_SLOW = 50, 10
"""On which the latency of fast methods is measured, and that of slow ones."""
FEW = 8
"""Batches, or captures, that are done before Ray has started."""
WORK = ".work"
"""Folder beside results of what has been done, until all is."""


class Evaluate(arguments.Evaluate):
    """Run `imgcal evaluate`."""

    def run(self) -> None:
        """Evaluate, print and write."""
        evaluate_models(self.models, self.setting, self.baselines, self.out)


def evaluate_models(paths: tuple[Path, ...], setting: Setting, baselines: bool, out: Path | None) -> None:
    """Measure networks and baselines, print tables, and write them where `out` says."""
    # Imported late: what brings networks and plots along takes seconds, which the other commands should not wait.
    from imgcal.evaluation import BASELINES, PLOTS, QUICK_BASELINES, RESULT, TABLES, Protocol, write

    if out is not None:
        check_folder(out)
        if lacking := missing("matplotlib"):  # found out now, not when all is measured
            raise InputError(f"--out {advice(lacking)}")
    protocol = Protocol(setting.count, setting.trials, setting.seed)
    models = _load(paths, setting)
    conditions = _conditions(models, setting)
    methods = {model.name: model.method for model in models}
    methods |= _select_suited(BASELINES if baselines else QUICK_BASELINES, conditions.rig)
    each = f"{plural(protocol.trials, 'trial')} of {plural(protocol.count, 'random rig')}"
    kept = None if out is None else StoredResults(out / WORK, _scope(models))
    with open_workers(setting, protocol.batches, kept, models) as mapped:
        print(f"evaluating {', '.join(methods)} on {each} (--trials, --count)", file=sys.stderr, flush=True)
        summary = _measure(methods, conditions, protocol, setting, mapped)
    summary = replace(summary, facts={model.name: _check_model(model, conditions, setting) for model in models})
    _print_tables(summary)
    if out is not None:
        with publishing(out, (*PLOTS, TABLES, RESULT), mark=RESULT) as folder:
            written = write(summary, folder)
        for path in written:
            print(f"wrote {out / path.name}", file=sys.stderr)
    if kept is not None:
        kept.clear()


def _select_suited(methods: Mapping[str, Method], rig: CameraRig) -> dict[str, Method]:
    """Leave out networks that do not know the rig's lenses, and say so."""
    suited = {name: method for name, method in methods.items() if method.knows(rig)}
    if left := [name for name in methods if name not in suited]:
        lenses = ", ".join(dict.fromkeys(rig.lens_models))
        print(f"note: left out {' and '.join(left)}: no support for {lenses} lenses", file=sys.stderr)
    return suited


def _scope(models: list[Model]) -> str:
    """What the results depend on besides rigs and conditions: the weights."""
    return repr([(model.name, hashlib.sha256(model.path.read_bytes()).hexdigest()) for model in models])


@contextmanager
def open_workers(
    setting: Setting, batches: int, kept: StoredResults | None, models: Sequence[Model] = ()
) -> Iterator[Mapper]:
    """Worker processes, if the job is long enough to be worth starting them; on a GPU only this process."""
    cores = setting.cores
    if any(parameter.is_cuda for model in models for parameter in model.checkpoint.network.parameters()):
        if setting.address is not None or (cores or 1) > 1:
            raise InputError("--address, --cores: found a GPU, which only one process uses; add --device cpu")
        yield map
        return
    if setting.address is None and cores is None and (batches < FEW or missing("ray")):
        if batches >= FEW:
            print(f"note: running on one core: --cores {advice('ray')}", file=sys.stderr)
        cores = 1
    with unwind_at_termination(), workers(setting.address, cores, kept) as mapped:
        yield mapped


def _load(paths: tuple[Path, ...], setting: Setting) -> list[Model]:
    if not paths:
        return []
    import torch

    from imgcal.evaluation import load_models

    rig = None if setting.rig is None else open_rig(setting.rig)
    obj = None if setting.object is None else load_object(setting.object)
    device = "cuda" if setting.device == "auto" and torch.cuda.is_available() else "cpu"
    return load_models(paths, rig, obj, device, setting.trust)


def _conditions(models: list[Model], setting: Setting) -> Conditions:
    """The given conditions; the rest as the first model was trained."""
    from imgcal.evaluation import Conditions
    from imgcal.synthesis import LEVELS, Corruption, PoseRange, RelativeDrift

    if models:
        known = models[0].conditions
    elif setting.rig is None or setting.object is None:
        raise InputError("evaluate: found no model; without one, give --rig and --object")
    else:
        known = Conditions(open_rig(setting.rig), load_object(setting.object))
    poses: PoseRange = known.pose_range
    if setting.phi is not None:
        low, high = setting.phi
        if not 0 <= low <= high <= 180:
            raise InputError(f"--phi: found {low:g} {high:g}, expected two angles from 0 to 180, the smaller first")
        poses = replace(poses, phi_deg=(low, high))
    drift = known.drift if setting.kappa is None else RelativeDrift(setting.kappa, setting.kappa)
    corruption = Corruption(setting.noise, setting.missing, setting.swapped, setting.false)
    known = replace(known, pose_range=poses, drift=drift, corruption=corruption)
    if setting.level is None:
        return known
    if not 0 <= setting.level < len(LEVELS):
        raise InputError(f"--level: found {setting.level}, expected 0 to {len(LEVELS) - 1}")
    if not corruption.nothing:
        raise InputError("--level: cannot be used with --noise, --missing, --swapped or --false")
    return known.at_level(setting.level)


def _measure(
    methods: Mapping[str, Method], conditions: Conditions, protocol: Protocol, setting: Setting, mapped: Mapper
) -> Summary:
    from imgcal.evaluation import AXES, Summary, evaluate, latency, sweep

    fast = {name: method for name, method in methods.items() if method.most is None}
    along = replace(protocol, count=setting.sweep_count, trials=1)
    points = sum(len(AXES[axis].values) for axis in setting.sweep)
    shares = [min(method.most or protocol.count, protocol.count) for method in methods.values()]
    total = protocol.trials * (protocol.count + sum(shares)) + points * along.count * (1 + len(fast))
    with progress_bar("evaluating", total) as advance:
        evaluation = evaluate(methods, conditions, protocol, advance, mapped)
        sweeps = tuple(sweep(fast, conditions, axis, along, progress=advance, mapped=mapped) for axis in setting.sweep)
    repeats = {name: TIMED_RIGS if method.most is None else TIMED_RIGS_SLOW for name, method in methods.items()}
    took = {name: latency(method, conditions, repeats[name]) for name, method in methods.items()}
    return Summary(evaluation, took, {}, sweeps)


def _check_model(model: Model, conditions: Conditions, setting: Setting) -> Facts:
    """What is known of a network, with a check of its encoder on views without corruption."""
    from imgcal.evaluation import check_encoder
    from imgcal.synthesis import Corruption, Degradation

    clean = replace(conditions, corruption=Corruption(), degradation=Degradation())
    check = check_encoder(model.checkpoint.network, clean, CHECKED_RIGS, setting.seed)
    return replace(model.facts, encoder=check)


def _print_tables(summary: Summary) -> None:
    """Tables on standard output: for people on a terminal, as Markdown elsewhere."""
    from imgcal.evaluation import as_tables, describe, markdown

    if not sys.stdout.isatty():
        print(markdown(summary), end="")
        return
    console = Console()
    console.print(describe(summary.evaluation))
    for table in as_tables(summary):
        console.print(table.rich())

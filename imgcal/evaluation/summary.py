"""What an evaluation found, and the same in plain values for scripts."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from imgcal.evaluation.encoder_check import EncoderCheck
from imgcal.evaluation.protocol import REFERENCE, Conditions, Evaluation, Scores
from imgcal.evaluation.sweeps import Sweep
from imgcal.evaluation.timing import Latency
from imgcal.synthesis import RelativeDrift

FORMAT = "imgcal-evaluation/1"


@dataclass(frozen=True)
class Facts:
    """What is known about a network beside its errors."""

    parameters: int
    size: int  # bytes of the file
    history: tuple[dict[str, Any], ...] = ()  # rows of metrics.jsonl
    experiment: str | None = None  # what it was trained by; the same with another seed is another run of it
    seed: int = 0  # of its training
    encoder: EncoderCheck | None = None  # None = it has none, or was not asked


@dataclass(frozen=True)
class Summary:
    """Everything that is written."""

    evaluation: Evaluation
    latencies: Mapping[str, Latency] = field(default_factory=dict)  # by method
    facts: Mapping[str, Facts] = field(default_factory=dict)  # by method, of networks
    sweeps: tuple[Sweep, ...] = ()

    def groups(self) -> dict[str, tuple[str, ...]]:
        """Methods by the name of their line in tables: runs of one experiment that differ in the seed share a line."""
        runs: dict[str, dict[int, str]] = {}
        for name, facts in self.facts.items():
            if facts.experiment is not None:
                runs.setdefault(facts.experiment, {}).setdefault(facts.seed, name)
        shared = {name: experiment for experiment, by in runs.items() if len(by) > 1 for name in by.values()}
        found: dict[str, tuple[str, ...]] = {}
        for name in self.evaluation.rows:
            line = shared.get(name, name)
            found[line] = (*found.get(line, ()), name)
        return found


def as_values(summary: Summary) -> dict[str, Any]:
    """The summary in plain values, for scripts: keys stay; null where there is nothing or no finite number."""
    evaluation, protocol = summary.evaluation, summary.evaluation.protocol
    values = {
        "format": FORMAT,
        **_conditions(evaluation.conditions),
        "count": protocol.count,
        "trials": protocol.trials,
        "seed": protocol.seed,
        "machine": {
            "processor": platform.machine(),
            "torch": torch.__version__,
            "threads": torch.get_num_threads(),
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        },
        "reference": {"name": REFERENCE} | _scores(evaluation.reference),
        "methods": {
            name: {
                "passes": row.passes,
                "one_pass": None if row.one_pass is None else _scores(row.one_pass),
                "alone": _scores(row.alone),
                "refined": None if row.refined is None else _scores(row.refined),
                "latency_ms": asdict(summary.latencies[name]) if name in summary.latencies else None,
                "model": _facts(summary.facts.get(name)),
            }
            for name, row in evaluation.rows.items()
        },
        "seeds": {line: list(names) for line, names in summary.groups().items() if len(names) > 1},
        "sweeps": {sweep.axis: _sweep(sweep) for sweep in summary.sweeps},
    }
    return _finite(values)


def _conditions(conditions: Conditions) -> dict[str, Any]:
    drift, poses = conditions.drift, conditions.pose_range
    return {
        "rig": conditions.rig.name,
        "object": conditions.obj.name,
        "poses_deg": {name.removesuffix("_deg"): list(limits) for name, limits in vars(poses).items()},
        "drift": {"kind": "relative" if isinstance(drift, RelativeDrift) else "physical"} | vars(drift),
        "corruption": dict(vars(conditions.corruption)),
        "images": {name: value for name, value in vars(conditions.degradation).items() if name != "points"},
        "sigma_px": conditions.sigma,
    }


def _scores(scores: Scores) -> dict[str, Any]:
    return {
        "re_px": dict(scores.statistics()),
        "held_out_px": dict(scores.statistics("held_out")),
        "parameters": scores.parameters(),
        "cramer_rao_ratio": scores.cramer_rao_ratios(),
    }


def _facts(facts: Facts | None) -> dict[str, Any] | None:
    if facts is None:
        return None
    check = facts.encoder
    return {
        "parameters": facts.parameters,
        "bytes": facts.size,
        "experiment": facts.experiment,
        "seed": facts.seed,
        "encoder": None if check is None else asdict(check) | {"rise": check.rise, "used": check.used},
    }


def _sweep(sweep: Sweep) -> dict[str, Any]:
    def column(scores: Sequence[Scores | None]) -> list[dict[str, Any] | None]:
        return [None if one is None else dict(one.statistics()) for one in scores]

    names = list(sweep.evaluations[0].rows)
    return {
        "values": list(sweep.values),
        "reference": column([evaluation.reference for evaluation in sweep.evaluations]),
        "methods": {
            name: {
                "alone": column([evaluation.rows[name].alone for evaluation in sweep.evaluations]),
                "refined": column([evaluation.rows[name].refined for evaluation in sweep.evaluations]),
            }
            for name in names
        },
    }


def _finite(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: _finite(value) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [_finite(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values

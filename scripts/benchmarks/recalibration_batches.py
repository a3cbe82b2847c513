"""imgcal alone: batches of rigs, long captures, and the compiled solver compared with the tensor version."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from imgcal.estimation import (
    camera_covariance,
    estimate,
    initial_pose,
    initial_state,
    levenberg_marquardt,
    levenberg_marquardt_cpu,
    make_problem,
    squared,
)
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.recalibration_cases import SQUARED, Cases, make_cases
from scripts.timing import side_by_side

LIMITS = (SQUARED.max_iterations, SQUARED.tolerance)


def measure(effort: Effort) -> dict[str, Any]:
    """Time all cases; the compiled and the tensor solver must agree."""
    one, many = make_cases(1, 1, 5), make_cases(effort.pick(512, 8), 1, 6)
    long = make_cases(1, effort.pick(300, 20), 7)

    def run(cases: Cases, start: bool = True) -> Callable[[], object]:
        poses = cases.start if start else None
        given = (cases.observations, cases.factory, cases.obj, poses)
        return lambda: estimate(*given, prior_std=cases.prior_std, options=SQUARED)

    problem = make_problem(one.observations, one.factory, one.obj, one.prior_std)
    start = initial_state(problem, one.start, None)
    compiled = levenberg_marquardt_cpu.minimize(problem, start, "squared", 3.0, *LIMITS)
    tensors = levenberg_marquardt.minimize(problem, start, squared, *LIMITS)
    found = run(one)()
    rigs, snapshots = len(many), long.observations.uv.shape[1]
    cases = {
        "one snapshot, `estimate`": run(one),
        "one snapshot, start pose alone": lambda: initial_pose(one.observations, one.factory, one.obj),
        "one snapshot, compiled solver alone": lambda: levenberg_marquardt_cpu.minimize(
            problem, start, "squared", 3.0, *LIMITS
        ),
        "one snapshot, tensor solver alone": lambda: levenberg_marquardt.minimize(problem, start, squared, *LIMITS),
        "one snapshot, covariance": lambda: camera_covariance(found),  # type: ignore[arg-type]
        f"{rigs} rigs at once, one snapshot each": run(many),
        f"{rigs} rigs at once, without start poses": run(many, start=False),
        f"{snapshots} snapshots of one rig": run(long),
        f"{snapshots} snapshots of one rig, without start poses": run(long, start=False),
    }
    times = side_by_side(cases, effort.pick(20.0, 0.1))
    rows = {name: asdict(time) | {"rigs": rigs if "rigs" in name else 1} for name, time in times.items()}
    difference = float((compiled.state.offset - tensors.state.offset).abs().max())
    return {"times": rows, "compiled_minus_tensors_in_standard_deviations": difference}

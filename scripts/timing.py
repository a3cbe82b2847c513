"""Time cases in turn, so that a busy moment of the machine affects all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

import numpy as np

SLICE = 0.05  # seconds that a case runs before the next one
LEAST_ROUNDS = 3


@dataclass(frozen=True)
class Timing:
    """Wall time of one call, in milliseconds."""

    p50: float
    p99: float
    best: float
    calls: int

    def values(self) -> dict[str, float]:
        """Return plain values, for JSON."""
        return asdict(self)


def timing_of(seconds: list[float]) -> Timing:
    """Summarize the times of single calls, in seconds."""
    ms = 1e3 * np.sort(np.array(seconds))
    return Timing(float(np.median(ms)), float(np.percentile(ms, 99)), float(ms[0]), len(ms))


def side_by_side(
    cases: Mapping[str, Callable[[], object]], seconds: float, prepare: Callable[[], object] | None = None
) -> dict[str, Timing]:
    """Run cases in turn, round after round, for about the same time each.

    Args:
        cases: functions to call, by name; each is called once before anything is measured (caches, compilation).
        seconds: approximate total time. There are at least three rounds, but only one of a case whose single call takes
            a quarter of the time.
        prepare: called before every call; its time does not count.

    Returns:
        Times by name, in the order of the cases.
    """
    for run in cases.values():
        _once(run, prepare)
    times: dict[str, list[float]] = {name: [] for name in cases}
    begin, rounds = time.perf_counter(), 0
    while rounds < LEAST_ROUNDS or time.perf_counter() - begin < seconds:
        for name, run in cases.items():
            before = min(times[name], default=SLICE)
            if times[name] and before > seconds / 4:
                continue
            times[name] += [_once(run, prepare) for _ in range(max(1, int(SLICE / max(before, 1e-6))))]
        rounds += 1
    return {name: timing_of(taken) for name, taken in times.items()}


def _once(run: Callable[[], object], prepare: Callable[[], object] | None) -> float:
    if prepare is not None:
        prepare()
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin

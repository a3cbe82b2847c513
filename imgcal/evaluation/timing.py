"""How long one rig takes."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch

from imgcal.evaluation.methods import Method
from imgcal.evaluation.protocol import Conditions, draw

WARM = 3


@dataclass(frozen=True)
class Latency:
    """Milliseconds for one rig whose points, or images, are at hand: median and 99th percentile."""

    alone_p50: float
    alone_p99: float
    refined_p50: float | None  # prediction and refinement together
    refined_p99: float | None


def latency(method: Method, conditions: Conditions, repeats: int = 50) -> Latency:
    """Time a method on single rigs, another one each time, after a few for warming up."""
    sample = draw(conditions, repeats + WARM, torch.Generator().manual_seed(0))
    alone, refined = [], []
    for row in range(repeats + WARM):
        given = sample.given(slice(row, row + 1))
        if method.images is not None:
            given.images(method.images)
        started = time.perf_counter()
        prediction = method.predict(given)
        alone.append(1e3 * (time.perf_counter() - started))
        if method.refine is not None:
            method.refine(prediction, given)
            refined.append(1e3 * (time.perf_counter() - started))
    both = (_quantile(refined, 0.5), _quantile(refined, 0.99)) if refined else (None, None)
    return Latency(_quantile(alone, 0.5), _quantile(alone, 0.99), *both)


def _quantile(milliseconds: list[float], share: float) -> float:
    return float(torch.tensor(milliseconds[WARM:], dtype=torch.float64).quantile(share))

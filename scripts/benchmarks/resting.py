"""An object that rests between its moves before a running rig: false alarms, and errors over their covariance.

Run as `python -m scripts.benchmarks.resting`: some minutes on one core. Errors of blobs that stay as they are while
nothing moves (pixel phase, half-hidden markers) must not count as often as they are seen. `before` learns from every
snapshot as if its errors were independent of the last one's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.types import CameraRig, Detections
from scripts.benchmarks.rig_streams import Bump, Conditions, Stream
from scripts.output import ROOT, command, markdown, publish, surroundings

RESULT, PAGE = ROOT / "docs" / "benchmarks" / "resting.json", ROOT / "docs" / "method.md"
RATE, SECONDS, REST, MOVE = 20.0, 40.0, 4.0, 0.5
CONDITIONS = Conditions(rate=RATE, clutter=0.2, hidden=0.05, labelled=True)
SHARES = {
    "the object always moves": 0.0,
    "it rests; none of the variance": 0.0,
    "a tenth of it": 0.1,
    "a third": 0.33,
    "nine tenths": 0.9,
}
"""Share of the blobs' variance that is the same during a rest."""
BUMP, BUMPED_AT = np.radians(0.3), 22.0


@dataclass(frozen=True)
class Options:
    """Follow objects at rest."""

    seeds: int = 6
    out: Path = RESULT
    page: Path = PAGE


class Resting(Stream):
    """The object stays in a place for some seconds, and is then carried to the next one."""

    def poses_at(self, seconds: torch.Tensor) -> RigidTransform:
        """Poses of the object at times (S,)."""
        turn, phase = torch.div(seconds, REST + MOVE, rounding_mode="floor"), seconds % (REST + MOVE)
        share = ((phase - REST) / MOVE).clamp_min(0.0)
        return super().poses_at(1.7 * (turn + share))

    def blobs(self, number: int, share: float, sometimes: np.random.Generator) -> Detections:
        """Blobs without labels, of whose variance a share is the same during a rest."""
        now = self.snapshot(number)
        turn, phase = divmod(number / RATE, REST + MOVE)
        known = now.fiducial >= 0
        fixed = np.random.default_rng([self.seed, int(turn)]) if phase < REST else sometimes
        table = fixed.standard_normal((self.rig.num_cameras, self.obj.num_fiducials, 2))
        uv = now.uv.copy()
        uv[known] += share**0.5 * CONDITIONS.noise * table[now.camera[known], now.fiducial[known]]
        return replace(
            now, uv=uv, sigma=np.full_like(now.sigma, CONDITIONS.noise), fiducial=np.full_like(now.fiducial, -1)
        )


@contextmanager
def learning_less(does: bool) -> Iterator[None]:
    """Count snapshots of a rest as what they are worth in the block, or in full."""
    with patch("imgcal.monitoring.resting._are_still", _never) if not does else patch.dict({}):
        yield


def _never(before: Any, now: Any, single: bool) -> Any:
    return np.zeros(now.seen.shape[-1], dtype=np.bool_)


def normalized_error(belief: RigBelief, truth: CameraRig) -> float:
    """Squared error of focal lengths and principal points over their covariance, per degree of freedom."""
    cameras, free = belief.unit.shape
    kept = (free * torch.arange(cameras)[:, None] + torch.arange(6, 10)).flatten()
    covariance = belief.covariance()[kept][:, kept]
    found, true = (torch.cat((rig.focal_length, rig.principal_point), -1).flatten() for rig in (belief.rig, truth))
    return float((found - true) @ torch.linalg.solve(covariance, found - true)) / len(kept)


def run(kind: str, seed: int, bumped: bool, less: bool) -> dict[str, Any]:
    """Follow one stream."""
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    share = SHARES[kind]
    conditions = replace(CONDITIONS, noise=CONDITIONS.noise * (1 - share) ** 0.5)
    bumps = (Bump(int(BUMPED_AT * RATE), 2, "rotation", float(BUMP)),) if bumped else ()
    made = (Stream if kind == "the object always moves" else Resting)(
        rig.to(torch.float64), obj, seed, conditions, bumps
    )
    sometimes, events = np.random.default_rng(seed), Counter[str]()
    with learning_less(less), imgcal.RigKeeper(rig, obj) as keeper:
        for number in range(int(SECONDS * RATE)):
            if isinstance(made, Resting):
                blobs = made.blobs(number, share, sometimes)
            else:
                now = made.snapshot(number)
                blobs = replace(now, fiducial=np.full_like(now.fiducial, -1))
            for event in keeper.update(blobs, number / RATE).events:
                expected = bumped and event.camera == rig.camera_names[2] and event.kind in ("moved", "relearnt")
                events["found" if expected else "false"] += 1
        return {"nees": normalized_error(keeper.belief, made.rig), "found": events["found"], "false": events["false"]}


def measure(seeds: int) -> dict[str, Any]:
    """Follow all streams, with and without the rule, and with a camera that is turned halfway."""
    found: dict[str, Any] = {"seeds": seeds, **surroundings(), "cases": {}}
    for kind in SHARES:
        found["cases"][kind] = {
            arm: [run(kind, seed, bumped, less) for seed in range(seeds)]
            for arm, bumped, less in (("now", False, True), ("before", False, False), ("bumped", True, True))
        }
        print(kind, *_cells(found["cases"][kind]), sep=" | ", flush=True)
    return found


def _cells(arms: dict[str, list[dict[str, Any]]]) -> list[str]:
    cells = []
    for arm in ("before", "now", "bumped"):
        errors = [one["nees"] for one in arms[arm]]
        cells += [f"{fmean(errors):.2f} ({max(errors):.2f})", str(sum(one["false"] for one in arms[arm]))]
    return [*cells, f"{sum(one['found'] > 0 for one in arms['bumped'])} of {len(arms['bumped'])}"]


def table(result: dict[str, Any]) -> str:
    """Make the page's table."""
    arms = ("before: NEES (worst)", "false events", "now: NEES (worst)", "false events")
    head = ("stays the same in a rest", *arms, "a camera turned: NEES (worst)", "false events", "found")
    return markdown(head, [[name, *_cells(arms)] for name, arms in result["cases"].items()])


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    result = measure(options.seeds)
    publish(result, options.out, RESULT, options.page, "object at rest", table(result))


if __name__ == "__main__":
    command(main)

"""Does a fleet recover the prior of its devices? Simulated devices, some of them bumped.

Run as `python -m scripts.benchmarks.fleet_prior`: a quarter of an hour on one core.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from imgcal.estimation import EstimationOptions, estimate
from imgcal.fleet import KINDS, DriftInformation, LearntPrior, learn_prior
from imgcal.io import load_object, read_rig
from imgcal.synthesis import PhysicalDrift, synthesize
from imgcal.types import CalibrationObject, CameraRig, Observations, RigPrior
from scripts.output import ROOT, command, fill, markdown, read_json, surroundings, write_json

RESULT, PAGE = ROOT / "docs" / "benchmarks" / "fleet_prior.json", ROOT / "docs" / "fleet.md"
TRUE = RigPrior(focal_length=0.004, principal_point=3.0, distortion=0.01, rotation=0.003, position=1.5)
NOISE, SNAPSHOTS, AT_ONCE = 0.1, 5, 250
BUMPS = (6.0, 8.0, 10.0, 15.0, 30.0)  # spreads of rotation
FACTORS = {"true": 1.0, "twice as wide": 2.0, "half as wide": 0.5}


@dataclass(frozen=True)
class Options:
    """Learn a fleet's prior and compare it with the truth."""

    devices: int = 5000
    recalibrated: int = 1000  #: further devices with a single snapshot, to compare priors
    bumped: float = 0.02  #: share of devices with a rotated camera
    rig: str = "T4"
    seed: int = 0
    out: Path = RESULT
    page: Path = PAGE
    again: bool = False  #: measure nothing: rewrite the tables from the existing JSON


@dataclass(frozen=True)
class Fleet:
    """Devices and their observations."""

    offset: Tensor  # (D, C, 15) true offsets from the factory values
    observations: Observations  # (D, S, C, N)
    bumped: Tensor  # (D, C) size of the bump in spreads, 0 = none


def simulate(
    factory: CameraRig, obj: CalibrationObject, devices: int, snapshots: int, share: float, seed: int
) -> Fleet:
    """Simulate drift, bumps and observations."""
    generator = torch.Generator().manual_seed(seed)
    drift = PhysicalDrift(
        math.degrees(TRUE.rotation), TRUE.position, TRUE.focal_length, TRUE.principal_point, TRUE.distortion
    )
    std = drift.std(factory)
    offset = torch.randn(devices, *std.shape, generator=generator, dtype=torch.float64) * std
    bumped = torch.zeros(devices, factory.num_cameras, dtype=torch.float64)
    which = torch.rand(devices, generator=generator) < share
    camera = torch.randint(factory.num_cameras, (devices,), generator=generator)
    size = torch.tensor(BUMPS, dtype=torch.float64)[torch.randint(len(BUMPS), (devices,), generator=generator)]
    bumped[torch.arange(devices), camera] = size * which
    axis = torch.nn.functional.normalize(torch.randn(devices, 3, generator=generator, dtype=torch.float64), dim=-1)
    offset[torch.arange(devices), camera, :3] += axis * (size * which * TRUE.rotation)[:, None]
    rigs = factory.expand(devices).retract(offset)
    poses = synthesize(factory, obj, devices * snapshots, generator, drift=None).rig_from_object
    points = poses.apply(obj.points).reshape(devices, snapshots, *obj.points.shape)
    uv = rigs.map_tensors(lambda tensor, _: tensor.unsqueeze(1)).project(points, obj.radius).uv
    uv = uv + NOISE * torch.randn(uv.shape, generator=generator, dtype=uv.dtype)
    shape = uv.shape[:-1]
    return Fleet(offset, Observations(uv, torch.full(shape, NOISE, dtype=uv.dtype), torch.ones(shape).bool()), bumped)


def recalibrated(
    fleet: Fleet, factory: CameraRig, obj: CalibrationObject, prior: RigPrior
) -> tuple[DriftInformation, Tensor]:
    """Estimate all devices with a prior: the information from their images, and the offsets (D, C, 15)."""
    parts, offsets = [], []
    for first in range(0, len(fleet.offset), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        seen = Observations(*(getattr(fleet.observations, name)[rows] for name in ("uv", "sigma", "seen")))
        found = estimate(seen, replace(factory, prior=prior), obj, options=EstimationOptions(loss="squared"))
        parts.append(DriftInformation.from_estimates(found))
        offsets.append(found.rig.local(factory))
    return DriftInformation.concatenate(parts), torch.cat(offsets)


def found_bumps(learnt: LearntPrior, fleet: Fleet, names: tuple[str, ...]) -> dict[str, Any]:
    """Precision, and recall by the size of a bump."""
    named = torch.zeros_like(fleet.bumped, dtype=torch.bool)
    for outlier in learnt.outliers:
        named[outlier.device, names.index(outlier.camera)] = True
    right = named & (fleet.bumped > 0)
    by_size = {
        f"{size:g}": [int((right & (fleet.bumped == size)).sum()), int((fleet.bumped == size).sum())] for size in BUMPS
    }
    return {"named": int(named.sum()), "right": int(right.sum()), "bumped": int((fleet.bumped > 0).sum())} | {
        "by_size": by_size
    }


def compared(learnt: RigPrior, factory: CameraRig, obj: CalibrationObject, options: Options) -> dict[str, Any]:
    """Error of devices with a single snapshot, by prior: measured, and the Cramér-Rao bound."""
    fleet = simulate(factory, obj, options.recalibrated, 1, 0.0, options.seed + 1)
    priors = {"learnt": learnt} | {
        name: RigPrior(**{kind: factor * getattr(TRUE, kind) for kind in KINDS}) for name, factor in FACTORS.items()
    }
    true_std = TRUE.std(factory).flatten()
    rows: dict[str, Any] = {}
    for name, prior in priors.items():
        information, offset = recalibrated(fleet, factory, obj, prior)
        error = (offset - fleet.offset).flatten(1) / true_std
        expected = _expected(information, prior, factory)
        rows[name] = {"measured": float(error.square().mean()), "expected": float(expected.mean())}
    return rows


def _expected(information: DriftInformation, prior: RigPrior, factory: CameraRig) -> Tensor:
    """Mean squared error (D), in units of the true spreads, of an estimate with a prior that may be wrong."""
    true = TRUE.std(factory).flatten()
    unit = RigPrior(1.0, 1.0, 1.0, 1.0, 1.0).std(factory).flatten()
    data = information.information * (true / unit)[:, None] * (true / unit)
    precision = torch.diag((true / prior.std(factory).flatten()).square())
    gain = torch.linalg.inv(data + precision)
    covariance = gain @ (data + precision @ precision) @ gain  # noise, and bias by the wrong prior
    return covariance.diagonal(dim1=-2, dim2=-1).mean(-1)


def measure(options: Options) -> dict[str, Any]:
    """Learn the prior, and compare it."""
    factory, obj = read_rig(options.rig), load_object("asymmetric8")
    fleet = simulate(factory, obj, options.devices, SNAPSHOTS, options.bumped, options.seed)
    information, _ = recalibrated(fleet, factory, obj, RigPrior())
    learnt = learn_prior(information)
    spreads = {
        spread.kind: {"true": getattr(TRUE, spread.kind), "learnt": spread.value, "sigma": spread.sigma}
        for spread in learnt.spreads
    }
    return {
        "rig": options.rig, "devices": options.devices, "snapshots": SNAPSHOTS, "noise_px": NOISE, "seed": options.seed,
        "spreads": spreads, "bumps": found_bumps(learnt, fleet, factory.camera_names),
        "recalibrated": options.recalibrated, "errors": compared(learnt.prior(), factory, obj, options),
    }  # fmt: skip


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables, by the names of their markers."""
    spreads = [
        [kind.replace("_", " "), f"{row['true']:g}", f"{row['learnt']:.4g} ± {row['sigma']:.1g}",
         f"{100 * (row['learnt'] / row['true'] - 1):+.2f} %"]
        for kind, row in result["spreads"].items()
    ]  # fmt: skip
    best = result["errors"]["true"]
    errors = [
        [
            name,
            f"{(row['measured'] / best['measured']) ** 0.5:.4f}",
            f"{(row['expected'] / best['expected']) ** 0.5:.4f}",
        ]
        for name, row in result["errors"].items()
    ]
    bumps = result["bumps"]
    found = [[f"{size} spreads", f"{right} of {count}"] for size, (right, count) in bumps["by_size"].items()]
    found += [["all", f"{bumps['right']} of {bumps['bumped']}; {bumps['named'] - bumps['right']} named wrongly"]]
    return {
        "spreads": markdown(["kind", "true", "learnt", "off by"], spreads),
        "bumps": markdown(["camera turned by", "found"], found),
        "priors": markdown(["prior", "RMS error / error with the true prior", "predicted by the bound"], errors),
    }


def main() -> None:
    """Measure, write the JSON, and rewrite the tables in the page."""
    options = tyro.cli(Options, description=__doc__)
    result = read_json(options.out) if options.again else surroundings() | measure(options)
    if not options.again:
        write_json(options.out, result)
    sections = tables(result)
    print("\n\n".join(sections.values()))
    if options.page.is_file():
        fill(options.page, sections)


if __name__ == "__main__":
    command(main)

"""Simulate a fleet: many drifted rigs that see an object, a table of blobs for each, and a manifest.

Usage: python -m scripts.examples.simulate_fleet FOLDER --devices 200
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from torch import Tensor

import imgcal
from imgcal.fleet import write_manifest
from imgcal.io import save_detections
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import RigPrior
from scripts.output import command

TRUE = RigPrior(focal_length=0.004, principal_point=3.0, distortion=0.005, rotation=0.003, position=1.5)
"""Drift of these devices, which `imgcal fleet` should recover."""
BUMP = 0.05  # rad, of one camera
WARMTH = 2e-4  # relative growth of focal lengths per degree
NOISE = 0.1  # px


@dataclass(frozen=True)
class Options:
    """Simulate a fleet of T4 rigs with the object asymmetric8."""

    out: Annotated[Path, tyro.conf.Positional]  #: folder of manifest.csv and a table of blobs for each device
    devices: int = 200
    snapshots: int = 3
    bumped: float = 0.01  #: share of devices with a bumped camera
    seed: int = 0


def main(options: Options) -> None:
    """Write the captures and the manifest."""
    options.out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(options.seed)
    bumped = rng.random(options.devices) < options.bumped
    rows = []
    for device in range(options.devices):
        temperature = float(rng.normal(22.0, 4.0))
        rig = drifted(device + 1_000_003 * options.seed, temperature, bool(bumped[device]))
        path = options.out / f"{device:05d}.csv"
        blobs_of(rig, options.snapshots, device, path)
        day = f"2026-{1 + device * 6 // options.devices:02d}-{1 + device % 28:02d}T12:00:00"
        rows.append({"capture": path.name, "device": f"T4-{device:05d}", "time": day, "temperature": temperature})
    write_manifest(options.out / "manifest.csv", rows)
    print(f"{options.devices} devices, {int(bumped.sum())} of them bumped: {options.out / 'manifest.csv'}")


def drifted(seed: int, temperature: float, bumped: bool) -> imgcal.CameraRig:
    """Make a rig that has drifted from its factory values."""
    factory, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(seed)
    drift = PhysicalDrift(
        math.degrees(TRUE.rotation), TRUE.position, TRUE.focal_length, TRUE.principal_point, TRUE.distortion
    )
    offset = torch.zeros(4, 15, dtype=torch.float64)
    offset[:, 6:8] += WARMTH * (temperature - 22.0) * factory.focal_length
    if bumped:
        offset[seed % 4, :3] += BUMP * _direction(generator)
    return drift.apply(factory, generator).retract(offset)


def _direction(generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)


def blobs_of(rig: imgcal.CameraRig, snapshots: int, seed: int, path: Path) -> None:
    """Write the blobs of the object in a rig's cameras, unlabelled."""
    truth = simulate_truth(rig, imgcal.load_object("asymmetric8"), snapshots, torch.Generator().manual_seed(seed), None)
    seen = true_detections(truth)
    noise = np.random.default_rng(seed).normal(0.0, NOISE, seen.uv.shape)
    unlabelled = np.full(len(seen.uv), -1)
    save_detections(replace(seen, uv=seen.uv + noise, sigma=np.full(len(seen.uv), NOISE), fiducial=unlabelled), path)


if __name__ == "__main__":
    command(lambda: main(tyro.cli(Options, description=__doc__)))

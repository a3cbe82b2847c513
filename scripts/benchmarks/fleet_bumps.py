"""Which bumps does a fleet find? Recall over the size of a bump in standard deviations of its observable part.

A bump b of a camera shifts the estimate from its images by M b, where M is the precision of the observed drift, from
its spread and the noise together. The size of b is sqrt(b' M b) standard deviations, the most that any statistic can
reach. A test that knew camera, kind and direction, with a threshold of five standard deviations, would find it with the
probability of the Neyman-Pearson test. Run as `python -m scripts.benchmarks.fleet_bumps`: two minutes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from scipy import stats
from torch import Tensor

from imgcal.fleet import KINDS, DriftInformation, outlier_cameras
from imgcal.io import load_object, read_rig
from imgcal.types import PARAMETER_KINDS, PARAMETERS, RigPrior
from scripts.benchmarks.fleet_prior import NOISE, SNAPSHOTS, TRUE, recalibrated, simulate
from scripts.output import ROOT, command, fill, markdown, read_json, surroundings, write_json

RESULT, PAGE = ROOT / "docs" / "benchmarks" / "fleet_bumps.json", ROOT / "docs" / "fleet.md"
SIZES = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 12.0, 15.0)  # observable standard deviations
SPREADS = (6.0, 8.0, 10.0, 15.0, 30.0)  # of rotation, as in `fleet_prior`
THRESHOLD = 5.0
PARTS = [range(PARAMETERS)[part] for part in PARAMETER_KINDS.values()]  # indices of a camera's parameters, by kind


@dataclass(frozen=True)
class Options:
    """Bump cameras of simulated devices, and count which are found."""

    devices: int = 200  #: devices that are recalibrated, for their information
    draws: int = 500  #: bumps per size
    steady: int = 20_000  #: devices without a bump
    rig: str = "T4"
    seed: int = 0
    out: Path = RESULT
    page: Path = PAGE
    again: bool = False  #: measure nothing: rewrite the tables from the existing JSON


def seen(drift: DriftInformation, offset: Tensor, generator: torch.Generator) -> DriftInformation:
    """Information of devices (D) with offsets (D, P): the same information matrices, and noisy scores."""
    values, vectors = torch.linalg.eigh(drift.information)
    noise = torch.randn(offset.shape, generator=generator, dtype=torch.float64)
    root = vectors * values.clamp_min(0).sqrt()[:, None, :]
    score = drift.information @ offset[..., None] + root @ noise[..., None]
    return DriftInformation(drift.camera_names, drift.information, score[..., 0])


def visible_sigmas(drift: DriftInformation, bump: Tensor, variance: Tensor) -> Tensor:
    """Sizes (D) of bumps (D, P) in standard deviations of drift (with variance P) and noise together."""
    std = variance.sqrt()
    inner = std[:, None] * drift.information * std + torch.eye(len(std), dtype=torch.float64)
    scaled = bump / std
    square = (scaled * scaled).sum(-1) - (scaled * torch.linalg.solve(inner, scaled[..., None])[..., 0]).sum(-1)
    return square.clamp_min(0).sqrt()


def bound(sigmas: Tensor, threshold: float = THRESHOLD) -> Any:
    """Probability that the most powerful two-sided test at a threshold finds a bump of this many sigmas."""
    found = sigmas.numpy()
    return stats.norm.sf(threshold - found) + stats.norm.cdf(-threshold - found)


def direction(count: int, cameras: int, kind: int | None, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw cameras (count), and for each a random direction (count, P) within a kind of value, in true spreads."""
    camera = torch.randint(cameras, (count,), generator=generator)
    kinds = torch.randint(len(KINDS), (count,), generator=generator) if kind is None else torch.full((count,), kind)
    found = torch.zeros(count, cameras, PARAMETERS, dtype=torch.float64)
    for row in range(count):
        part = PARTS[int(kinds[row])]
        drawn = torch.randn(len(part), generator=generator, dtype=torch.float64)
        found[row, camera[row], list(part)] = drawn / drawn.norm()
    return camera, found.flatten(1)


def measure(options: Options) -> dict[str, Any]:
    """Recalibrate devices, then simulate the effect of drifts and bumps on their information."""
    factory, obj = read_rig(options.rig), load_object("asymmetric8")
    fleet = simulate(factory, obj, options.devices, SNAPSHOTS, 0.0, options.seed)
    information, _ = recalibrated(fleet, factory, obj, RigPrior())
    generator = torch.Generator().manual_seed(options.seed)
    unit = torch.tensor([getattr(TRUE, kind) for kind in KINDS], dtype=torch.float64)
    widths = torch.tensor(list(map(len, PARTS)))
    std = unit.repeat_interleave(widths).repeat(factory.num_cameras)

    def named(scale: float, visible: bool, kind: int | None) -> dict[str, Any]:
        rows = torch.randint(options.devices, (options.draws,), generator=generator)
        camera, bump = direction(options.draws, factory.num_cameras, kind, generator)
        bump, drift = bump * std, information[rows]
        sigmas = visible_sigmas(drift, bump, std.square())
        bump = bump * (scale / sigmas if visible else torch.full_like(sigmas, scale))[:, None]
        offset = torch.randn(bump.shape, generator=generator, dtype=torch.float64) * std
        found = outlier_cameras(seen(drift, offset + bump, generator), TRUE)
        right = {one.device for one in found if one.camera == factory.camera_names[int(camera[one.device])]}
        sigmas = visible_sigmas(drift, bump, std.square())
        return {
            "size": scale, "draws": options.draws, "found": len(right), "wrong": len(found) - len(right),
            "sigmas": float(sigmas.median()), "bound": float(bound(sigmas).mean()),
        }  # fmt: skip

    false = 0
    for first in range(0, options.steady, 1000):
        rows = torch.randint(options.devices, (min(1000, options.steady - first),), generator=generator)
        offset = torch.randn(len(rows), len(std), generator=generator, dtype=torch.float64) * std
        false += len(outlier_cameras(seen(information[rows], offset, generator), TRUE))
    return {
        "rig": options.rig, "devices": options.devices, "snapshots": SNAPSHOTS, "noise_px": NOISE,
        "visible": [named(size, True, None) for size in SIZES], "spreads": [named(size, False, 0) for size in SPREADS],
        "steady_cameras": options.steady * factory.num_cameras, "false": false,
    }  # fmt: skip


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables, by the names of their markers."""

    def row(one: Mapping[str, Any], first: str) -> list[str]:
        share = 100 * one["found"] / one["draws"]
        return [first, f"{one['sigmas']:.1f}", f"{share:.1f} %", f"{100 * one['bound']:.1f} %", str(one["wrong"])]

    head = ["observable size, sigmas (median)", "found", "most powerful test, camera and direction known",
            "other cameras named"]  # fmt: skip
    visible = [row(one, f"{one['size']:g} observable sigmas, any kind") for one in result["visible"]]
    spreads = [row(one, f"{one['size']:g} spreads of rotation") for one in result["spreads"]]
    steady = f"Without a bump: {result['false']} of {result['steady_cameras']:,} cameras named."
    return {"bumps seen": markdown(["bump", *head], [*visible, *spreads]) + f"\n\n{steady}"}


def main() -> None:
    """Measure, write the JSON, and rewrite the table in the page."""
    options = tyro.cli(Options, description=__doc__)
    result = read_json(options.out) if options.again else surroundings() | measure(options)
    if not options.again:
        write_json(options.out, result)
    sections = tables(result)
    print("\n\n".join(sections.values()))
    if options.out.resolve() == RESULT:
        fill(options.page, sections)


if __name__ == "__main__":
    command(main)

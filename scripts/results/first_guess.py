"""Does a network's first guess help `imgcal calibrate`? Run as ``python -m scripts.results.first_guess``.

Calibrates the same simulated captures with and without it, from labelled blobs with noise. A good start could help more
the larger the drift is and the more labels are swapped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import tyro

from imgcal import PipelineOptions, RefusedError, calibrate, load_object, load_rig
from imgcal.evaluation import judge
from imgcal.pipeline import load_initializer
from imgcal.synthesis import RelativeDrift, simulate_truth, true_detections
from imgcal.types import CameraRig, Detections
from scripts.output import RESULTS, ROOT, command, fill, markdown, read_json, surroundings, write_json

NOISE = 0.05  # px, each axis
KAPPAS = (0.025, 0.05, 0.1, 0.2)
EXCHANGED = (0.0, 0.1)  # share of labels that are swapped
SNAPSHOTS = (1, 4)
STATUSES = ("calibrated", "refused", "wrong")
PAGE = ROOT / "docs" / "results" / "tables.md"


@dataclass(frozen=True)
class Options:
    """Calibrate captures with and without a network's first guess."""

    captures: int = 10  #: captures per case
    object: str = "asymmetric8"
    guess: str = "points"  #: as for `imgcal calibrate --first-guess`
    out: Path = RESULTS / "first_guess.json"


def main(arguments: list[str] | None = None) -> None:
    """Measure, write the JSON, and rewrite the table in the page."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    torch.set_num_threads(1)
    rig, obj = load_rig("O10"), load_object(options.object)
    network = load_initializer(options.guess, rig, obj)
    began, rows = time.monotonic(), []
    for kappa in KAPPAS:
        for exchanged in EXCHANGED:
            for snapshots in SNAPSHOTS:
                wide = replace(rig, prior=_prior_of(rig, kappa))
                tried = [
                    _tried(wide, obj, network, (kappa, exchanged, snapshots), seed) for seed in range(options.captures)
                ]
                rows.append({"kappa": kappa, "exchanged": exchanged, "snapshots": snapshots} | _summed_up(tried))
                print(rows[-1], file=sys.stderr, flush=True)
    result = surroundings() | {"guess": network.name, "captures": options.captures, "noise_px": NOISE, "rows": rows}
    write_json(options.out, result | {"seconds": round(time.monotonic() - began)})
    if options.out.parent == RESULTS:
        fill(PAGE, {"first guess": table(read_json(options.out))})
    print(table(result))


def _prior_of(rig: CameraRig, kappa: float) -> Any:
    """Prior as wide as the drift, so that a rig is refused only because of its data."""
    prior = rig.prior
    assert prior is not None
    scale = max(1.0, kappa / 0.025)
    return replace(prior, **{name: scale * value for name, value in vars(prior).items()})


def _tried(rig: CameraRig, obj: Any, network: Any, case: tuple[float, float, int], seed: int) -> dict[str, Any]:
    """Calibrate one capture from the factory rig and from the guess."""
    kappa, exchanged, snapshots = case
    generator = torch.Generator().manual_seed(1000 + seed)
    truth = simulate_truth(rig, obj, snapshots, generator, RelativeDrift(kappa, kappa))
    blobs = _disturbed(true_detections(truth), exchanged, generator)
    found: dict[str, Any] = {}
    for name, initializer in (("none", None), ("guess", network)):
        started = time.perf_counter()
        try:
            result = calibrate(blobs, rig, obj, PipelineOptions(), initializer=initializer)
        except RefusedError as error:
            found[name] = {"status": "refused", "reason": str(error)[:80], "seconds": time.perf_counter() - started}
            continue
        seconds = time.perf_counter() - started
        wrong, rms, _, _ = judge(result, truth.rig)
        found[name] = {
            "status": "wrong" if wrong else "calibrated", "seconds": seconds, "px": rms, "used": result.guess_used
        }  # fmt: skip
    return found


def _disturbed(blobs: Detections, exchanged: float, generator: torch.Generator) -> Detections:
    """Add noise to all centres, and swap labels of pairs within a camera and snapshot."""
    noise = torch.randn(blobs.uv.shape, generator=generator, dtype=torch.float64).numpy()
    fiducial, place = blobs.fiducial.copy(), blobs.snapshot * len(blobs.camera_names) + blobs.camera
    for view in np.unique(place):
        rows = np.flatnonzero(place == view)
        chosen = rows[torch.rand(len(rows), generator=generator).numpy() < exchanged]
        fiducial[chosen] = np.roll(fiducial[chosen], 1)
    return replace(blobs, uv=blobs.uv + NOISE * noise, sigma=np.full(len(blobs), NOISE), fiducial=fiducial)


def _summed_up(tried: Sequence[dict[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in ("none", "guess"):
        ours = [one[name] for one in tried]
        px = [one["px"] for one in ours if one["status"] == "calibrated"]
        found[name] = {status: sum(one["status"] == status for one in ours) for status in STATUSES}
        found[name] |= {"px": median(px) if px else None, "ms": 1e3 * median(one["seconds"] for one in ours)}
    found["used"] = sum(one["guess"].get("used", False) for one in tried)
    pairs = [(one["none"].get("px"), one["guess"].get("px")) for one in tried]
    found["alike"] = sum(a is not None and b is not None and abs(a - b) <= 0.01 * a for a, b in pairs)
    return found


def table(result: dict[str, Any]) -> str:
    """Make the table, as Markdown."""
    head = ("drift", "labels swapped", "snapshots", "calibrated / refused / wrong: none", "first guess", "guess used",
            "same rig (1 %)", "RE over the volume, px: none", "first guess", "ms: none", "first guess")  # fmt: skip
    rows = []
    for row in result["rows"]:
        cells = [f"{100 * row['kappa']:g} %", f"{100 * row['exchanged']:g} %", str(row["snapshots"])]
        both = [row["none"], row["guess"]]
        cells += [" / ".join(str(one[status]) for status in STATUSES) for one in both]
        cells += [str(row["used"]), str(row["alike"])]
        cells += ["" if one["px"] is None else f"{one['px']:.3g}" for one in both] + [
            f"{one['ms']:.0f}" for one in both
        ]
        rows.append(cells)
    return markdown(head, rows)


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))

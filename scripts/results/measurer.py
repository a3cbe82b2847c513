"""Compare the learned measurer with the fitted ellipse, by level of difficulty, on frames not used for training.

    python -m scripts.results.measurer out/runs --snapshots 3

Trained networks are folders: `imgcal train measurer-cnn --set training.seed=K --out out/runs/measurer-cnn-seedK`.
Writes docs/results/measurer.json and the tables of docs/frames.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.flop_counter import FlopCounterMode

from imgcal.detection import Blobs, DetectionOptions, Frame, detect_snapshot
from imgcal.io import load_object, read_rig
from imgcal.networks import Measurer, load_measurer
from imgcal.pipeline import LearnedMeasurer
from imgcal.synthesis import DIFFICULTIES, FrameModel, PhysicalDrift, Shot, simulate_shots, simulate_truth
from imgcal.types import PATCH_SIZE, UNUSABLE, BlobKind
from renderers import Spots, render_crops
from scripts.output import fill, markdown, read_json, surroundings, write_json

RESULT, PAGE = Path("docs/results/measurer.json"), Path("docs/frames.md")
SEED = 177  # the thresholds of `LearnedMeasurer` were chosen on seed 77
LEAST_SEEN = 0.25  # share of a marker that must be visible to measure it
NEAR = 1.0  # marker radii within which a blob belongs to a marker
WINDOW = 96  # px, width and height of the window on which a bound is computed
STEP = 0.02  # px, of the finite differences for a bound
LEVELS = tuple(DIFFICULTIES)


@dataclass(frozen=True)
class Seen:
    """The K blobs of one snapshot that show a marker, with that marker's truth; and all blobs."""

    frames: dict[str, Frame]
    blobs: Blobs
    row: NDArray[np.int64]  # (K,) index among the blobs
    uv: NDArray[np.float64]  # (K, 2) true centre
    share: NDArray[np.float64]  # (K,) visible share of the marker
    bound: NDArray[np.float64]  # (K,) px, Cramér-Rao, one axis; nan where it is not defined
    markers: int  # number of markers that could be found


def snapshots(level: str, count: int) -> Iterator[Seen]:
    """Simulate captures of O10, detect blobs, and match each one with its marker."""
    rig, obj = read_rig("O10"), load_object("asymmetric8")
    generator = torch.Generator().manual_seed(SEED)
    truth = simulate_truth(rig, obj, count, generator, PhysicalDrift())
    shots = simulate_shots(truth, obj, FrameModel(difficulty=DIFFICULTIES[level]), generator)
    for uv, shot in zip(truth.uv.numpy(), shots, strict=True):
        blobs = detect_snapshot(shot.frames, DetectionOptions())
        radius = torch.linalg.det(shot.markers.shape).sqrt().sqrt().numpy()
        bounds = cramer_rao(shot)
        found = []
        for camera, marker in np.argwhere((shot.seen > LEAST_SEEN).numpy()):
            away = np.linalg.norm(blobs.uv - uv[camera, marker], axis=1) + 1e9 * (blobs.camera != camera)
            row = int(away.argmin()) if len(away) else 0
            if len(away) and away[row] < NEAR * radius[camera, marker]:
                found.append((row, *uv[camera, marker], float(shot.seen[camera, marker]), bounds[camera, marker]))
        table = np.array(found).reshape(-1, 5)
        yield Seen(
            shot.frames, blobs, table[:, 0].astype(np.int64), table[:, 1:3], table[:, 3], table[:, 4],
            int((shot.seen > LEAST_SEEN).sum()),
        )  # fmt: skip


def cramer_rao(shot: Shot) -> NDArray[np.float64]:
    """Least error (C, N) px of one axis, if only centre, brightness and background are unknown.

    Not defined for markers that are cut or partly hidden, since the bound ignores the unknown edge.
    """
    flat = shot.markers.of_each(
        lambda values: (values.float() if values.is_floating_point() else values).flatten(0, 1)[:, None]
    )
    middle = shot.markers.uv.reshape(-1, 2)

    def light(du: float, dv: float) -> torch.Tensor:
        spots: Spots = replace(flat, uv=flat.uv + flat.uv.new_tensor([du, dv]))
        return render_crops(spots, middle.round() + 0.5, 1.0, (WINDOW, WINDOW), shot.sensor.blur)[0]

    here = light(0, 0)
    along = [(light(*step) - light(-step[0], -step[1])) / (2 * STEP) for step in ((STEP, 0.0), (0.0, STEP))]
    sensor, contrast = shot.sensor, shot.sensor.contrast * shot.sensor.full_scale
    level = (sensor.background + sensor.contrast * here) * sensor.full_scale
    variance = level * sensor.shot_noise**2 / sensor.full_scale + sensor.read_noise**2 + 1 / 12
    rows = torch.stack([contrast * along[0], contrast * along[1], here, torch.ones_like(here)], dim=1).flatten(2)
    information = (rows / variance.flatten(1)[:, None]) @ rows.mT
    information = information + 1e-9 * torch.eye(4, dtype=here.dtype)  # keeps the matrix regular for invisible markers
    variances = torch.diagonal(torch.linalg.inv(information), dim1=1, dim2=2)[:, :2]
    bound = variances.mean(1).sqrt().view(shot.seen.shape)
    whole = (shot.seen > 0.98) & shot.markers.visible
    return torch.where(whole, bound, torch.nan).numpy()


def shuffled(network: Measurer) -> Measurer:
    """Make a copy of the network whose encoder outputs are swapped between patches."""
    generator = torch.Generator().manual_seed(0)

    def exchange(module: torch.nn.Module, arguments: Any, features: torch.Tensor) -> torch.Tensor:
        return features[torch.randperm(len(features), generator=generator)]

    network.encoder.register_forward_hook(exchange)
    return network


def score(error: NDArray[np.float64], sigma: NDArray[np.float64]) -> dict[str, float]:
    """Summarize errors (K, 2) with standard deviations (K,), as plain numbers."""
    if not len(error):
        return {"count": 0}
    squared = (error**2).sum(1)
    nees = squared / (2 * sigma**2)
    return {
        "count": len(error),
        "rms_px": float(np.sqrt(squared.mean() / 2)),
        "median_px": float(np.median(np.sqrt(squared))),
        "p90_px": float(np.quantile(np.sqrt(squared), 0.9)),
        "nees": float(nees.mean()),
        "nees_median": float(np.median(nees) / np.log(2)),  # 1 for a Gaussian of the stated sigma
    }


def judged(views: list[Seen], measurer: LearnedMeasurer | None, alone: bool) -> dict[str, Any]:
    """Score the errors of all blobs that show markers, and the kinds of all blobs.

    Args:
        views: snapshots of one level.
        measurer: None = the fitted ellipse.
        alone: use the network's centre for every blob, not only for partial markers.
    """
    errors, sigmas, flagged, false, kinds = [], [], [], [], []
    for view in views:
        blobs = view.blobs
        if measurer is not None and len(blobs.uv):
            said = measurer.measure(view.frames, blobs, DetectionOptions())
            kinds.append(said.kind.argmax(1)[view.row])
            blobs = measurer(view.frames, blobs, DetectionOptions())
            if alone:
                blobs = replace(blobs, uv=said.uv, sigma=said.sigma)
        unusable = (blobs.flags & int(UNUSABLE)) != 0
        # The same blobs for all methods: those that the detector calls usable.
        counted = view.row[(view.blobs.flags[view.row] & int(UNUSABLE)) == 0]
        truth = view.uv[(view.blobs.flags[view.row] & int(UNUSABLE)) == 0]
        errors.append(blobs.uv[counted] - truth)
        sigmas.append(blobs.sigma[counted])
        flagged.append(unusable[counted])
        other = np.setdiff1d(np.arange(len(blobs.uv)), view.row)
        false.append(unusable[other])
    error, sigma, out = np.concatenate(errors), np.concatenate(sigmas), np.concatenate(flagged)
    result: dict[str, Any] = score(error, sigma) | {"flagged_markers": float(out.mean()) if len(out) else 0.0}
    result["flagged_false"] = float(np.concatenate(false).mean()) if sum(map(len, false)) else 0.0
    result["kept"] = score(error[~out], sigma[~out])
    if kinds:
        count = np.bincount(np.concatenate(kinds), minlength=len(BlobKind))
        result["kinds"] = {kind.name.lower(): int(count[kind]) for kind in BlobKind}
    return result


def measured(folder: Path, count: int) -> dict[str, Any]:
    """Measure all methods on all levels."""
    runs = sorted(path.parent for path in folder.glob("measurer-*-seed*/model.safetensors"))
    networks = {run.name: load_measurer(run / "model.safetensors").network for run in runs}
    result: dict[str, Any] = {
        "surroundings": surroundings(),
        "snapshots": count,
        "seed": SEED,
        "sizes": sizes(networks),
    }
    result["levels"] = {}
    for level in LEVELS:
        views = list(snapshots(level, count))
        bound = np.concatenate([view.bound for view in views])
        row: dict[str, Any] = {
            "markers": sum(view.markers for view in views),
            "found": sum(len(view.row) for view in views),
            "bound_px": float(np.sqrt(np.nanmean(bound**2))) if np.isfinite(bound).any() else None,
            "ellipse": judged(views, None, False),
        }
        for name, network in networks.items():
            row[name] = judged(views, LearnedMeasurer(network), False)
            row[f"{name} alone"] = judged(views, LearnedMeasurer(network), True)
            mixed = shuffled(load_measurer(folder / name / "model.safetensors").network)
            row[f"{name} shuffled"] = judged(views, LearnedMeasurer(mixed), True)
        result["levels"][level] = row
        print(
            level,
            json.dumps({key: value.get("rms_px") for key, value in row.items() if isinstance(value, dict)}),
            flush=True,
        )
    return result


def sizes(networks: dict[str, Measurer]) -> dict[str, dict[str, int]]:
    """Weights and operations of each family's whole network, for one patch."""
    families = {}
    for name, network in networks.items():
        with FlopCounterMode(display=False) as counter:
            network(torch.zeros(1, PATCH_SIZE, PATCH_SIZE), torch.ones(1))
        weights = sum(parameter.numel() for parameter in network.parameters())
        families[name.rpartition("-")[0]] = {"parameters": weights, "flops": counter.get_total_flops()}
    return families


def tables(result: dict[str, Any]) -> str:
    """Make the tables of the page, as Markdown."""
    networks = [name for name in next(iter(result["levels"].values())) if "-seed" in name and " " not in name]

    def of(row: dict[str, Any], name: str, key: str = "rms_px") -> str:
        value = row.get(name, {}).get(key)
        return "-" if value is None else f"{value:.3g}"

    families: dict[str, list[str]] = {name.rpartition("-")[0]: [] for name in networks}
    for name in networks:
        families[name.rpartition("-")[0]].append(name)

    def over(row: dict[str, Any], family: str, ending: str = "", key: str = "rms_px") -> str:
        """Mean over the seeds of a family, and the range."""
        values = [row[f"{name}{ending}"][key] for name in families[family]]
        spread = f" ({min(values):.2g} to {max(values):.2g})" if len(values) > 1 else ""
        return f"{statistics.fmean(values):.3g}{spread}"

    endings = ("", " alone", " shuffled")
    head = ["level", "markers found", "bound", "ellipse"]
    head += [f"{family}{ending}" for family in families for ending in endings]
    errors = [
        [level, f"{row['found']} of {row['markers']}", "-" if row["bound_px"] is None else f"{row['bound_px']:.3g}"]
        + [of(row, "ellipse")]
        + [over(row, family, ending) for family in families for ending in endings]
        for level, row in result["levels"].items()
    ]
    kinds = [
        [
            level, of(row, name, "nees_median"), of(row, f"{name} alone", "nees"), of(row, name, "flagged_markers"),
            of(row, name, "flagged_false"), ", ".join(f"{kind} {n}" for kind, n in row[name].get("kinds", {}).items()),
        ]
        for name in networks[:1] for level, row in result["levels"].items()
    ]  # fmt: skip
    sizes_of = [[name, f"{s['parameters']:,}", f"{s['flops'] / 1e6:.1f} M"] for name, s in result["sizes"].items()]
    medians = [
        [level, of(row, "ellipse", "median_px")] + [over(row, family, key="median_px") for family in families]
        for level, row in result["levels"].items()
    ]
    return "\n\n".join(
        (
            f"RMS error per axis in pixels, of usable blobs that show a marker; {result['snapshots']} snapshots of O10"
            " per level, markers of about 11 px radius. *Bound*: Cramér-Rao, with only centre, brightness and"
            " background unknown; whole markers only. *Alone*: the network's centre for every blob; *shuffled*: the"
            " same with the encoder's features swapped between blobs. Mean over training seeds"
            f" ({', '.join(f'{family}: {len(names)}' for family, names in families.items())}), lowest to highest.",
            markdown(head, errors),
            "Median error in pixels:",
            markdown(("level", "ellipse", *families), medians),
            f"Self-assessment of {networks[0]}: NEES (1 = correct sigmas; median and, alone, mean), shares of markers"
            " and of other blobs that are flagged, and its classification of the markers.",
            markdown(("level", "NEES, median", "NEES, alone", "flagged markers", "flagged others", "kinds"), kinds),
            markdown(("family", "weights", "operations per patch"), sizes_of),
        )
    )


def main() -> None:
    """Measure, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--snapshots", type=int, default=3)
    arguments = parser.parse_args()
    result = measured(arguments.runs, arguments.snapshots)
    write_json(RESULT, result)
    fill(PAGE, {"measurer": tables(read_json(RESULT))})


if __name__ == "__main__":
    main()

"""Are predicted errors right? Errors over stated sigmas, and outcomes of captures that violate their description.

Run as `python -m scripts.benchmarks.honesty`; try `--captures 20` first. Writes docs/benchmarks/honesty.json and the
tables of docs/benchmarks/tables.md that are made from it.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from imgcal import Calibration, PipelineOptions, RefusedError, calibrate, load_object, load_rig
from imgcal.association import to_observations
from imgcal.estimation import estimate, relative_difference
from imgcal.evaluation.true_error import true_error
from imgcal.fleet import StoredResults, workers
from imgcal.types import PARAMETER_KINDS, CameraRig, RigPrior
from scripts.benchmarks.honesty_attacks import ATTACKS, BENT, Attack
from scripts.benchmarks.honesty_prediction import Case
from scripts.output import ROOT, WORK, command, fill, markdown, read_json, surroundings, write_json

RIGS = {"O10": "asymmetric8", "U7": "asymmetric8", "T4": "asymmetric8", "room10": "wand4"}
SNAPSHOTS = (1, 5, 20, 100)
TOLERANCES = (0.0, 0.2)  # mm
NOISE = 0.05  # px, each axis
PRIOR = RigPrior(focal_length=0.01, principal_point=5.0, distortion=0.005, rotation=0.0087, position=2.0)
WRONG = 3.0  # multiple of the stated error in pixels beyond which a result is wrong
RESULT = ROOT / "docs" / "benchmarks" / "honesty.json"
PAGE = ROOT / "docs" / "benchmarks" / "tables.md"
OPTIONS = PipelineOptions(blind_cameras=True)
ANYWHERE = 30.0  # mm, tolerance of a fiducial at an unknown position
RATIOS = ("ratio", "told")


def judged(case: Case, attack: Attack, captures: int, seed: int) -> dict[str, Any]:
    """Calibrate captures; return counts of the outcomes, and errors over sigmas for each kind of value.

    An outcome is `refused`, `right`, or wrong: its error in pixels, over held-out points of the working volume, is more
    than `WRONG` times the stated one. A wrong outcome is `said` if it names a displaced fiducial, a camera that moved,
    a prior that was too narrow or a covariance that was widened; otherwise `silent`.
    """
    generator, random = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    prior = case.rig.prior or RigPrior()
    wide = RigPrior(*(attack.drift * value for value in vars(prior).values()))
    outcomes: Counter[str] = Counter()
    squares: dict[str, list[float]] = {kind: [] for kind in (*PARAMETER_KINDS, "joint")}
    inside: list[float] = []
    for _ in range(captures):
        true = case.obj
        if attack.bend is not None:
            true = replace(true, points=attack.bend(case.obj.points.clone(), random))
        drawn = replace(case, rig=replace(case.rig, prior=wide), obj=true)
        truth, table = drawn.draw(generator)
        if attack.damage is not None:
            table = attack.damage(random, case.rig, case.obj, table)
        points = torch.rand(60, 3, generator=generator, dtype=torch.float64)
        try:
            found = calibrate(table, case.rig, case.obj, OPTIONS)
        except RefusedError:
            outcomes["refused"] += 1
            continue
        outcomes[_outcome(found, truth, points)] += 1
        _normalize(found, truth, squares, inside)
    result: dict[str, Any] = {name: outcomes[name] for name in ("right", "said", "silent", "refused")}
    if inside:
        result |= {"nees": {kind: float(np.mean(values)) for kind, values in squares.items()}}
        result |= {"within_95": float(np.mean(inside))}
    return result


def _outcome(found: Calibration, truth: CameraRig, shares: Tensor) -> str:
    predicted = found.predicted_error
    points = torch.lerp(predicted.volume.low, predicted.volume.high, shares)
    stated = predicted.uncertainty.pixel_error(points)
    wrong, _ = true_error(predicted.uncertainty, truth, points)
    ratio = (wrong / stated).square()
    if float(ratio[ratio.isfinite()].mean()) <= WRONG**2:
        return "right"
    return (
        "said"
        if found.displaced or found.moved or found.prior_scale or found.estimate.inflation is not None
        else "silent"
    )


def _normalize(found: Calibration, truth: CameraRig, squares: dict[str, list[float]], inside: list[float]) -> None:
    """Errors relative to the first camera in units of their standard deviations; its own extrinsics do not count."""
    error = relative_difference(found.rig, truth).flatten()
    covariance = found.estimate.covariance()
    std = covariance.diagonal().clamp_min(0).sqrt()
    free = std > 1e-12
    ratio = torch.where(free, error / std.clamp_min(1e-30), torch.nan).view(-1, 15)
    for kind, part in PARAMETER_KINDS.items():
        squares[kind].append(float(ratio[:, part].square().nanmean()))
    inside.append(float((ratio[ratio.isfinite()].abs() < 1.96).double().mean()))
    correlation = (covariance / (std[:, None] * std))[free][:, free]
    values, vectors = torch.linalg.eigh(correlation)
    along = (vectors.mT @ (error / std)[free]).square() / values
    squares["joint"].append(float(along[values > 1e-9].mean()))


def recovered(task: tuple[str, int, int]) -> dict[str, Any]:
    """Bend one fiducial of the wand in 50 snapshots of a room. Is it found, and is the rig as good as with the truth?

    Returns:
        Counts: `named` alone and correctly, `within` 3 sigma of the truth, `refused`. `ratio` of the errors (px, RMS
        over captures) to those with the true object; `told`, the same for an estimate that knows which fiducial it is:
        the unavoidable cost of estimating the position of one fiducial.
    """
    name, captures, seed = task
    generator, random = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    obj = load_object("wand4")
    counts: Counter[str] = Counter()
    errors: list[list[float]] = []
    for _ in range(captures):
        true = replace(obj, points=BENT[name](obj.points.clone(), random))
        case = Case(replace(load_rig("room10"), prior=PRIOR), true, 50, NOISE)
        truth, table = case.draw(generator)
        try:
            found = calibrate(table, case.rig, obj, OPTIONS)
        except RefusedError:
            counts["refused"] += 1
            continue
        shift = (true.points - obj.points).norm(dim=1)
        fiducial = int(shift.argmax())
        counts["named"] += [d.fiducial for d in found.displaced] == [fiducial]
        if found.shape:
            offset = found.shape[fiducial]
            counts["within"] += abs(offset.distance - float(shift[fiducial])) <= 3 * offset.sigma
        loose = torch.zeros_like(shift)
        loose[fiducial] = ANYWHERE
        told = calibrate(table, case.rig, replace(obj, tolerance=loose), OPTIONS)
        known = calibrate(table, case.rig, true, OPTIONS)
        points = known.predicted_error.volume.grid(4).flatten(0, -2)
        errors.append([_pixels(result, truth, points) for result in (found, told, known)])
    mine, oracle, best = np.sqrt(np.square(np.array(errors)).mean(0))
    return {"captures": captures, "named": counts["named"], "within": counts["within"], "refused": counts["refused"],
            "ratio": float(mine / best), "told": float(oracle / best)}  # fmt: skip


def _pixels(found: Calibration, truth: CameraRig, points: Tensor) -> float:
    """True error (px, RMS) over points."""
    wrong, _ = true_error(found.predicted_error.uncertainty, truth, points)
    return float(wrong[wrong.isfinite()].square().mean().sqrt())


def effort(repeats: int = 15) -> dict[str, float]:
    """Time (s, median) of one estimate from 20 snapshots, O10, with an exact object and with tolerances, in turn."""
    given = load_object("asymmetric8")
    case = Case(replace(load_rig("O10"), prior=PRIOR), given, 20, NOISE)
    truth, table = case.draw(torch.Generator().manual_seed(0))
    observations = to_observations(table, case.rig, given)
    tolerant = replace(given, tolerance=torch.full_like(given.points[:, 0], 0.2))
    poses = estimate(observations, truth, given).rig_from_object
    times: dict[str, list[float]] = {"exact": [], "tolerances": []}
    for _ in range(repeats):
        for name, obj in zip(times, (given, tolerant), strict=True):
            began = time.perf_counter()
            estimate(observations, case.rig, obj, poses)
            times[name].append(time.perf_counter() - began)
    return {name: float(np.median(values[1:])) for name, values in times.items()}


def _row(task: tuple[str, str, int, float, str, int, int]) -> dict[str, Any]:
    """Run one row, which is a work item."""
    rig, obj, snapshots, tolerance, attack, captures, seed = task
    given = load_object(obj)
    if tolerance:
        given = replace(given, tolerance=torch.full_like(given.points[:, 0], tolerance))
    case = Case(replace(load_rig(rig), prior=PRIOR), given, snapshots, NOISE)
    began = time.perf_counter()
    found = judged(case, ATTACKS[attack], captures, seed)
    seconds = (time.perf_counter() - began) / captures
    row = {
        "rig": rig,
        "snapshots": snapshots,
        "tolerance_mm": tolerance,
        "attack": attack,
        "captures": captures,
    } | found
    return row | {"ms": 1e3 * seconds}


def _told(row: dict[str, Any]) -> dict[str, Any]:
    """Report on standard error that a row is done, and the time per capture."""
    took = row.pop("ms")
    print(*(f"{value}" for value in row.values()), f"{took:.0f} ms", file=sys.stderr, flush=True)
    return row


@dataclass(frozen=True)
class Options:
    """Measure whether calibrations predict their own errors."""

    captures: int = 200  #: captures per row of sigmas; a quarter as many with 100 snapshots
    attacked: int = 50  #: captures per row of attacks
    rigs: tuple[str, ...] = tuple(RIGS)
    address: str | None = None  #: running Ray cluster to run on; None = this machine
    cores: int | None = None  #: of this machine; 1 = this process alone; None = all
    wand_only: bool = False  #: only repeat the bent wand, and keep the rest of OUT
    out: Path = RESULT


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    began, before = time.monotonic(), surroundings()
    tasks = [
        (rig, RIGS[rig], s, t, "as said", options.captures // (4 if s >= 100 else 1), 100 * number + s + int(10 * t))
        for number, rig in enumerate(options.rigs)
        for s in SNAPSHOTS
        for t in TOLERANCES
    ]
    tasks += [
        (rig, RIGS[rig], s, 0.0, attack, options.attacked, 7000 + 100 * number + s)
        for attack in ATTACKS
        for number, rig in enumerate(options.rigs)
        for s in (1, 20)
        if attack != "as said" and not (attack == "a camera turned 0.5 degrees" and s == 1)
    ]
    kept = StoredResults(WORK / "honesty", Path(__file__).read_text("utf-8"))
    with workers(options.address, options.cores, kept) as mapped:
        wands = list(mapped(recovered, [(name, options.captures, 9000 + i) for i, name in enumerate(BENT)]))
        rows = [_told(row) for row in mapped(_row, [] if options.wand_only else tasks)]
    bent = {"bent_wand": dict(zip(BENT, wands, strict=True))}
    result: dict[str, Any]
    if options.wand_only:
        result = read_json(options.out) | bent
    else:
        seconds = round(time.monotonic() - began)
        result = before | {"noise_px": NOISE, "seconds": seconds, "rows": rows} | bent | {"estimate_seconds": effort()}
    write_json(options.out, result)
    kept.clear()
    if options.out.resolve() == RESULT:
        fill(PAGE, tables(read_json(RESULT)))
    for text in tables(result).values():
        print(text)


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables, by the names of their markers."""
    honest: list[list[Any]] = []
    attacked: dict[str, dict[int, Counter[str]]] = {}
    for row in result["rows"]:
        if row["attack"] == "as said":
            nees = row.get("nees", {})
            cells = [f"{nees[kind]:.2f}" for kind in (*PARAMETER_KINDS, "joint")] if nees else ["-"] * 6
            honest.append([
                row["rig"], str(row["snapshots"]), f"{row['tolerance_mm']:g}", str(row["captures"]), *cells,
                f"{100 * row['within_95']:.1f} %" if nees else "-", str(row["silent"]), str(row["refused"]),
            ])  # fmt: skip
        else:
            counts = attacked.setdefault(row["attack"], {1: Counter(), 20: Counter()})[row["snapshots"]]
            counts.update({name: row[name] for name in ("right", "said", "silent", "refused")})
    kinds = [kind.replace("_", " ") for kind in PARAMETER_KINDS]
    head = ["rig", "snapshots", "tolerance, mm", "captures", *kinds, "joint"]
    names = ("right", "said", "silent", "refused")
    rows = [[name, *(" / ".join(str(by[s][n]) for n in names) for s in (1, 20))] for name, by in attacked.items()]
    wands = [
        [
            name,
            *(str(row[key]) for key in ("captures", "named", "within", "refused")),
            *(f"{row[r]:.3f}" for r in RATIOS),
        ]
        for name, row in result["bent_wand"].items()
    ]
    return {
        "honesty wand": markdown(
            [
                "displacement of one fiducial",
                "captures",
                "named",
                "within 3 sigma",
                "refused",
                "error / known object",
                "the same, fiducial known",
            ],
            wands,
        ),
        "honesty sigmas": markdown([*head, "within 95 %", "silent", "refused"], honest),
        "honesty attacks": markdown(["capture", "1 snapshot", "20 snapshots"], rows),
    }


if __name__ == "__main__":
    command(main)

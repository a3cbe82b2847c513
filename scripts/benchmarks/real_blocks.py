"""Are predicted errors right on real noise? Calibrates disjoint blocks of one real stream independently.

Run as `python -m scripts.benchmarks.real_blocks`; needs IMGCAL_CAPTURES. Nothing moved in the recording, so all blocks
have the same true rig, and their differences should match their covariances.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from imgcal import InputError, PipelineOptions, RefusedError, calibrate, load_object, load_rig
from imgcal.association import associate
from imgcal.estimation import camera_covariance, rigid_motion
from imgcal.io import load_detections
from imgcal.pipeline import Calibration, fit_labelled
from imgcal.types import PARAMETER_KINDS, CalibrationObject, CameraRig, Detections, MovedError
from scripts.output import ROOT, command, surroundings, write_json

CAPTURE = "wand-ten-cameras-stream"
GATE = 1.6
"""Largest permitted chi2 per degree of freedom of focal lengths and positions."""
ROUNDS = 20
"""Iterations of reweighting cameras by their fit when the motion of the whole rig is removed."""
RESULT = ROOT / "docs" / "benchmarks" / "real_blocks.json"


@dataclass(frozen=True)
class Block:
    """One calibration."""

    calibration: Calibration
    said_to_move: str | None  # refused at first, because this camera was reported as moved

    def covariance(self, inflated: bool) -> Tensor:
        """Covariance of all parameters (K C, K C), with or without the inflation by the scatter of the snapshots."""
        found = self.calibration.estimate
        return camera_covariance(found if inflated else replace(found, inflation=None), curved=False)


def calibrated(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Block:
    """Calibrate from unlabelled blobs; if a move is reported, which is wrong here, repeat without that check."""
    try:
        return Block(calibrate(detections, rig, obj), None)
    except MovedError as error:
        labelled = associate(detections, rig.to(torch.float64), obj, PipelineOptions())
        return Block(fit_labelled(labelled, rig, obj), error.moved[0].camera)


def frames(detections: Detections, first: int, last: int) -> Detections:
    """Keep frames `first` to `last` (excluded); snapshots are named after their frames."""
    rows = [row for row, name in enumerate(detections.snapshot_names) if first <= int(name) < last]
    return detections.of_snapshots(rows[0], rows[-1] + 1)


def chi2_by_kind(rigs: Sequence[CameraRig], covariances: Sequence[Tensor]) -> dict[str, float]:
    """Scatter of rigs about their weighted mean divided by their variances, per degree of freedom and parameter kind.

    The motion of the whole rig between them is removed first, by a fit that gives outlying cameras less weight. The
    same projection is applied to the covariances.
    """
    cameras, width = rigs[0].num_cameras, rigs[0].num_parameters
    values = torch.stack([rig.local(rigs[0]).flatten() for rig in rigs])  # (B, K C)
    values = values - values.mean(0)
    motion = rigid_motion(rigs[0], rigs[0].positions.mean(0))
    column = torch.arange(cameras * width) % width
    variance = torch.stack([covariance.diagonal() for covariance in covariances]).mean(0)
    unit = torch.zeros_like(variance)
    for part in (column < 3, (column >= 3) & (column < 6)):
        unit[part] = 1 / variance[part].median()
    weight = unit
    for _ in range(ROUNDS):
        fit = torch.linalg.solve(motion.mT @ (weight[:, None] * motion), motion.mT * weight)
        left = values - values @ fit.mT @ motion.mT
        square = (left.square() * unit).unflatten(1, (cameras, width)).sum(2).mean(0)
        weight = unit * (1 / (1 + square / square.median())).repeat_interleave(width)
    project = torch.eye(len(unit), dtype=unit.dtype) - motion @ fit
    own = torch.stack([(project @ covariance @ project.mT).diagonal() for covariance in covariances])
    mean = (left / own).sum(0) / (1 / own).sum(0)
    chi2 = ((left - mean).square() / own).sum(0).unflatten(0, (cameras, width)) / (len(rigs) - 1)
    return {kind: float(chi2[:, part].mean()) for kind, part in PARAMETER_KINDS.items()}


def measure(blocks: Sequence[Block]) -> dict[str, Any]:
    """Compare calibrations of the same rig."""
    rigs = [block.calibration.rig for block in blocks]
    published = chi2_by_kind(rigs, [block.covariance(True) for block in blocks])
    return {
        "chi2_per_dof": {
            "covariance as published": published,
            "residuals taken for independent": chi2_by_kind(rigs, [block.covariance(False) for block in blocks]),
        },
        "gate": GATE,
        "passed": max(published["focal_length"], published["position"]) <= GATE,
        "blocks": [
            {
                "snapshots": len(block.calibration.labelled.used),
                "rms_px": float(block.calibration.rms),
                "inflation": block.calibration.estimate.mean_inflation,
                "block_length": block.calibration.block_length,
                "said_to_move": block.said_to_move,
            }
            for block in blocks
        ],
    }


@dataclass(frozen=True)
class Options:
    """Calibrate blocks of a real stream independently, and compare them."""

    first: int = 0  #: frame
    blocks: int = 6
    length: int = 400  #: frames per block
    out: Path = RESULT


def main() -> None:
    """Measure, write and print.

    Raises:
        InputError: no captures.
    """
    options, began, before = tyro.cli(Options, description=__doc__), time.monotonic(), surroundings()
    folder = os.environ.get("IMGCAL_CAPTURES")
    if not folder:
        raise InputError("IMGCAL_CAPTURES: found nothing, expected the folder of the captures")
    capture = Path(folder) / CAPTURE
    rig, obj = load_rig(capture / "factory.yaml"), load_object(capture / "object.csv")
    detections = load_detections(capture / "detections.csv.gz", rig)
    blocks: list[Block] = []
    refused: dict[int, str] = {}  # first frame: why
    for first in range(options.first, options.first + options.blocks * options.length, options.length):
        try:
            blocks.append(calibrated(frames(detections, first, first + options.length), rig, obj))
        except RefusedError as error:
            refused[first] = str(error)
            print(f"frames {first}-{first + options.length - 1}: refused: {error}")
            continue
        found = blocks[-1].calibration
        print(f"frames {first}-{first + options.length - 1}: {found}, sigmas times {found.estimate.mean_inflation:.2f}")
    result = measure(blocks)
    stretch = {"capture": CAPTURE, "first_frame": options.first, "frames_per_block": options.length}
    before |= {"seconds": round(time.monotonic() - began)}
    write_json(options.out, before | stretch | {"refused": refused} | result)
    for name, kinds in result["chi2_per_dof"].items():
        print(f"chi2/dof between blocks, {name}: " + ", ".join(f"{kind} {value:.2f}" for kind, value in kinds.items()))
    print(f"gate {GATE}: {'passed' if result['passed'] else 'failed'}")


if __name__ == "__main__":
    command(main)

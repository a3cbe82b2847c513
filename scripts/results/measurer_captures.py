"""Calibrate from real frames with and without the learned measurer, and score on held-out points.

    IMGCAL_CAPTURES=... python -m scripts.results.measurer_captures measurer-cnn

Prints one line per calibration: exit code and RMS (px) of the held-out points.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
import torch

from imgcal.cli.main import main as imgcal_command
from imgcal.geometry import RigidTransform
from imgcal.io import load_detections, load_object, save_detections, save_rig, write_text
from imgcal.types import CameraRig, RigPrior
from tests.captures.conftest import as_detections, at_own_centres, disturbed, fit_rig, read_points

CAMERAS = ("cam1", "cam2", "cam3")
PRIOR = RigPrior(focal_length=0.01, principal_point=20.0, distortion=0.05, rotation=0.005, position=3.0)


def calibrated(folder: Path, source: Path, rig: CameraRig, obj: Path, more: list[str], held_out: list[str]) -> str:
    """Calibrate with the command, and score the result."""
    save_rig(rig, folder / "factory.yaml")
    shutil.rmtree(folder / "out", ignore_errors=True)
    common = ["--rig", str(folder / "factory.yaml"), "--object", str(obj)]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        code = imgcal_command(["calibrate", str(source), *common, "--out", str(folder / "out"), "--no-report", *more])
    if code:
        return f"exit code {code}"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
        imgcal_command(["score", *held_out, "--rig", str(folder / "out" / "rig.yaml"), "--object", str(obj)])
    return f"{json.loads(printed.getvalue())['rms_px']:.4f} px"


def dots(captures: Path, folder: Path, measurer: str) -> None:
    """Three cameras, 437 bright dots: factory rigs with errors of 9 to 14 px."""
    source = captures / "three-cameras-dots"
    obj = source / "object.csv"
    points = read_points(source / "correspondences.csv", load_object(obj).points.numpy(), CAMERAS)
    half = np.random.default_rng(0).random(len(points.uv)) < 0.5
    factory = fit_rig(points.select(half), CAMERAS, (1280, 1024), PRIOR)
    tables = {}
    for name, more in (("none", []), (measurer, ["--measurer", measurer])):
        imgcal_command(["detect", str(source), "--out", str(folder / "blobs.csv"), *more])
        tables[name] = load_detections(folder / "blobs.csv")
        moved = np.linalg.norm(tables[name].uv - tables["none"].uv, axis=1) > 0
        print(f"dots, {name}: {tables[name].usable.sum()} of {len(moved)} blobs usable, {moved.sum()} measured again")
    held_out, _ = at_own_centres(points.select(~half), tables["none"])
    save_detections(as_detections(held_out, CAMERAS), folder / "held_out.csv")
    for seed, pixels in enumerate((9.0, 12.0, 14.0)):
        rig = disturbed(factory, points, pixels, seed)
        for name, more in (("none", []), (measurer, ["--measurer", measurer])):
            print(
                f"dots, {pixels:g} px off, {name}:",
                calibrated(folder, source, rig, obj, more, [str(folder / "held_out.csv")]),
            )


def grid(captures: Path, folder: Path, measurer: str) -> None:
    """One camera, dark dots: eight views calibrate, seven score."""
    source = folder / "grid"
    (source / "frames" / "cam").mkdir(parents=True)
    for path in sorted((captures / "dot-grid-10x10" / "frames").glob("*.png")):
        shutil.copy(path, source / "frames" / "cam")
    rows = [f"{25.4 * column},{25.4 * row},0" for row in range(10) for column in range(10)]
    write_text(source / "object.csv", "\n".join(["x,y,z", *rows]) + "\n")
    rig = CameraRig(
        torch.tensor([[550.0, 550.0]], dtype=torch.float64), torch.tensor([[320.0, 240.0]], dtype=torch.float64),
        torch.zeros(1, 5, dtype=torch.float64), RigidTransform.identity(1, dtype=torch.float64),
        torch.tensor([[640, 480]]), ("cam",),
    )  # fmt: skip
    held_out = [str(source), "--snapshots", "8:15", "--polarity", "dark"]
    for name, more in (("none", []), (measurer, ["--measurer", measurer])):
        options = ["--snapshots", "0:8", "--polarity", "dark", *more]
        print(f"grid, {name}:", calibrated(folder, source, rig, source / "object.csv", options, held_out))


def main() -> None:
    """Calibrate, score and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("measurer")
    measurer = parser.parse_args().measurer
    captures = Path(os.environ["IMGCAL_CAPTURES"])
    with tempfile.TemporaryDirectory() as folder:
        grid(captures, Path(folder), measurer)
        dots(captures, Path(folder), measurer)


if __name__ == "__main__":
    main()

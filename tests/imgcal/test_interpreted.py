"""A first calibration interprets functions that machine code replaces later: both give the same."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from imgcal.detection import DetectionOptions, detect
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate
from imgcal.synthesis import RelativeDrift, simulate_truth, true_detections
from tests.imgcal.lensed import KINDS, lensed

ROOT = Path(__file__).parents[2]
SPOTS = (  # u, v, radius in pixels and brightness: small, large, touching, clipped, dim and cut off
    (20, 20, 1.2, 150), (60, 24, 4, 200), (100, 30, 2, 180), (104.5, 30, 2, 180), (40, 70, 3, 400), (45, 72, 3, 400),
    (90, 70, 2.5, 60), (2, 50, 3, 150), (110, 80, 6, 200),
)  # fmt: skip


def draw(depth: int, dark: bool) -> np.ndarray:
    v, u = np.mgrid[:96, :128].astype(np.float64)
    white = 2**depth - 1
    light = np.random.default_rng(depth).normal(12, 1.5, u.shape)
    for left, top, radius, brightness in SPOTS:
        light += brightness / (1 + np.exp(4 * (np.hypot(u - left, v - top) - radius)))
    grey = np.clip(light / 255, 0, 1) * white
    return (white - grey if dark else grey).astype(np.uint8 if depth == 8 else np.uint16)


def detected() -> dict[str, Any]:
    """Blobs of frames of any depth and polarity."""
    found = {}
    for depth in (8, 16):
        for polarity in ("bright", "dark"):
            blobs = detect({"a": draw(depth, polarity == "dark")}, DetectionOptions(polarity=polarity))
            found[f"{depth} {polarity}"] = np.column_stack([blobs.uv, blobs.sigma, blobs.radius, blobs.flags]).tolist()
    return found


def calibrated() -> dict[str, Any]:
    """Labels and rig of a small capture without labels."""
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    truth = simulate_truth(rig, obj, 2, torch.Generator().manual_seed(1), RelativeDrift(0.01, 0.01))
    seen = true_detections(truth)
    seen.fiducial[:] = -1
    found = calibrate(seen, rig, obj)
    moved = found.rig.cam_from_rig
    return {
        "labels": found.labelled_detections.fiducial.tolist(),
        "rotation": moved.rotation.tolist(),
        "translation": moved.translation.tolist(),
        "focal_length": found.rig.focal_length.tolist(),
    }


def projected() -> dict[str, Any]:
    """Images of points in cameras with each lens model."""
    points = torch.tensor([[[0.0, 0.0, 0.0], [30.0, -20.0, 10.0]]], dtype=torch.float64)
    rigs = [read_rig("T4"), *(lensed(read_rig("T4"), kind) for kind in KINDS)]
    return {rig.name: rig.expand(1).project_values(points).uv.tolist() for rig in rigs}


PARTS = {"detected": detected, "calibrated": calibrated, "projected": projected}


@pytest.fixture(scope="module")
def interpreted() -> dict[str, Any]:
    """What this file prints in a process that compiles nothing."""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    command = [sys.executable, "-W", "error:overflow:RuntimeWarning", __file__]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-800:]
    return json.loads(done.stdout)


@pytest.mark.parametrize(("part", "tolerance"), [("detected", 3e-6), ("calibrated", 1e-9), ("projected", 1e-11)])
def test_interpreted_functions_give_what_machine_code_gives(interpreted: dict[str, Any], part: str, tolerance: float):
    compiled = PARTS[part]()
    assert interpreted[part].keys() == compiled.keys()
    for name, values in compiled.items():
        assert len(values)
        np.testing.assert_allclose(interpreted[part][name], values, rtol=tolerance, atol=tolerance, err_msg=name)


if __name__ == "__main__":
    print(json.dumps({name: make() for name, make in PARTS.items()}))

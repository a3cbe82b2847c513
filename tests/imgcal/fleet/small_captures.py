"""Captures of two snapshots, as tables of blobs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import imgcal
from imgcal.io import save_detections
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import CameraRig


def write_capture(path: Path, seed: int, rig: CameraRig | None = None) -> None:
    rig, obj = rig or imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    drift = PhysicalDrift(rotation_deg=0.2, position=1.5, focal_length=0.004, principal_point=3.0)
    truth = simulate_truth(rig, obj, 2, torch.Generator().manual_seed(seed), drift)
    seen = true_detections(truth)
    noise = np.random.default_rng(seed).normal(0, 0.1, seen.uv.shape)
    save_detections(replace(seen, uv=seen.uv + noise, sigma=np.full(len(seen.uv), 0.1)), path)

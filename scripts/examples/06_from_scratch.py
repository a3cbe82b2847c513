"""Calibrate cameras from a wand that is carried around, given only their approximate field of view."""

from dataclasses import replace

import numpy as np
import torch

import imgcal
from imgcal.io import drop_poses
from imgcal.pipeline import calibrate_from_scratch
from imgcal.synthesis import HandHeld, Lens, PhysicalDrift, arrange_rig, simulate_volume, true_detections

generator = torch.Generator().manual_seed(1)
planned = arrange_rig("ring", 6, radius=3500.0, height=2200.0, target=(0.0, 0.0, 1000.0), lens=Lens((1280, 1024), 70.0))
wand = imgcal.load_object("wand4")
truth = simulate_volume(planned, wand, 100, generator, PhysicalDrift(), hand=HandHeld(speed=800.0))

exact = true_detections(truth)
noise = np.random.default_rng(1).normal(scale=0.1, size=exact.uv.shape)  # px
blobs = replace(exact, uv=exact.uv + noise, fiducial=np.full(len(exact), -1))  # unlabelled
rough = replace(planned, focal_length=1.1 * planned.focal_length)

result = calibrate_from_scratch(blobs, drop_poses(rough), wand)
found, true = (torch.cdist(rig.positions, rig.positions) for rig in (result.rig, truth.rig))
print(f"{len(result.labelled.used)} snapshots, identity {result.identity}, RMS {float(result.rms):.3f} px")
print(
    f"distances between cameras: {float((found - true).abs().max()):.2f} mm off at most, of {float(true.max()):.0f} mm"
)
print(f"predicted error of a point: {result.predicted_error.median_mm:.2f} mm")

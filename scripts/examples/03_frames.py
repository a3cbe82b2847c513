"""From infrared frames in memory to a recalibrated rig: blobs, identity, estimation in one call."""

import torch

import imgcal
from imgcal.synthesis import FrameModel, PhysicalDrift, simulate_frames, simulate_truth
from renderers import ClutterModel

generator = torch.Generator().manual_seed(2)
factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
truth = simulate_truth(factory, obj, 3, generator, PhysicalDrift())
snapshots = list(simulate_frames(truth, obj, FrameModel(clutter=ClutterModel()), generator))
frames = {camera: [snapshot[camera] for snapshot in snapshots] for camera in factory.camera_names}

result = imgcal.calibrate(frames, factory, obj)
print(f"identity {result.identity}, reprojection error {result.before.rms:.2f} px -> {result.rms:.3f} px")
for stage, seconds in result.seconds.items():
    print(f"{stage}: {1000 * seconds:.1f} ms")

"""Frames of a small rig, in which blobs are hard to find."""

import torch

from imgcal.io import load_object, read_rig
from imgcal.synthesis import FrameModel, PhysicalDrift, simulate_frames, simulate_truth
from renderers import ClutterModel, SensorModel

DIM = FrameModel(SensorModel(contrast=0.016, read_noise=3.0, blur=1.5), ClutterModel(), marker_radius=10.0)


def dim_frames(obj="asymmetric8", snapshots=1, seed=0, model=DIM, size=(640, 340)):
    """Factory rig, object, truth and frames of each snapshot: markers hardly brighter than the noise."""
    rig, obj = read_rig("T4").resized(torch.tensor(size)), load_object(obj)
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_truth(rig, obj, snapshots, generator, PhysicalDrift())
    return rig, obj, truth, list(simulate_frames(truth, obj, model, generator))

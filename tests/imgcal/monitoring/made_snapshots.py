"""Snapshots of a drifted rig, and the batch estimate as the expected result of learning from them."""

import torch

import imgcal
from imgcal.estimation import EstimationOptions, camera_covariance, estimate
from imgcal.monitoring import RigBelief
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import DriftRate, Observations

NOISE = 0.05
SQUARED = EstimationOptions(loss="squared", tolerance=1e-8)
STEADY = DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)


def made_snapshots():
    """A drifted rig of four cameras and 24 snapshots of an object."""
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(3)
    truth = simulate_truth(factory, obj, 24, generator, PhysicalDrift())
    uv = truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    seen = torch.rand(uv.shape[:-1], generator=generator) > 0.1
    observations = Observations(uv, torch.full(seen.shape, NOISE, dtype=torch.float64), seen)
    return factory, obj, truth, observations


def part(observations: Observations, first: int, last: int) -> Observations:
    return Observations(*(x[first:last] for x in (observations.uv, observations.sigma, observations.seen)))


def snapshots(made, first: int, last: int):
    """Observations and poses of some snapshots."""
    _, _, truth, observations = made
    return part(observations, first, last), truth.rig_from_object[first:last]


def batch(made, count: int, obj=None):
    factory, given, truth, observations = made
    poses = truth.rig_from_object[:count]
    return estimate(part(observations, 0, count), factory, obj or given, poses, options=SQUARED)


def worst(belief: RigBelief, fit) -> tuple[float, float]:
    """Largest difference from a batch estimate in its standard deviations, and largest ratio of these, above 1."""
    std = camera_covariance(fit, curved=False).diagonal().sqrt()
    ratio = belief.std().flatten() / std
    difference = belief.rig.local(fit.rig).flatten() / std
    return float(difference.abs().max()), float(torch.maximum(ratio, 1 / ratio).max())

"""Snapshots of lights for tests: markers of an object, taken for as many lights."""

import torch

from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, Observations

ROOM = 2  # numbers that no light has


def lights_of(
    observations: Observations, places: torch.Tensor
) -> tuple[CalibrationObject, Observations, RigidTransform]:
    """Take fiducials for lights, with places (S, N, 3); a few numbers in front of them are free."""
    snapshots, cameras, count = observations.seen.shape
    wide = count + ROOM
    uv = torch.zeros(snapshots, cameras, wide, 2, dtype=torch.float64)
    sigma, seen = torch.ones(snapshots, cameras, wide, dtype=torch.float64), torch.zeros(snapshots, cameras, wide) > 0
    uv[:, :, ROOM:], sigma[:, :, ROOM:], seen[:, :, ROOM:] = observations.uv, observations.sigma, observations.seen
    there = torch.full((snapshots, wide, 3), torch.nan, dtype=torch.float64)
    there[:, ROOM:] = places
    rotation = torch.eye(3, dtype=torch.float64).expand(snapshots, wide, 3, 3)
    return (
        CalibrationObject.unknown(most=wide),
        Observations(uv, sigma, seen, observations.shake),
        RigidTransform(rotation, there),
    )

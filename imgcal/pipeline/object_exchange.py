"""Check that the object was not exchanged: each snapshot measures its size by itself, with the rig known.

A calibration from two objects of slightly different size fits neither: the rig is a compromise, and the residuals look
like bent fiducials or a narrow prior. The sizes measured in the snapshots show it: they have a step at one moment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import Estimate, correlation_time
from imgcal.geometry import cross_matrix
from imgcal.medians import median

Floats = NDArray[np.float64]

SURE = 8.0
"""Significance of the step, in standard deviations, over all its possible moments."""
LEAST_STEP = 1e-3
"""Minimum relative step: inexact lenses make the size seem to change by less."""
LEAST_SNAPSHOTS = 3
"""Minimum number of snapshots before and after the step."""
LARGEST_SHARE = 0.5
"""Maximum share of the variance of the sizes that the step may leave: otherwise there are other causes."""
UNKNOWN_SIZE = 0.1
"""Relative standard deviation at which a snapshot says nothing about the size."""
DETERMINED = 1e-6
"""Largest share of a change of size that the images may not show."""
WAY = 1e-3
"""Step of the differences, mm."""


@dataclass(frozen=True)
class SizeStep:
    """A change of the object's size at one moment."""

    first: int  # index among snapshots with a pose
    change: float  # relative
    sigma: float  # one standard deviation of the change


def measure_sizes(fit: Estimate) -> tuple[Floats, Floats]:
    """Measure the object's size in each snapshot, with the cameras of the estimate.

    Args:
        fit: the estimate of one rig from S snapshots.

    Returns:
        (S,) sizes relative to the estimate's object, and (S,) their standard deviations by noise; infinite where a
        snapshot does not determine the size: a single camera cannot tell a larger object from a nearer one.
    """
    points = fit.points_object - fit.points_object.mean(0)
    arms = points @ fit.rig_from_object.rotation.mT  # (S, N, 3), from the centroid, in the rig frame
    motion = torch.cat((-cross_matrix(arms), torch.eye(3).to(arms).expand(*arms.shape, 3), arms[..., None]), -1)
    root_weight = fit.problem.root_weight[0]  # (S, C, N)
    residual = (root_weight[..., None] * fit.residual).permute(0, 2, 1, 3).flatten(2)
    slope = torch.where(root_weight[..., None, None] > 0, root_weight[..., None, None] * _slopes(fit), 0.0)
    slope = slope.permute(0, 2, 1, 3, 4).flatten(2, 3)  # (S, N, 2 C, 3)
    square, toward = slope.mT @ slope, slope.mT @ residual[..., None]  # (S, N, 3, 3), (S, N, 3, 1)
    across = motion.flatten(1, 2).mT  # (S, 7, 3 N): by rotation, translation and growth
    information, pull = across @ (square @ motion).flatten(1, 2), -(across @ toward.flatten(1, 2))[..., 0]
    scale = information.diagonal(dim1=1, dim2=2).clamp_min(1e-30).rsqrt()
    whitened = information * scale[:, :, None] * scale[:, None]
    inverse = torch.linalg.pinv(whitened, hermitian=True, rtol=1e-12)
    size = scale[:, -1] * (inverse @ (scale * pull)[..., None])[:, -1, 0]
    sigma = scale[:, -1] * inverse[:, -1, -1].clamp_min(0).sqrt()
    determined = (inverse @ whitened)[:, -1, -1]  # one, unless the inverse leaves out a direction that changes the size
    sigma = torch.where(determined > 1 - DETERMINED, sigma, torch.inf)
    return size.numpy(), sigma.numpy()


def find_step(size: Floats, sigma: Floats) -> SizeStep | None:
    """Find the moment at which sizes (S,) with standard deviations (S,) change; None = there is none."""
    known = np.flatnonzero((sigma > 0) & (sigma < UNKNOWN_SIZE))
    if len(known) < 2 * LEAST_SNAPSHOTS:
        return None
    x, weight = size[known], sigma[known] ** -2.0
    before, moment = np.cumsum(weight)[:-1], np.cumsum(weight * x)[:-1]
    after, later = weight.sum() - before, (weight * x).sum() - moment
    change = later / after - moment / before
    gain = change**2 * before * after / weight.sum()
    inner = slice(LEAST_SNAPSHOTS - 1, len(gain) - LEAST_SNAPSHOTS + 1)
    at = inner.start + int(gain[inner].argmax())
    level = np.where(np.arange(len(x)) <= at, moment[at] / before[at], later[at] / after[at])
    left = (x - level) * np.sqrt(weight)
    about = (x - (weight * x).sum() / weight.sum()) * np.sqrt(weight)
    step, rest = float(change[at]), median(np.abs(left))
    if abs(step) < LEAST_STEP or rest > math.sqrt(LARGEST_SHARE) * median(np.abs(about)):
        return None
    lasting = float(correlation_time(left[:, None])[0])
    noise = max(1.0, 1.4826 * rest) * math.sqrt(lasting * (1 / before[at] + 1 / after[at]))
    return SizeStep(int(known[at + 1]), step, noise) if abs(step) >= SURE * noise else None


def require_one_size(fit: Estimate, names: tuple[str, ...]) -> None:
    """Refuse an object that was exchanged for a larger or smaller one.

    Args:
        fit: the estimate.
        names: of the snapshots.

    Raises:
        RefusedError: the object's size changes at some moment.
    """
    if len(names) < 2 * LEAST_SNAPSHOTS:
        return
    step = find_step(*measure_sizes(fit))
    if step is not None:
        how = "larger" if step.change > 0 else "smaller"
        raise RefusedError(
            f"object: from snapshot {names[step.first]} on it is {100 * abs(step.change):.2g} +- "
            f"{100 * step.sigma:.1g} % {how} than before: another object, or other lenses",
            python="calibrate the snapshots before and after separately",
            command="calibrate the snapshots before and after separately",
        )


def _slopes(fit: Estimate) -> Tensor:
    """Derivatives (S, C, N, 2, 3) of the images by the fiducials' places, px/mm."""
    steps = WAY * torch.eye(3).to(fit.points_object)
    places = fit.rig_from_object.apply(fit.points_object)
    moved = places[:, None] + torch.cat((steps, -steps))[:, None]  # (S, 6, N, 3)
    images = fit.rig.expand(len(places)).project_values(moved.flatten(1, 2)).uv.unflatten(2, (6, -1))
    return ((images[:, :, :3] - images[:, :, 3:]) / (2 * WAY)).permute(0, 1, 3, 4, 2)

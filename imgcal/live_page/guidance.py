"""The accuracy over the volume, and where the object teaches the most: computed now and then, beside the server."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import Gauge, WorkingVolume, pixel_jacobian, uncertainty_over
from imgcal.geometry import cross_matrix
from imgcal.io import DEFAULT_SIGMA
from imgcal.live_page.page import round_values
from imgcal.monitoring import RigBelief
from imgcal.types import CameraRig

FEW_CAMERAS = 16
FINE, COARSE = 9, 7
"""Cells along each side of the volume for few cameras, and for many."""
PLACES = {True: 4, False: 3}
"""Places along each side where the object is tried, for few cameras and for many."""
MOST_POINTS = 8  # fiducials that a try takes


def compare(content: dict[str, Any]) -> tuple[CameraRig, NDArray[np.float64], Tensor]:
    """Read a rig (`contents.belief_message`).

    Returns:
        The rig; its change (C, K) against the factory, as most see it; and one standard deviation of each, (C, K).
    """
    belief, factory, _ = pickle.loads(content["pickled"])
    rig = belief.rig
    gauge = Gauge.from_majority(rig, factory)
    return rig, gauge.difference(rig, factory).numpy(), gauge.spread(rig, belief.covariance())


def compute_guidance(
    content: dict[str, Any], points_object: NDArray[np.float64], volume: WorkingVolume
) -> dict[str, Any]:
    """Compute what the page shows about the volume.

    Args:
        content: a message with a belief (`contents.belief_message`).
        points_object: (N, 3) mm.
        volume: where the object is seen.

    Returns:
        Plain values for the page.

    Raises:
        RefusedError: the information is singular.
        torch.linalg.LinAlgError: the matrix of a determinant is singular.
    """
    belief, _, turn = pickle.loads(content["pickled"])
    rig, covariance = belief.rig, belief.covariance()
    few = rig.num_cameras <= FEW_CAMERAS
    grid = volume.grid(FINE if few else COARSE)
    points = grid.flatten(0, -2)
    seen = rig.project(points).visible
    uncertainty = uncertainty_over(rig, covariance, volume.grid(5 if few else 4).flatten(0, -2))
    mm = uncertainty.point_error(points, seen)
    sigma = content["sigma"] or DEFAULT_SIGMA
    shape = torch.as_tensor(points_object)
    shape = (shape - shape.mean(0))[_spread(len(shape))] @ turn.mT
    places = _inner(volume, shape).grid(PLACES[few]).flatten(0, -2)
    gain = information_gain(belief, covariance, places, shape, sigma)
    known = mm[mm.isfinite()]
    best = int(gain.argmax())
    return {
        "time": content["time"],
        "low": round_values(volume.low.numpy()),
        "high": round_values(volume.high.numpy()),
        "mm": round_values(mm.view(grid.shape[:-1]).numpy(), 3),
        "count": seen.sum(0).view(grid.shape[:-1]).tolist(),
        "median": _value(known.median()) if len(known) else None,
        "p95": _value(known.quantile(0.95)) if len(known) else None,
        "places": round_values(places.numpy(), 4),
        "gain": round_values(gain.numpy(), 3),
        "best": best if float(gain[best]) > 0 else None,
    }


def information_gain(belief: RigBelief, covariance: Tensor, places: Tensor, shape: Tensor, sigma: float) -> Tensor:
    """Compute the information that one more snapshot would give, with the object at some places: (P,) nat.

    Half the logarithm of the determinants' ratio of covariances before and after, the pose eliminated: what no
    snapshot shows, as a motion of the whole rig, does not count.

    Args:
        belief: of the rig.
        covariance: (15 C, 15 C) of its cameras.
        places: (P, 3) mm where the object's middle is tried.
        shape: (N, 3) mm of its fiducials about its middle, in the rig's frame.
        sigma: px, of each axis of what is measured.

    Source: Lindley 1956, "On a measure of the information provided by an experiment".
    """
    rig, found = belief.rig, []
    turned = -cross_matrix(shape)  # (N, 3, 3): motion of each fiducial when the object turns
    pose = torch.cat((turned, torch.eye(3, dtype=shape.dtype).expand_as(turned)), -1)  # (N, 3, 6)
    for place in places:
        points = place + shape
        seen = rig.project(points).visible
        cameras, fiducials = seen.nonzero(as_tuple=True)
        if len(cameras) < 4:
            found.append(0.0)
            continue
        own = pixel_jacobian(rig, points)[cameras, fiducials] / sigma  # (K, 2, 15)
        # A camera's step to one side shifts pixels as the point's to the other does.
        by_pose = (-own[..., 3:6] @ pose[fiducials]).flatten(0, 1)  # (2 K, 6)
        basis = torch.linalg.qr(by_pose).Q
        rows = own.new_zeros(len(cameras), 2, rig.num_cameras, rig.num_parameters)
        rows[torch.arange(len(cameras)), :, cameras] = own
        rows = rows.flatten(2).flatten(0, 1)
        rows = rows - basis @ (basis.mT @ rows)
        inner = rows @ covariance @ rows.mT
        found.append(0.5 * float(torch.logdet(inner + torch.eye(len(inner), dtype=inner.dtype))))
    return torch.tensor([value if math.isfinite(value) else 0.0 for value in found], dtype=torch.float64)


def _inner(volume: WorkingVolume, shape: Tensor) -> WorkingVolume:
    """Where the object's middle may be for all of it to be inside, or at least half of each side."""
    reach = torch.minimum(shape.abs().amax(0), (volume.high - volume.low) / 4)
    return WorkingVolume(volume.low + reach, volume.high - reach)


def _spread(count: int) -> Tensor:
    return torch.linspace(0, count - 1, min(count, MOST_POINTS)).round().long()


def _value(number: Tensor) -> float:
    return float(f"{float(number):.4g}")

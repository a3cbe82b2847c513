"""Identify a single light: it has no pattern, but cameras can agree on its position.

Any two blobs of different cameras that may show the same point define a candidate position. Its evidence comes from all
cameras: a blob near its image against a false blob there, no blob against a hidden marker. The best one must beat the
best different choice by the odds required of every identity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association.blobs import PaddedBlobs, gather
from imgcal.association.result import Identity, IdentityOptions
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig, Detections

Array = NDArray[np.float64]

REACH = 4.0
"""Maximum distance, in standard deviations of a camera's error, between a blob and a position's image."""
HIDDEN = 0.3
"""Probability that a camera does not show a marker in its view."""
LEAST_CAMERAS = 3
"""Minimum number of cameras that agree on a position: two rays may meet by chance."""
MOST_PLACES, MOST_PAIRS = 60, 20000
"""Maximum number of positions and of pairs of blobs: the best ones are kept."""
ROUNDS = 3
"""Iterations of choosing blobs near a position and triangulating it again."""


@dataclass(frozen=True)
class _Views:
    """A snapshot's blobs, in pixels from the principal point without distortion."""

    blobs: PaddedBlobs
    rotation: Array  # (C, 3, 3) cam_from_rig
    position: Array  # (C, 3) mm
    focal: Array  # (C, 2) px
    error: Array  # (C,) px, one standard deviation of errors of rig and blobs
    half: Array  # (C, 2) px, half the image
    density: Array  # (C,) false blobs per square pixel

    def project(self, places: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Images (P, C, 2) of places (P, 3), and whether they are in view (P, C)."""
        there = np.einsum("cij,pcj->pci", self.rotation, places[:, None] - self.position)
        depth = np.maximum(there[..., 2], 1.0)
        uv = there[..., :2] / depth[..., None] * self.focal
        return uv, (there[..., 2] > 1.0) & (np.abs(uv) < self.half).all(-1)

    def rays(self) -> Array:
        """Directions (C, M, 3) in the rig's frame."""
        xy = self.blobs.ideal.astype(np.float64) / self.focal[:, None]
        rays = np.concatenate((xy, np.ones((*xy.shape[:2], 1))), -1) @ self.rotation
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


@dataclass(frozen=True)
class _Places:
    """Candidate positions in space."""

    at: Array  # (P, 3) mm
    chosen: NDArray[np.int64]  # (P, C) blob, -1 = none
    odds: Array  # (P,) log odds against false blobs

    def best(self, count: int) -> _Places:
        """Keep the best position for each choice of blobs."""
        _, first = np.unique(self.chosen, axis=0, return_index=True)
        first = first[(self.chosen[first] >= 0).sum(1) >= LEAST_CAMERAS]
        rows = first[np.argsort(-self.odds[first], kind="stable")][:count]
        return _Places(self.at[rows], self.chosen[rows], self.odds[rows])


def identify_points(
    detections: Detections, rig: CameraRig, obj: CalibrationObject, std: Tensor, options: IdentityOptions
) -> Identity:
    """Label the blobs of one snapshot of an object that is a single point; arguments as in `identify`."""
    views = _views(detections, rig, std)
    nothing = np.full(views.blobs.rows, -1, dtype=np.int64)

    def refused(reason: str, undecided: bool = False) -> Identity:
        return Identity(nothing, None, None, "refused", 0, 0.0, reason, hypotheses=1, undecided=undecided)

    places = _places(views).best(MOST_PLACES)
    if not len(places.at):
        return refused(f"no place on which {LEAST_CAMERAS} cameras agree")
    margin = _margin(places, options.least_margin)
    if margin < options.least_margin:
        return refused(f"another place explains the blobs nearly as well: log odds {margin:.3g}", undecided=True)
    labels = _certain(views, places.at[:1], places.chosen[:1].T)  # (C, 1)
    if int((labels >= 0).sum()) < 2:
        return refused(f"no place on which {LEAST_CAMERAS} cameras agree")
    shift = torch.from_numpy(places.at[0]) - obj.points[0].double()
    pose = RigidTransform(torch.eye(3, dtype=torch.float64), shift)
    reason = f"{int((labels >= 0).sum())} cameras agree"
    rows, strength = views.blobs.to_rows(labels), float(places.odds[0])
    return Identity(rows, pose, rig, "unique", 1, margin, reason, explained=1.0, evidence=strength)


def _views(detections: Detections, rig: CameraRig, std: Tensor) -> _Views:
    blobs = gather(detections, rig)
    plain = (t.double().numpy() for t in (rig.cam_from_rig.rotation, rig.positions, rig.focal_length))
    rotation, position, focal = plain
    spread, size = std.double().numpy(), rig.image_size.double().numpy()
    half = np.broadcast_to(0.5 * size, focal.shape)
    distance = np.linalg.norm(position - position.mean(0), axis=1).mean() or 1000.0
    mean = focal.mean(1)
    turned, moved = spread[:, :3].mean(1) * mean, spread[:, 3:6].mean(1) * mean / distance
    zoomed, shifted = spread[:, 6:8].mean(1) / mean * half.mean(1) * 0.6, spread[:, 8:10].mean(1)
    own = np.where(blobs.row >= 0, blobs.sigma, 0.0).max(1, initial=0.0)
    error = np.sqrt(turned**2 + moved**2 + zoomed**2 + shifted**2 + own**2 + 0.25)
    density = np.maximum(blobs.count, 1) / (4 * half.prod(1))
    return _Views(blobs, rotation, position, focal, error, half, density)


def _places(views: _Views) -> _Places:
    """Find all positions where the rays of two cameras nearly meet, and their evidence in all cameras."""
    rays, valid = views.rays(), views.blobs.row >= 0
    camera, blob = np.nonzero(valid)
    a, b = np.nonzero(np.triu(np.ones((len(camera), len(camera)), dtype=bool), 1) & (camera[:, None] != camera))
    if len(a) > MOST_PAIRS:
        kept = np.linspace(0, len(a) - 1, MOST_PAIRS).astype(int)
        a, b = a[kept], b[kept]
    d1, d2 = rays[camera[a], blob[a]], rays[camera[b], blob[b]]
    p1, p2 = views.position[camera[a]], views.position[camera[b]]
    base, cosine = p2 - p1, (d1 * d2).sum(1)
    sine = np.maximum(1 - cosine**2, 1e-12)
    along1 = ((base * d1).sum(1) - (base * d2).sum(1) * cosine) / sine
    along2 = ((base * d1).sum(1) * cosine - (base * d2).sum(1)) / sine
    gap = np.linalg.norm(p1 + along1[:, None] * d1 - p2 - along2[:, None] * d2, axis=1)
    reach = REACH * np.hypot(
        along1 * views.error[camera[a]] / views.focal[camera[a], 0],
        along2 * views.error[camera[b]] / views.focal[camera[b], 0],
    )
    good = (along1 > 0) & (along2 > 0) & (sine > 1e-3) & (gap < reach)
    at = 0.5 * (p1 + along1[:, None] * d1 + p2 + along2[:, None] * d2)[good]
    chosen, odds = _find_nearest(views, at)
    for _ in range(ROUNDS):
        at = _triangulate(views, rays, at, chosen)
        chosen, odds = _find_nearest(views, at)
    return _Places(at, chosen, odds)


def _find_nearest(views: _Views, at: Array) -> tuple[NDArray[np.int64], Array]:
    """Nearest blobs (P, C) to the images of positions, -1 = none within reach, and the positions' log odds (P,)."""
    uv, inside = views.project(at)
    squared = np.square(uv[:, :, None] - views.blobs.ideal).sum(-1)  # (P, C, M)
    nearest = squared.argmin(-1)
    least = np.take_along_axis(squared, nearest[..., None], -1)[..., 0] / views.error**2
    hit = (least < REACH**2) & inside
    told = np.log((1 - HIDDEN) / (2 * np.pi * views.error**2 * views.density)) - 0.5 * least
    odds = np.where(hit, told, np.where(inside, np.log(HIDDEN), 0.0)).sum(1)
    return np.where(hit, nearest, -1), np.asarray(odds)


def _triangulate(views: _Views, rays: Array, at: Array, chosen: NDArray[np.int64]) -> Array:
    """Positions (P, 3) nearest to the rays of their blobs."""
    cameras = np.arange(len(rays))
    ray = rays[cameras, np.maximum(chosen, 0)]  # (P, C, 3)
    away = np.square(at[:, None] - views.position).sum(-1)
    weight = (chosen >= 0) * np.square(views.focal[:, 0] / views.error) / np.maximum(away, 1.0)
    across = (np.eye(3) - ray[..., :, None] * ray[..., None, :]) * weight[..., None, None]
    total = across.sum(1)
    trace = np.trace(total, axis1=1, axis2=2)[:, None, None]
    pulled = np.einsum("pcij,cj->pi", across, views.position) + 1e-9 * trace[:, :, 0] * at
    return np.linalg.solve(total + 1e-9 * np.maximum(trace, 1e-12) * np.eye(3), pulled[..., None])[..., 0]


def _margin(places: _Places, least: float) -> float:
    """Log odds of the best position against the best one of other blobs."""
    shared = ((places.chosen == places.chosen[0]) & (places.chosen[0] >= 0)).sum(1)
    # The same point with another blob in a camera or two is decided camera by camera: see `_certain`.
    rivals = places.odds[shared < 2]
    rival = max(float(rivals.max(initial=0.0)), 0.0)
    # A second position with the evidence of a light is a light, too, and it is unknown which of them is meant.
    return float(places.odds[0]) - rival if rival < least else 0.0


def _certain(views: _Views, at: Array, labels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Remove blobs (C, N) if a blob nearby may equally be the marker."""
    uv, _ = views.project(at)
    squared = np.square(uv[:, :, None] - views.blobs.ideal).sum(-1) / views.error[:, None] ** 2  # (N, C, M)
    near = (squared < REACH**2).sum(-1).T
    return np.where(near == 1, labels, -1)

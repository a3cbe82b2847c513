"""One camera, hardly more blobs than a pose needs: no label is told by the others, but all labellings are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations
from math import perm

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from imgcal.association.hypotheses import Poses
from imgcal.association.result import Identity, IdentityOptions, Status
from imgcal.association.verify import Fits, Scene, evidence, fit, problem_of, rig_and_pose, start
from imgcal.estimation import State, initial_pose, lm_cpu
from imgcal.types import Observations

MOST_LABELLINGS = 400
FITS = 0.999  # quantile of chi-squared that the right labelling stays below
LEAST_MARGIN = 8.0  # log odds against the best other labelling: all of them are known, and no hypotheses were chosen
LEAST_CHANCE = 6.0  # log odds against blobs that fit by chance, beyond those of trying all labellings


@dataclass(frozen=True)
class _Compared:
    """All labellings of one camera's blobs, each fitted as well as it goes."""

    fits: Fits
    cost: NDArray[np.float64]  # (K,) half of chi-squared
    off: NDArray[np.float64]  # (K,) px, RMS distance of blobs from their fiducials


def few(scene: Scene) -> bool:
    """Tell whether one camera alone has blobs, so few that all labellings can be compared."""
    seen, fiducials = scene.blobs.count, scene.obj.num_fiducials
    blobs = int(seen.max(initial=0))
    alone = blobs >= 4 and (seen >= 4).sum() == 1
    return bool(alone) and perm(max(blobs, fiducials), min(blobs, fiducials)) <= MOST_LABELLINGS


def compare_all(scene: Scene, options: IdentityOptions) -> Identity:
    """Accept the labelling that fits if no other one does, and it is not by chance; see `few`."""
    found = _compare(scene)
    best, order = int(found.cost.argmin()), len(scene.obj.symmetries)
    labels = found.fits.labels
    same = np.zeros(len(labels), bool)
    for motion in scene.obj.symmetries:
        same |= (labels[:, :, motion.permutation] == labels[best]).all((1, 2))
    rival = int(np.where(same, np.inf, found.cost).argmin())
    margin = float(found.cost[rival] - found.cost[best])
    chosen = fit(scene, found.fits.select(np.array([best])))
    rig, pose = rig_and_pose(scene, chosen, 0)
    labelled = int((labels[best] >= 0).sum())
    refusal = ""
    if 2 * found.cost[best] > chi2.ppf(FITS, 2 * labelled - 6):
        refusal = f"no labelling of the {labelled} blobs fits: the best is {found.off[best]:.2g} px off"
    elif margin < min(LEAST_MARGIN, options.least_margin):
        refusal = (
            f"two labellings fit within the rig's prior, chi-squared {2 * found.cost[best]:.1f} and "
            f"{2 * found.cost[rival]:.1f}: {labelled} blobs are too few"
        )
    elif evidence(scene, chosen)[0] < LEAST_CHANCE + np.log(len(labels)):
        refusal = f"{labelled} blobs are so few that any would fit some labelling"
    if refusal:
        none = np.full(scene.blobs.rows, -1)
        advice = "show more fiducials, to more cameras, or state a narrower prior in the rig if it is that well known"
        return Identity(none, pose, rig, "refused", 0, margin, f"{refusal}; {advice}")
    status: Status = "ambiguous" if order > 1 else "unique"
    reason = f"fits to {found.off[best]:.2g} px, chi-squared of the next best labelling is {2 * margin:.0f} more"
    return Identity(scene.blobs.to_rows(labels[best]), pose, rig, status, order, margin, reason, 1.0)


def _compare(scene: Scene) -> _Compared:
    """Fit every labelling from the best pose for it and, of a planar object, from its mirror image."""
    camera, fiducials = int(scene.blobs.count.argmax()), scene.obj.num_fiducials
    blobs = int(scene.blobs.count[camera])
    chosen = np.array(list(permutations(range(max(blobs, fiducials)), min(blobs, fiducials))))  # (K, n)
    labels = np.full((len(chosen), scene.rig.num_cameras, fiducials), -1, dtype=np.int64)
    if blobs >= fiducials:
        labels[:, camera] = chosen
    else:
        labels[np.arange(len(chosen))[:, None], camera, chosen] = np.arange(blobs)
    seen = torch.from_numpy(labels >= 0)[:, None]
    uv = torch.from_numpy(scene.blobs.uv[np.arange(scene.rig.num_cameras)[:, None], np.maximum(labels, 0)])[:, None]
    sigma = torch.ones(seen.shape, dtype=uv.dtype)
    found = initial_pose(Observations(uv, sigma, seen), scene.rig, scene.obj)[:, 0]
    poses = Poses(found.rotation.numpy(), found.translation.numpy())
    fitted = _minimized(scene, start(scene, poses, labels))
    if scene.obj.planar:
        fitted = _better(fitted, _minimized(scene, start(scene, _mirrored(scene, poses, camera), labels)))
    return fitted


def _better(first: _Compared, second: _Compared) -> _Compared:
    """The better one of two fits of each labelling."""
    other = second.cost < first.cost
    a, b, take = first.fits.state, second.fits.state, torch.from_numpy(other)
    state = State(
        torch.where(take[:, None, None], b.offset, a.offset),
        torch.where(take[:, None, None, None], b.rotation, a.rotation),
        torch.where(take[:, None, None], b.centre, a.centre),
    )
    cost, off = np.where(other, second.cost, first.cost), np.where(other, second.off, first.off)
    return _Compared(replace(first.fits, state=state, cost=cost), cost, off)


def _minimized(scene: Scene, fits: Fits) -> _Compared:
    """Fit each labelling with squared errors: what is off must count in full."""
    problem = problem_of(scene, fits)
    solution = lm_cpu.minimize(problem, fits.state, "squared", 1.0, 30, 1e-4)
    cost = solution.equations.cost.numpy()
    seen = (fits.labels >= 0)[:, None]
    squares = np.where(seen[:, :, :, None], solution.equations.residual.numpy() ** 2, 0.0).sum((1, 2, 3, 4))
    off = np.sqrt(squares / seen.sum((1, 2, 3)))
    cost = np.where(np.isfinite(cost), cost, np.inf)
    return _Compared(replace(fits, state=solution.state, cost=cost), cost, off)


def _mirrored(scene: Scene, poses: Poses, camera: int) -> Poses:
    """Poses (K,) of a planar object that look almost alike from a camera: turned about the view, depths reversed."""
    points = scene.obj.points.double().numpy()
    centroid = points.mean(0)
    normal = np.linalg.svd(points - centroid)[2][2]
    centre = poses.rotation @ centroid + poses.translation
    view = centre - scene.rig.positions[camera].numpy()
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    flip = np.eye(3) - 2 * view[:, :, None] * view[:, None, :]
    rotation = flip @ poses.rotation @ (np.eye(3) - 2 * np.outer(normal, normal))
    return Poses(rotation, centre - rotation @ centroid)

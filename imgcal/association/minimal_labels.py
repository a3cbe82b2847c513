"""Label hardly more blobs than a pose needs, in a single camera, by comparing all labellings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations
from math import perm

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import gammaincinv, logsumexp

from imgcal.association.hypotheses import Poses
from imgcal.association.identity import Identity, IdentityOptions, Status
from imgcal.association.verification import Fits, Scene, evidence, fit, make_problem, rig_and_pose, start
from imgcal.estimation import initial_pose, levenberg_marquardt_cpu
from imgcal.types import Observations

MOST_LABELLINGS = 400
FITS = 0.999  # quantile of chi-squared that limits the right labelling
LEAST_MARGIN = 7.0
"""Log odds against all other labellings together: all of them are known, and no hypotheses were selected."""
LEAST_CHANCE = 3.0
"""Log odds against blobs that fit by chance, in addition to the number of labellings. A pose and a rig as free as its
prior fit four foreign blobs about once in 200 images."""
MOST_RIVALS, FAR = 64, 60.0
"""Maximum number of labellings whose evidence is computed, and their maximum cost above the best one's."""


@dataclass(frozen=True)
class _Compared:
    """All labellings of one camera's blobs, each with its best fit."""

    fits: Fits
    cost: NDArray[np.float64]  # (K,) half of chi-squared
    off: NDArray[np.float64]  # (K,) px, RMS distance of blobs from their fiducials


def has_minimal_blobs(scene: Scene) -> bool:
    """Tell whether only one camera has blobs, and so few that all labellings can be compared."""
    seen, fiducials = scene.blobs.count, scene.obj.num_fiducials
    blobs = int(seen.max(initial=0))
    alone = blobs >= 4 and (seen >= 4).sum() == 1
    return bool(alone) and perm(max(blobs, fiducials), min(blobs, fiducials)) <= MOST_LABELLINGS


def compare_labellings(scene: Scene, options: IdentityOptions) -> Identity:
    """Accept the best labelling if all others are improbable, and a fit by chance, too; see `has_minimal_blobs`.

    Labellings are compared by their evidence: one that needs an exactly tuned pose or rig, edge-on or with a camera at
    the limit of its prior, is less probable than its residuals suggest.
    """
    found = _compare(scene)
    near = np.argsort(found.cost)[:MOST_RIVALS]
    near = near[found.cost[near] <= found.cost[near[0]] + FAR]
    fits = fit(scene, found.fits.select(near))
    weight = np.nan_to_num(evidence(scene, fits), nan=-np.inf)
    best, order = int(weight.argmax()), len(scene.obj.symmetries)
    labels, cost, off = fits.labels, found.cost[near], found.off[near]
    same = np.zeros(len(labels), bool)
    for motion in scene.obj.symmetries:
        same |= (labels[:, :, motion.permutation] == labels[best]).all((1, 2))
    rivals = np.where(same, -np.inf, weight)
    rival = int(rivals.argmax())
    margin = float(weight[best] - logsumexp(rivals)) if np.isfinite(weight[best]) else 0.0
    rig, pose = rig_and_pose(scene, fits, best)
    labelled = int((labels[best] >= 0).sum())
    refusal = ""
    if 2 * cost[best] > 2 * gammaincinv(labelled - 3, FITS):
        refusal = f"no labelling of the {labelled} blobs fits: the best is {off[best]:.2g} px off"
    elif margin < min(LEAST_MARGIN, options.least_margin):
        refusal = (
            f"two labellings fit within the rig's prior, chi-squared {2 * cost[best]:.1f} and {2 * cost[rival]:.1f}: "
            f"{labelled} blobs are too few"
        )
    elif weight[best] < LEAST_CHANCE + np.log(len(found.cost)):
        refusal = f"{labelled} blobs are so few that any would fit some labelling"
    if refusal:
        none = np.full(scene.blobs.rows, -1)
        advice = "show more fiducials, to more cameras, or state a narrower prior in the rig if it is that well known"
        return Identity(none, pose, rig, "refused", 0, margin, f"{refusal}; {advice}")
    status: Status = "ambiguous" if order > 1 else "unique"
    reason = f"fits to {off[best]:.2g} px, log odds against the next best labelling {margin:.0f}"
    rows = scene.blobs.to_rows(labels[best])
    return Identity(rows, pose, rig, status, order, margin, reason, 1.0, evidence=float(weight[best]))


def _compare(scene: Scene) -> _Compared:
    """Fit every labelling from its best pose and, for a planar object, from its mirror image.

    The other cameras have no labels, so they stay where their prior says.
    """
    camera = int(scene.blobs.count.argmax())
    fitted = _compare_alone(scene.select_camera(camera))
    fits, cameras = fitted.fits, scene.rig.num_cameras
    labels = np.full((len(fits.labels), cameras, scene.obj.num_fiducials), -1, dtype=np.int64)
    offset = np.zeros((len(labels), *scene.std.shape))
    labels[:, camera], offset[:, camera] = fits.labels[:, 0], fits.offset[:, 0]
    return replace(fitted, fits=replace(fits, labels=labels, offset=offset))


def _compare_alone(scene: Scene) -> _Compared:
    """Do the same for a single camera."""
    blobs, fiducials = int(scene.blobs.count[0]), scene.obj.num_fiducials
    chosen = np.array(list(permutations(range(max(blobs, fiducials)), min(blobs, fiducials))))  # (K, n)
    labels = np.full((len(chosen), 1, fiducials), -1, dtype=np.int64)
    if blobs >= fiducials:
        labels[:, 0] = chosen
    else:
        labels[np.arange(len(chosen))[:, None], 0, chosen] = np.arange(blobs)
    seen = torch.from_numpy(labels >= 0)[:, None]
    uv = torch.from_numpy(scene.blobs.uv[0, np.maximum(labels, 0)])[:, None]
    sigma = torch.ones(seen.shape, dtype=uv.dtype)
    found = initial_pose(Observations(uv, sigma, seen), scene.rig, scene.obj)[:, 0]
    poses = Poses(found.rotation.numpy(), found.translation.numpy())
    fitted = _minimize(scene, start(scene, poses, labels))
    if scene.obj.planar:
        fitted = _choose_better(fitted, _minimize(scene, start(scene, _mirror(scene, poses), labels)))
    return fitted


def _choose_better(first: _Compared, second: _Compared) -> _Compared:
    """The better of two fits of each labelling."""
    other = second.cost < first.cost
    a, b = first.fits, second.fits
    offset = np.where(other[:, None, None], b.offset, a.offset)
    rotation = np.where(other[:, None, None], b.rotation, a.rotation)
    centre = np.where(other[:, None], b.centre, a.centre)
    cost, off = np.where(other, second.cost, first.cost), np.where(other, second.off, first.off)
    return _Compared(replace(a, offset=offset, rotation=rotation, centre=centre, cost=cost), cost, off)


def _minimize(scene: Scene, fits: Fits) -> _Compared:
    """Fit each labelling with squared errors: errors must count in full."""
    problem = make_problem(scene, fits)
    solution = levenberg_marquardt_cpu.minimize(problem, fits.state, "squared", 1.0, 30, 1e-4)
    state, cost = solution.state, solution.equations.cost.numpy()
    seen = (fits.labels >= 0)[:, None]
    squares = np.where(seen[:, :, :, None], solution.equations.residual.numpy() ** 2, 0.0).sum((1, 2, 3, 4))
    off = np.sqrt(squares / seen.sum((1, 2, 3)))
    cost = np.where(np.isfinite(cost), cost, np.inf)
    offset, rotation, centre = (part.numpy() for part in (state.offset, state.rotation[:, 0], state.centre[:, 0]))
    return _Compared(replace(fits, offset=offset, rotation=rotation, centre=centre, cost=cost), cost, off)


def _mirror(scene: Scene, poses: Poses) -> Poses:
    """Poses (K,) of a planar object that look almost alike from the camera: mirrored in depth about the view."""
    points = scene.known.points
    centroid = points.mean(0)
    normal = np.linalg.svd(points - centroid)[2][2]
    centre = poses.rotation @ centroid + poses.translation
    view = centre - scene.rig.positions[0].numpy()
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    flip = np.eye(3) - 2 * view[:, :, None] * view[:, None, :]
    rotation = flip @ poses.rotation @ (np.eye(3) - 2 * np.outer(normal, normal))
    return Poses(rotation, centre - rotation @ centroid)

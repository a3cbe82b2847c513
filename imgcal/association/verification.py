"""Refine a rough labelling to a certain one: fit rig and pose, predict with uncertainty, relabel, repeat more finely.

A label can be judged only after such a fit: the factory rig alone is off by tens of pixels.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association.ambiguities import lattice_shifts
from imgcal.association.assignment import assign
from imgcal.association.blobs import PaddedBlobs, PriorSpread
from imgcal.association.hypotheses import Poses
from imgcal.association.innovation import (
    THRESHOLD,
    Innovations,
    SharedValues,
    find_contested,
    innovations,
    one_or_some,
)
from imgcal.estimation import Problem, State, cauchy, levenberg_marquardt_cpu
from imgcal.geometry import RigidTransform
from imgcal.medians import median
from imgcal.types import CalibrationObject, CameraRig
from renderers.compiling import njit

STAGES = (3.0, 0.7)
"""Standard deviations (px), beyond the blobs' own, in the first fits; the last ones use the residuals' level."""
GATE = 25.0
"""Maximum squared normalized innovation of a label; two degrees of freedom exceed it once in 270,000."""
LEAST_SIZE_SPREAD = 0.05
"""Minimum relative standard deviation of a blob's radius within its camera: depth, tilt and exposure vary."""
MOST_SIZE_MISFIT = 36.0
"""Maximum contribution of one blob, so that a single odd radius does not decide more."""
KNOWN_PLACE = 5.0
"""Standard deviation (px) of a prediction below which a stick's marker needs no other labelled marker beside it."""
UNDECIDED = 2 * np.log(1e3)
"""Minimum difference of squared normalized innovations between two distinguishable pairings."""


@dataclass(frozen=True)
class Known:
    """What is known before a snapshot: the object, the factory rig and its prior.

    All snapshots share it, and so do the values computed from it here.
    """

    obj: CalibrationObject
    rig: CameraRig
    std: Tensor  # (C, K)

    @cached_property
    def problem(self) -> Problem:
        """The problem of a single labelling, without labels."""
        points, radius = self.obj.points.double(), self.obj.radius
        centroid, cameras = points.mean(0), self.rig.num_cameras
        return Problem(
            uv=points.new_zeros(1, 1, cameras, 2, len(points)),
            root_weight=points.new_zeros(1, 1, cameras, len(points)),
            points=points - centroid,
            centroid=centroid,
            radius_squared=None if radius is None else radius.double().square(),
            factory=self.rig.expand(1),
            prior_std=self.std.expand(1, -1, -1),
        )

    @cached_property
    def solver(self) -> levenberg_marquardt_cpu.RigSolver:
        """Fits of one labelling after the other."""
        return levenberg_marquardt_cpu.RigSolver(self.problem)

    @cached_property
    def shared(self) -> SharedValues:
        """The same for predictions."""
        return SharedValues.of(self.problem)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Fiducials: (N, 3) mm."""
        return self.obj.points.double().numpy()

    @cached_property
    def image_size(self) -> NDArray[np.int64]:
        """Width and height: (C, 2) px."""
        return np.ascontiguousarray(self.rig.image_size.numpy())

    @cached_property
    def focal_length(self) -> float:
        """Mean over all cameras: px."""
        return float(self.rig.focal_length.numpy().mean())

    @cached_property
    def baseline(self) -> float:
        """Distance of the outermost camera from the middle of the rig: mm."""
        positions = self.shared.position
        return float(np.linalg.norm(positions - positions.mean(0), axis=1).max())

    @cached_property
    def spread(self) -> PriorSpread:
        """The prior's effect on the images of an object at any distance."""
        return PriorSpread.of(self.std, self.rig)

    def select_camera(self, camera: int) -> Known:
        """Keep one camera."""
        return Known(self.obj, self.rig.select([camera]), self.std[[camera]])


@dataclass(frozen=True)
class Scene:
    """Input of a fit: the blobs of a snapshot, and what is known beside them."""

    blobs: PaddedBlobs
    known: Known

    @property
    def obj(self) -> CalibrationObject:
        """The calibration object."""
        return self.known.obj

    @property
    def rig(self) -> CameraRig:
        """The factory rig."""
        return self.known.rig

    @property
    def std(self) -> Tensor:
        """Standard deviations of its prior: (C, K)."""
        return self.known.std

    def select_camera(self, camera: int) -> Scene:
        """Keep one camera."""
        return Scene(self.blobs.select_camera(camera), self.known.select_camera(camera))


@dataclass(frozen=True)
class Fits:
    """K labellings, each with the rig and pose that fit it best."""

    labels: NDArray[np.int64]  # (K, C, N) blob of each fiducial, -1 = none
    offset: NDArray[np.float64]  # (K, C, P) step from the factory rig in prior standard deviations
    rotation: NDArray[np.float64]  # (K, 3, 3) of the object
    centre: NDArray[np.float64]  # (K, 3) mm, where its centroid is
    sigma: NDArray[np.float64]  # (K,) px, error of blob centres beyond their own sigmas
    cost: NDArray[np.float64]  # (K,) half of chi2, data and prior
    innovations: Innovations | None = None  # of these labels with this rig and pose

    @property
    def state(self) -> State:
        """Rigs and poses as the solver's state."""
        offset, rotation, centre = map(torch.from_numpy, (self.offset, self.rotation, self.centre))
        return State(offset, rotation[:, None], centre[:, None])

    def select(self, rows: NDArray[np.int64]) -> Fits:
        """Keep the given labellings, without a copy if it is a single one."""
        chosen = one_or_some(rows)
        found = None if self.innovations is None else self.innovations.select(rows)
        places = (self.offset[chosen], self.rotation[chosen], self.centre[chosen])
        return Fits(self.labels[chosen], *places, self.sigma[chosen], self.cost[chosen], found)


def join(parts: Sequence[Fits]) -> Fits:
    """Concatenate fitted labellings of one snapshot."""
    if len(parts) == 1:
        return parts[0]
    found = [_require_innovations(part) for part in parts]

    def cat(records: Sequence[Any], kind: type[Fits | Innovations]) -> dict[str, Any]:
        names = [field.name for field in fields(kind) if field.name != "innovations"]
        return {name: np.concatenate([getattr(record, name) for record in records]) for name in names}

    return Fits(**cat(parts, Fits), innovations=Innovations(**cat(found, Innovations)))


def start(scene: Scene, poses: Poses, labels: NDArray[np.int64]) -> Fits:
    """Start with the factory rig at poses (K,) with rough labels (K, C, N)."""
    count = len(poses)
    u, _, vh = np.linalg.svd(poses.rotation)
    rotation = u @ vh
    centre = poses.translation + rotation @ scene.known.problem.centroid.numpy()
    return Fits(labels, np.zeros((count, *scene.std.shape)), rotation, centre, np.zeros(count), np.zeros(count))


def refine(scene: Scene, fits: Fits, stages: tuple[float, ...] = STAGES) -> Fits:
    """Alternate fitting and labelling through all stages; the last labels are fitted, too.

    Stages end early where the labels stay and the blobs' own errors explain the residuals.
    """
    for sigma in stages:
        before, fits = fits.labels, fit_and_label(scene, fits, sigma)
        if is_settled(before, fits):
            break
    return settle_labels(scene, fit(scene, fits), rounds=1)


def is_settled(before: NDArray[np.int64], fits: Fits) -> bool:
    """Tell whether more stages would change nothing: the labels stay, and their own errors explain all residuals."""
    return np.array_equal(before, fits.labels) and not fits.sigma.any()


def fit_and_label(scene: Scene, fits: Fits, sigma: float) -> Fits:
    """Fit with an error of `sigma` px beyond the blobs' own, and label again."""
    fits = fit(scene, replace(fits, sigma=np.full(len(fits.labels), sigma)))
    return replace(fits, sigma=np.minimum(residual_sigma(scene, fits), fits.sigma), labels=_assign(fits))


def settle_labels(scene: Scene, fits: Fits, rounds: int = 4) -> Fits:
    """Alternate labelling and fitting until the labels are stable, for at most `rounds` rounds."""
    for _ in range(rounds):
        labels = _assign(fits)
        if np.array_equal(labels, fits.labels):
            break
        fits = fit(scene, replace(fits, sigma=np.minimum(residual_sigma(scene, fits), fits.sigma), labels=labels))
    return fits


def drop_uncertain_labels(scene: Scene, fits: Fits, odds: float, least_odds: float) -> Fits:
    """Drop uncertain labels: those that a false blob or another fiducial may explain about as well.

    Args:
        scene: the input.
        fits: refined labellings.
        odds: minimum odds of a label against a false blob.
        least_odds: the same if false blobs are so dense that hardly any label reaches `odds`.
    """
    # Estimate the density of false blobs once: a dropped label must not count as a false blob against the others.
    surroundings = _label_gain(scene, fits, (fits.labels >= 0).sum((1, 2)))[:, None, None]
    log_odds = _log_density(_require_innovations(fits)) + surroundings
    finite = np.isfinite(log_odds)
    usual = median(log_odds[finite]) if finite.any() else 0.0
    demanded = np.clip(usual - np.log(100), np.log(least_odds), np.log(odds))
    # Two or three labels of one camera can support each other in the wrong place: most of its view must fit.
    # In a lattice, half of them can, one step away.
    most = 0.7 if lattice_shifts(scene.obj) else 0.5
    whole, stick = np.minimum(scene.blobs.count, scene.obj.num_fiducials), scene.obj.pose_rank == 5
    enough = np.maximum(2 if stick else 3, most * whole)
    for _ in range(4):
        found = _require_innovations(fits)
        log_odds = _log_density(found) + surroundings
        good = (found.own < GATE) & (log_odds > demanded) & ~find_contested(fits.labels, found, UNDECIDED)
        # A stick shows little of itself; if the rig predicts the place without it, one label is enough.
        known = stick & (found.log_det < 2 * np.log(KNOWN_PLACE**2))
        good &= (good.sum(-1) >= enough)[..., None] | known
        if np.array_equal(good, fits.labels >= 0):
            break
        fits = fit(scene, replace(fits, labels=np.where(good, fits.labels, -1)))
    return fits


def evidence(scene: Scene, fits: Fits) -> NDArray[np.float64]:
    """Log odds of each labelling against "all blobs are clutter" (Laplace's approximation): (K,)."""
    labelled = fits.labels >= 0
    noise = _blob_noise(scene, fits) + fits.sigma[:, None, None] ** 2
    found = _require_innovations(fits)
    gain = _label_gain(scene, fits, labelled.sum((1, 2)))[:, None, None] - np.log(2 * np.pi * noise)
    sizes = _size_misfit(scene, fits)
    return np.where(labelled, gain, 0).sum((1, 2)) - fits.cost - 0.5 * (found.complexity + sizes)


def most_evidence(scene: Scene, fits: Fits, labels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Estimate the evidence (K,) that other labellings (K, C, N) in the place of a fitted one have at most.

    All their labels fit exactly then, and so do all blobs that the fitted one leaves unlabelled.
    """
    unlabelled = scene.blobs.count - (fits.labels[0] >= 0).sum(1)
    count = np.minimum((labels >= 0).sum(2) + unlabelled, scene.obj.num_fiducials).sum(1)
    precision = -np.log(2 * np.pi * scene.blobs.sigma[scene.blobs.row >= 0] ** 2).mean()
    gain = _label_gain(scene, fits, count) + precision
    return np.asarray(count * gain - 0.5 * _require_innovations(fits).complexity[0])


def part_of_camera(scene: Scene, fits: Fits, camera: int) -> Fits:
    """Keep one camera's labels of fitted labellings, and their cost in this fit; see `Scene.select_camera`.

    A fit of that camera alone costs at most as much.
    """
    one = slice(camera, camera + 1)
    found, labels, offset = _require_innovations(fits), fits.labels[:, one], fits.offset[:, one]
    parts = (getattr(found, field.name) for field in fields(Innovations))
    variance = (_blob_noise(scene, fits) + fits.sigma[:, None, None] ** 2)[:, one]
    squared = np.where(labels >= 0, found.residual[:, one] / variance, 0)
    loss = cauchy(torch.from_numpy(squared), THRESHOLD)[0].sum((1, 2)).numpy()
    return replace(
        fits,
        labels=labels,
        offset=offset,
        cost=0.5 * (loss + (offset**2).sum((1, 2))),
        innovations=Innovations(*(part if part.ndim == 1 else part[:, one] for part in parts)),
    )


def predictions(fits: Fits) -> NDArray[np.float64]:
    """Predicted pixels of all fiducials under the first labelling: (C, N, 2)."""
    return _require_innovations(fits).uv[0]


def rig_and_pose(scene: Scene, fits: Fits, row: int) -> tuple[CameraRig, RigidTransform]:
    """Return the rig and rig_from_object of one labelling, without batch axes."""
    offset = torch.from_numpy(fits.offset[row : row + 1])
    return levenberg_marquardt_cpu.rig_at(scene.known.problem, offset)[0], select_pose(scene, fits, row)


def select_pose(scene: Scene, fits: Fits, row: int) -> RigidTransform:
    """Return rig_from_object of one labelling, without batch axes."""
    rotation = fits.rotation[row]
    translation = fits.centre[row] - rotation @ scene.known.problem.centroid.numpy()
    return RigidTransform(torch.from_numpy(rotation), torch.from_numpy(translation))


def _require_innovations(fits: Fits) -> Innovations:
    if fits.innovations is None:
        raise RuntimeError("labellings were not fitted")
    return fits.innovations


def _assign(fits: Fits) -> NDArray[np.int64]:
    return assign(_require_innovations(fits).squared, GATE)


def _blob_noise(scene: Scene, fits: Fits) -> NDArray[np.float64]:
    """Variance of each label's blob by its own sigma: (K, C, N) px^2."""
    return scene.blobs.sigma[np.arange(fits.labels.shape[1])[:, None], np.maximum(fits.labels, 0)] ** 2


def make_problem(scene: Scene, fits: Fits) -> Problem:
    """Convert labellings into an estimation problem."""
    count = len(fits.labels)
    uv, root_weight = (torch.from_numpy(array)[:, None] for array in _observe(scene, fits))
    factory, prior_std = scene.rig.expand(count), scene.std.expand(count, -1, -1)
    return replace(scene.known.problem, uv=uv, root_weight=root_weight, factory=factory, prior_std=prior_std)


def _observe(scene: Scene, fits: Fits) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (K, C, 2, N) of the labels, and their inverse standard deviations (K, C, N), 0 = no label."""
    seen, cameras = fits.labels >= 0, np.arange(fits.labels.shape[1])[:, None]
    uv = np.where(seen[..., None], scene.blobs.uv[cameras, np.maximum(fits.labels, 0)], 0.0)
    sigma = np.sqrt(_blob_noise(scene, fits) + fits.sigma[:, None, None] ** 2)
    return np.ascontiguousarray(uv.swapaxes(-1, -2)), seen / sigma


def fit(scene: Scene, fits: Fits) -> Fits:
    """Fit labellings without relabelling."""
    # Sequentially: on a busy machine, starting threads takes longer than a few small fits.
    columns = (*_observe(scene, fits), fits.offset, fits.rotation, fits.centre)
    solver = scene.known.solver
    fitted = [
        solver.fit_snapshot(uv, weight, tuple(first), "cauchy", THRESHOLD, 8, 1e-3)
        for uv, weight, *first in zip(*columns, strict=True)
    ]
    offset, rotation, centre = (
        np.stack([getattr(one, name) for one in fitted]) for name in ("offset", "rotation", "centre")
    )
    return Fits(
        fits.labels, offset, rotation, centre, fits.sigma, np.array([one.cost for one in fitted]),
        innovations(scene.blobs, fits.labels, fits.sigma, scene.known.shared, fitted),
    )  # fmt: skip


def residual_sigma(scene: Scene, fits: Fits) -> NDArray[np.float64]:
    """Error of blob centres beyond their own sigmas, from the residuals of labels within the gate: (K,) px."""
    found = _require_innovations(fits)
    inlier = (fits.labels >= 0) & (found.own < GATE)
    freedom = np.where(inlier, found.freedom, 0).sum((1, 2))
    variance = np.where(inlier, found.residual, 0).sum((1, 2)) / np.maximum(freedom, 1e-3)
    own = np.where(inlier, _blob_noise(scene, fits), 0).sum((1, 2)) / np.maximum(inlier.sum((1, 2)), 1)
    return np.asarray(np.sqrt(np.maximum(variance - own, 0)))


def _size_misfit(scene: Scene, fits: Fits) -> NDArray[np.float64]:
    """Chi2 of the blobs' radii if fiducials differ in theirs: (K,), with one unknown factor per camera."""
    radius = scene.obj.radius
    if radius is None or not bool((radius > 1.05 * radius.min()).any()):
        return np.zeros(len(fits.labels))
    seen = scene.blobs.radius[np.arange(fits.labels.shape[1])[:, None], np.maximum(fits.labels, 0)]
    with np.errstate(all="ignore"):
        ratio = np.log(np.where(fits.labels >= 0, seen, np.nan) / radius.numpy())
        ratio = np.where(np.isfinite(ratio).any(-1, keepdims=True), ratio, 0.0)
        misfit = np.abs(ratio - np.nanmedian(ratio, axis=-1, keepdims=True))
        usual = np.maximum(1.5 * np.nanmedian(misfit, axis=-1, keepdims=True), LEAST_SIZE_SPREAD)
    return np.nansum(np.minimum((misfit / usual) ** 2, MOST_SIZE_MISFIT), axis=(1, 2))


def _label_gain(scene: Scene, fits: Fits, labelled: NDArray[np.int64]) -> NDArray[np.float64]:
    """Log odds (K,) that a label adds to the evidence, without its blob's density, if there are `labelled` (K,)."""
    uv, size = _require_innovations(fits).uv, scene.known.image_size
    in_view, near, area = np.empty(len(uv)), np.empty(len(uv)), np.empty(len(uv))
    _survey(uv, size, scene.blobs.uv, (in_view, near, area))
    detected = np.clip((labelled + 1) / (in_view + 2), 0.05, 0.95)  # share of the visible fiducials
    # False blobs per square pixel, near the object's image or overall, whichever is larger.
    nearby = (np.maximum(near - labelled, 0) + 1) / area
    overall = (scene.blobs.count.sum() - labelled + 1) / size.prod(1).sum()
    return np.log(detected / (1 - detected)) - np.log(np.maximum(nearby, overall))


@njit(cache=True)
def _survey(uv, size, blobs, found):
    """Fill in the number of fiducials (K, C, N, 2) in view, and number of blobs and area near the object's image."""
    in_view, near, area = found
    for k in range(len(uv)):
        in_view[k], near[k], area[k] = 0, 0, 0
        for c in range(len(size)):
            left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
            for n in range(uv.shape[2]):
                u, v = uv[k, c, n, 0], uv[k, c, n, 1]
                in_view[k] += u > 0 and v > 0 and u < size[c, 0] and v < size[c, 1]
                left, top, right, bottom = min(left, u), min(top, v), max(right, u), max(bottom, v)
            wide, high = 0.75 * (right - left) + 10, 0.75 * (bottom - top) + 10
            area[k] += 4 * wide * high
            for m in range(blobs.shape[1]):
                off_u, off_v = blobs[c, m, 0] - (left + right) / 2, blobs[c, m, 1] - (top + bottom) / 2
                near[k] += abs(off_u) < wide and abs(off_v) < high


def _log_density(found: Innovations) -> NDArray[np.float64]:
    """Log density (per px^2) of each label's blob at its place (K, C, N); -inf = no label."""
    return -np.log(2 * np.pi) - 0.5 * found.log_det - 0.5 * found.own

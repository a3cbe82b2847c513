"""Test whether a camera has changed, by comparing later snapshots with earlier knowledge, for each kind of change.

Let P be the covariance of the earlier knowledge, A the information in the later snapshots and g the gradient of
their log likelihood at the earlier estimate. If nothing changed, the gradient left over after both have been combined,
r = g - A S^-1 g with S = P^-1 + A, has the covariance G = A - A S^-1 A. A jump d of a camera's parameters adds G d to
it. The score test looks for each kind of change of each camera (a generalized likelihood ratio with the jump
estimated). The same r and G give the probability of any jump with a known spread.

A camera model is never exact, and an object that hardly moves shows the same error in every snapshot. A jump that
moves the image by less than `MODEL_ERROR` is therefore always assumed.

Source: Willsky and Jones, "A Generalized Likelihood Ratio Approach to the Detection and Estimation of Jumps in Linear
Systems", 1976; Hausman, "Specification Tests in Econometrics", 1978.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import MOUNT_JOINT, error_by_step
from imgcal.types import PARAMETER_KINDS, CameraRig

CHANGES: Mapping[str, slice] = {kind: part for kind, part in PARAMETER_KINDS.items() if kind != "distortion"}
"""Kinds of change, and the camera parameters that each one covers."""
FORMS = {**CHANGES, "tilt": slice(0, 2), "turn in place": slice(0, 3), "tilt in place": slice(0, 2)}
"""The same, a rotation about an axis in the image plane, as by the joints of a mount, and both without a shift."""
TURNS = ("rotation", "tilt")
"""Forms in which a camera turns about a joint of its mount, which shifts it."""
FORMS_OF = {kind: (*TURNS, "turn in place", "tilt in place") if kind == "rotation" else (kind,) for kind in CHANGES}
"""Forms whose mean evidence is that of a kind: the joint may be at the projection centre, or far from it."""
MOTION_KINDS, MOTION = ("rotation", "position"), slice(0, 6)
"""Kinds of change that move the camera, and the parameters that they cover."""
UNUSUAL_LOG_PRIOR, UNUSUAL_SHARE = -30.0, 0.05
"""Prior log odds of a motion that is no turn about a joint, or a change of everything, against such a turn; and the
share of the evidence that it must explain in addition: where the object was seen briefly, errors of lenses and labels
explain as much."""
JUMPS = (0.6, 6.0, 60.0, 600.0)
"""Pixels: prior standard deviations of a change, all equally probable. They are image shifts, whatever the kind of
change, so that no kind is preferred."""
LARGE = 60.0
"""Pixels: the same for a camera that has moved, judged by the labels that it still has ..."""
LENS = 60.0
"""... and the upper limit for focal length, principal point and distortion: no push changes them by more."""
DISTORTED = 2e-4
"""Standard deviation of the distortion for each such pixel if the kind of change is unknown."""
LEAST_LEARNT = 1e-6
"""Minimum share of the best-known direction's information; directions below it are left out."""
LEAST_VARIANCE = 1e-3
"""Minimum share of a variance that remains after a subtraction: guards against rounding."""
MODEL_ERROR = 0.02
"""Pixels, one standard deviation per axis: slowly varying error of a camera's image."""
SLOPE = 0.25
"""Tangent of the angle to the optical axis at which a change of focal length is converted to pixels."""
USUAL_DISTANCE = 1000.0  # mm, for a rig without a working distance


def pixel_changes(rig: CameraRig) -> Tensor:
    """Change of each parameter that moves the image by about one pixel: (C, K)."""
    focal = rig.focal_length.mean(-1, keepdim=True)
    change = torch.ones(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
    change[:, :3] /= focal
    change[:, 2] /= SLOPE
    change[:, 3:6] *= (rig.working_distance or USUAL_DISTANCE) / focal
    change[:, 5] /= SLOPE
    change[:, 6:8] /= SLOPE
    change[:, 10:] = DISTORTED * rig.has_coefficient
    return change


def change_std(changes: Mapping[int, str | None], pixels: Tensor, jump: float = LARGE) -> Tensor:
    """Standard deviations (C, K) of changes, by camera and form (None = any); zero where nothing changes.

    A camera that turns about a joint of its mount is also shifted, by the distance to the joint times the angle.

    Args:
        changes: form of the change, one of `FORMS`, of each camera that changed.
        pixels: (C, K) see `pixel_changes`.
        jump: pixels.
    """
    std = torch.zeros_like(pixels)
    for camera, kind in changes.items():
        part = slice(None) if kind is None else FORMS[kind]
        std[camera, part] = jump * pixels[camera, part]
        if kind in TURNS:
            std[camera, CHANGES["position"]] = MOUNT_JOINT * std[camera, 0]
    std[:, 6:] *= min(1.0, LENS / jump)
    return std


def possible_changes(camera: int, kind: str, pixels: Tensor, angle: float) -> list[tuple[Tensor, bool]]:
    """Describe what may have changed together with a kind of change.

    A camera turns about a joint of its mount, which shifts it; a lens changes alone. Less probably, the camera turned
    and was shifted in any way, or everything changed.

    Args:
        camera: that changed.
        kind: of `CHANGES`.
        pixels: (C, K) see `pixel_changes`.
        angle: rad, by which it has turned roughly.

    Returns:
        Prior standard deviations (C, K) for each possibility, and whether it is unusual.
    """
    found = []
    for jump in JUMPS:
        usual = change_std({camera: "rotation" if kind in MOTION_KINDS else kind}, pixels, jump)
        everything = change_std({camera: None}, pixels, jump)
        any_motion = usual.clone()
        any_motion[camera, MOTION] = everything[camera, MOTION]
        if kind in MOTION_KINDS:
            usual[camera, CHANGES["position"]] = MOUNT_JOINT * angle
        found += [(usual, False), (any_motion, True), (everything, True)]
        if kind == "position":
            found.append((change_std({camera: kind}, pixels, jump), False))
    return found


def camera_change_errors(rig: CameraRig, unit: Tensor) -> Tensor:
    """Derivative of errors in units by a camera's own parameters: (C, K, K); a turn about its centre shifts nothing."""
    return error_by_step(rig) / unit[:, :, None]


@dataclass(frozen=True)
class Comparison:
    """Later snapshots beside earlier knowledge, from which tests are made.

    Raises:
        RefusedError: nothing is known about the rig; raised by both tests.
    """

    information: Tensor  # (D, D) of the earlier knowledge, aged to the time of the later snapshots
    brought: Tensor  # (D, D) information of the later snapshots
    pull: Tensor  # (D,) gradient of the later snapshots at the earlier estimate of the rig
    change: Tensor  # (C, K, K) see `camera_change_errors`
    pixels: Tensor  # (C, K) see `pixel_changes`
    lasting: Tensor | float = MODEL_ERROR  # (C,) px, see `NoiseCorrelation.model_error`

    def test_each(self) -> OwnTest:
        """Prepare the test of each camera alone: a third of the work of all together."""
        change, cameras, wide = self.change, len(self.change), self.pixels.numel()
        half = self._whiten()
        each = half[:, :-1].unflatten(1, (cameras, -1)).movedim(1, 0)  # (C, D, K)
        own = _own_blocks(self.brought[:wide, :wide], cameras) - each.mT @ each
        left = (self.pull[:wide] - half[:, :-1].mT @ half[:, -1]).unflatten(0, (cameras, -1))
        learnt = change.mT @ own @ change
        pull = (change.mT @ left[..., None])[..., 0]
        return OwnTest(pull, 0.5 * (learnt + learnt.mT), self.pixels, self.lasting)

    def test_together(self) -> ChangeTest:
        """Prepare the test of all cameras together."""
        change, cameras, wide = self.change, len(self.change), self.pixels.numel()
        half = self._whiten()
        left = torch.cat((self.brought[:wide, :wide], self.pull[:wide, None]), 1) - half[:, :wide].mT @ half
        own = torch.einsum("cij,cik->cjk", change, left.unflatten(0, (cameras, -1)))  # (C, K, K C + 1)
        learnt = own[..., :-1].unflatten(-1, (cameras, -1))
        learnt = torch.einsum("cidj,djk->cidk", learnt, change).reshape(wide, wide)
        return ChangeTest(own[..., -1].flatten(), 0.5 * (learnt + learnt.mT), self.pixels, self.lasting)

    def _whiten(self) -> Tensor:
        """L^-1 (A, g) of the cameras' K C columns of A, where L L^T = S: (D, K C + 1)."""
        factor, failed = torch.linalg.cholesky_ex(self.information + self.brought)
        if bool(failed):
            raise RefusedError("estimation: these observations do not determine the rig")
        right = torch.cat((self.brought[:, : self.pixels.numel()], self.pull[:, None]), 1)
        return torch.linalg.solve_triangular(factor, right, upper=False)


@dataclass(frozen=True)
class OwnTest:
    """The gradient left over for each camera's own parameters, with its covariance: those blocks of r and G that the
    scores need.
    """

    pull: Tensor  # (C, K)
    learnt: Tensor  # (C, K, K) its covariance if nothing has changed
    pixels: Tensor  # (C, K) see `pixel_changes`
    lasting: Tensor | float = MODEL_ERROR  # (C,) px: persistent error of each image without any change

    def scores(self) -> dict[str, Tensor]:
        """Test each camera for each kind of change: (C,) for each of `CHANGES`.

        If nothing has changed, a score is chi-squared with at most as many degrees of freedom as the kind has
        parameters.
        """
        error = torch.as_tensor(self.lasting, dtype=self.pixels.dtype)[..., None] * self.pixels
        found = _Own.of(_by_kind(self.pull), _by_kind(self.learnt, 2)).score(_by_kind(error).square())
        return dict(zip(CHANGES, found, strict=True))

    def model_error(self, kind: str) -> Tensor:
        """Change in a kind with k parameters that a camera model error may imitate: (C, k) for each camera."""
        return torch.as_tensor(self.lasting, dtype=self.pixels.dtype)[..., None] * self.pixels[:, CHANGES[kind]]

    def change(self, kind: str, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Estimate a change of each camera in a kind with k parameters that also take a random walk.

        Args:
            kind: of `CHANGES`.
            variance: (C, k) of the random walk beyond the assumed rate; negative values are possible.

        Returns:
            Its information (C, k, k) and its gradient (C, k).
        """
        part = CHANGES[kind]
        return _Own.of(self.pull[:, part], self.learnt[:, part, part]).change(variance)


@dataclass(frozen=True)
class ChangeTest:
    """The gradient left over for the own parameters of all cameras together: r and G, which all tests use."""

    pull: Tensor  # (K C,)
    learnt: Tensor  # (K C, K C) its covariance if nothing has changed
    pixels: Tensor  # (C, K) see `pixel_changes`
    lasting: Tensor | float = MODEL_ERROR  # (C,) px: persistent error of each image without any change

    @property
    def each(self) -> OwnTest:
        """The test of each camera alone."""
        pull, cameras = self.pull.unflatten(0, self.pixels.shape), len(self.pixels)
        return OwnTest(pull, _own_blocks(self.learnt, cameras), self.pixels, self.lasting)

    def odds(self, changes: Mapping[int, str | None]) -> float:
        """Log odds of the given changes (None = of any kind) against no change."""
        found = []
        for jump in JUMPS:
            _, factor, pull = self._free(change_std(changes, self.pixels, jump))
            found.append(_log_odds(factor, pull) - math.log(len(JUMPS)))
        return float(torch.logsumexp(torch.stack(found), 0))

    def condition_on(self, changes: Mapping[int, str | None]) -> ChangeTest:
        """Test the other cameras, given that these may have changed."""
        scaled, factor, pull = self._free(change_std(changes, self.pixels))
        taken = torch.linalg.solve_triangular(factor, scaled, upper=False)
        return ChangeTest(self.pull - taken.mT @ pull, self.learnt - taken.mT @ taken, self.pixels, self.lasting)

    def jump(self, camera: int, kind: str) -> tuple[Tensor, Tensor]:
        """Estimate a camera's change in a kind with K parameters, if no other changed: (K,) and covariance (K, K)."""
        first = camera * self.pixels.shape[1]
        part = slice(first + CHANGES[kind].start, first + CHANGES[kind].stop)
        covariance = torch.linalg.pinv(self.learnt[part, part], hermitian=True)
        return covariance @ self.pull[part], covariance

    def estimate(self, camera: int, kind: str) -> tuple[Tensor, Tensor]:
        """Estimate all changes of a camera by the mean over what may have changed with a kind, if no other changed.

        Returns:
            The changes (K,) and their covariance (K, K).
        """
        turns = [change_std({camera: "turn in place"}, self.pixels, jump) for jump in JUMPS]
        turn, _ = self._average(camera, [(std, False) for std in turns])
        return self._average(camera, possible_changes(camera, kind, self.pixels, float(turn[:3].norm())))

    def _average(self, camera: int, possibilities: Sequence[tuple[Tensor, bool]]) -> tuple[Tensor, Tensor]:
        """Average a camera's changes (K,) over possible ones, with their covariance (K, K); see `possible_changes`.

        What all other possibilities would explain beyond these is an error of the model, and makes them less certain.
        """
        own = slice(camera * self.pixels.shape[1], (camera + 1) * self.pixels.shape[1])
        evidence, means, covariances = [], [], []
        for std, _ in possibilities:
            _, factor, pull = self._free(std)
            rows = std.flatten().nonzero()[:, 0]
            half = torch.zeros(len(factor), self.pixels.numel(), dtype=std.dtype)
            half[:, rows] = torch.linalg.solve_triangular(factor, torch.diag(std.flatten()[rows]), upper=False)
            evidence.append(_log_odds(factor, pull))
            means.append(half[:, own].mT @ pull)
            covariances.append(half[:, own].mT @ half[:, own])
        odds, unusual = torch.stack(evidence), torch.tensor([unusual for _, unusual in possibilities])
        penalty = UNUSUAL_SHARE * odds[~unusual].max().clamp_min(0) - UNUSUAL_LOG_PRIOR
        share, mean = (odds - penalty * unusual).softmax(0), torch.stack(means)
        unexplained = odds.max() - share @ odds + UNUSUAL_LOG_PRIOR
        inflation = (2 * unexplained / self.pixels.shape[1]).clamp_min(1.0)
        estimate = share @ mean
        between = mean - estimate
        within = inflation * torch.einsum("m,mij->ij", share, torch.stack(covariances))
        return estimate, within + (between.mT * share) @ between

    def _free(self, std: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Describe the effect of R parameters that may have changed, in units of their standard deviations (C, K).

        Returns:
            Covariance with all gradients (R, K C), Cholesky factor (R, R) of the covariance of their own, jump
            included, and the whitened gradient (R,).
        """
        std = std.flatten()
        rows = std.nonzero()[:, 0]
        scaled = std[rows, None] * self.learnt[rows]
        own = scaled[:, rows] * std[rows]
        factor = torch.linalg.cholesky(own + torch.eye(len(rows), dtype=std.dtype))
        pull = torch.linalg.solve_triangular(factor, (std * self.pull)[rows, None], upper=False)[:, 0]
        return scaled, factor, pull


def _log_odds(factor: Tensor, pull: Tensor) -> Tensor:
    """Log odds of changes against none, from what `ChangeTest._free` returns."""
    return 0.5 * pull.square().sum() - factor.diagonal().log().sum()


def _own_blocks(matrix: Tensor, cameras: int) -> Tensor:
    """Blocks (C, K, K) along the diagonal of a matrix (K C, K C)."""
    square = matrix.unflatten(0, (cameras, -1)).unflatten(-1, (cameras, -1))
    return square.diagonal(dim1=0, dim2=2).movedim(-1, 0)


def _by_kind(values: Tensor, axes: int = 1) -> Tensor:
    """Divide the last axes, of K parameters each, by kind: (kinds, C, 3) or (kinds, C, 3, 3), filled with zeros."""
    most = max(part.stop - part.start for part in CHANGES.values())
    own = [(values[(slice(None), *axes * (part,))], most - part.stop + part.start) for part in CHANGES.values()]
    return torch.stack([torch.nn.functional.pad(block, axes * (0, lacking)) for block, lacking in own])


@dataclass(frozen=True)
class _Own:
    """The gradient left over for a few parameters of each camera, along directions that have been observed."""

    along: Tensor  # (*B, k) in standard deviations without a change; zero in unobserved directions
    spread: Tensor  # (*B, k, k) its derivative by a change of each parameter

    @classmethod
    def of(cls, pull: Tensor, learnt: Tensor) -> _Own:
        """Take gradients (*B, k) and their covariance (*B, k, k)."""
        scale = learnt.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).sqrt()
        values, vectors = torch.linalg.eigh(learnt / (scale[..., :, None] * scale[..., None, :]))
        known = values > LEAST_LEARNT
        root = torch.where(known, values, 1.0).sqrt()
        along = torch.where(known, (vectors.mT @ (pull / scale)[..., None])[..., 0] / root, 0.0)
        return cls(along, scale[..., :, None] * vectors * torch.where(known, root, 0.0)[..., None, :])

    def score(self, variance: Tensor) -> Tensor:
        """Squared norms (*B), whitened by a covariance that includes changes of a variance (*B, k)."""
        values, vectors = self._add_changes(variance)
        return ((vectors.mT @ self.along[..., None])[..., 0].square() / values).sum(-1)

    def change(self, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Information (*B, k, k) and gradient (*B, k) of a change, in addition to changes of a variance (*B, k)."""
        values, vectors = self._add_changes(variance)
        spread = self.spread @ vectors / values.sqrt()[..., None, :]
        along = (vectors.mT @ self.along[..., None])[..., 0] / values.sqrt()
        return spread @ spread.mT, (spread @ along[..., None])[..., 0]

    def _add_changes(self, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Variances (*B, k) with changes added, and their directions (*B, k, k)."""
        values, vectors = torch.linalg.eigh(self.spread.mT @ (variance[..., :, None] * self.spread))
        return (1 + values).clamp_min(LEAST_VARIANCE), vectors

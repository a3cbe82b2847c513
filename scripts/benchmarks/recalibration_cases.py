"""Data of the recalibration benchmark, and the scores of results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from imgcal.estimation import EstimationOptions, estimate, initial_pose, relative_covariance, relative_difference
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, read_rig
from imgcal.synthesis import PhysicalDrift, PoseRange
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import PARAMETERS, CalibrationObject, CameraRig, Observations
from scripts.benchmarks.peers.rig_task import RigAnswer, RigTask

SQUARED = EstimationOptions(loss="squared")
DRIFT = PhysicalDrift(rotation_deg=1.0, position=10.0, focal_length=0.05, principal_point=10.0, distortion=0.005)
NOISE = 0.05  # px, each axis
KINDS = ("focal_length", "principal_point", "rotation", "position")
UNUSABLE = 0.2  # share of the true focal length; smaller factory values are redrawn


@dataclass(frozen=True)
class Cases:
    """Snapshots of the true rig, one factory calibration per case, and the start poses for all methods."""

    truth: CameraRig
    obj: CalibrationObject
    factory: CameraRig  # (B)
    prior_std: Tensor  # (C, 15)
    poses: RigidTransform  # (B, S)
    observations: Observations  # (B, S, C, N)
    start: RigidTransform  # (B, S) by imgcal.estimation.pose_initialization, with the factory rig

    def __len__(self) -> int:
        return len(self.observations.uv)

    def one(self, index: int) -> Observations:
        """Observations of one case: (S, C, N)."""
        given = self.observations
        return Observations(given.uv[index], given.sigma[index], given.seen[index])

    def task(self, index: int) -> RigTask:
        """The same as plain arrays, for the peers."""
        factory, start = self.factory[index], self.start[index]
        width, height = (int(size) for size in factory.image_size[0])
        return RigTask(
            points=self.obj.points.numpy(),
            uv=self.observations.uv[index].numpy(),
            sigma=NOISE,
            focal_length=factory.focal_length.numpy(),
            principal_point=factory.principal_point.numpy(),
            distortion=factory.distortion.numpy(),
            rotation=factory.cam_from_rig.rotation.numpy(),
            translation=factory.cam_from_rig.translation.numpy(),
            start_rotation=start.rotation.numpy(),
            start_translation=start.translation.numpy(),
            prior_std=self.prior_std.numpy(),
            image_size=(width, height),
        )


def make_cases(count: int, snapshots: int, seed: int, scale: float = 1.0) -> Cases:
    """Simulate random poses in front of O10; perturb its factory calibration by `scale` times the drift."""
    truth, obj = read_rig("O10"), load_object("asymmetric8")
    generator = torch.Generator().manual_seed(seed)
    prior_std = scale * DRIFT.std(truth)
    poses = _poses(truth, obj, generator, count, snapshots)
    uv = _images(truth, obj, poses)
    uv = uv + NOISE * torch.randn(uv.shape, generator=generator, dtype=uv.dtype)
    observations = _observed(uv)
    factory = truth.retract(_offsets(prior_std, count, generator, truth))
    return Cases(truth, obj, factory, prior_std, poses, observations, initial_pose(observations, factory, obj))


def _offsets(prior_std: Tensor, count: int, generator: torch.Generator, truth: CameraRig) -> Tensor:
    """Draw errors (B, C, 15), and redraw those that make a focal length far too short."""
    offsets = prior_std * torch.randn(count, *prior_std.shape, generator=generator, dtype=prior_std.dtype)
    while bool((bad := ((offsets[..., 6:8] / truth.focal_length) < UNUSABLE - 1).any(-1)).any()):
        offsets[bad] = (prior_std * torch.randn(offsets.shape, generator=generator, dtype=prior_std.dtype))[bad]
    return offsets


def _poses(
    rig: CameraRig, obj: CalibrationObject, generator: torch.Generator, count: int, snapshots: int
) -> RigidTransform:
    distance = rig.working_distance or 850.0
    sampled = sample_rig_from_object(count * snapshots, distance, obj.points.mean(0), PoseRange(), generator)
    return sampled.reshape(count, snapshots)


def _images(rig: CameraRig, obj: CalibrationObject, poses: RigidTransform) -> Tensor:
    """Project: (B, S, C, N, 2)."""
    points = poses.apply(obj.points)
    return rig.project(points.flatten(1, 2)).uv.unflatten(2, points.shape[1:3]).movedim(1, 2).contiguous()


def _observed(uv: Tensor) -> Observations:
    seen = torch.ones(uv.shape[:-1], dtype=torch.bool)
    return Observations(uv, torch.full_like(uv[..., 0], NOISE), seen)


@dataclass(frozen=True)
class Score:
    """Errors of the results, one number per case."""

    squares: dict[str, np.ndarray]  # (B,) mean squared error of each of KINDS: px, px, degrees, mm
    held_out: np.ndarray  # (B,) px, RMS per axis on held-out poses
    fit: np.ndarray  # (B,) px, the same on the given observations


def score(answers: Sequence[RigAnswer], cases: Cases, seed: int = 99, fresh: int = 20) -> Score:
    """Score results (B) against the truth; object poses are refitted with each rig fixed."""
    found = rigs(answers, cases.truth)
    squares = _of_kinds(relative_difference(found, cases.truth).square())
    generator = torch.Generator().manual_seed(seed)
    poses = _poses(cases.truth, cases.obj, generator, len(answers), fresh)
    unseen = _observed(_images(cases.truth, cases.obj, poses))
    count = len(answers)
    given = cases.observations
    given = Observations(given.uv[:count], given.sigma[:count], given.seen[:count])
    return Score(squares, _misfit(found, unseen, cases), _misfit(found, given, cases))


def bound(cases: Cases) -> dict[str, np.ndarray]:
    """Posterior Cramér-Rao bound from observations and prior: one mean variance per case."""
    found = estimate(
        cases.observations, cases.factory, cases.obj, cases.poses, prior_std=cases.prior_std, initial_rig=cases.truth,
        options=SQUARED,
    )  # fmt: skip
    return _of_kinds(relative_covariance(found).diagonal(dim1=-2, dim2=-1).unflatten(-1, (-1, PARAMETERS)))


def _of_kinds(squares: Tensor) -> dict[str, np.ndarray]:
    """Mean over the cameras of squares (B, C, 15), extrinsics relative to the first camera."""
    others = squares[:, 1:]
    return {
        "focal_length": squares[..., 6:8].mean((1, 2)).numpy(),
        "principal_point": squares[..., 8:10].mean((1, 2)).numpy(),
        "rotation": others[..., 0:3].sum(-1).mean(1).numpy() * math.degrees(1) ** 2,
        "position": others[..., 3:6].sum(-1).mean(1).numpy(),
    }


def rigs(answers: Sequence[RigAnswer], like: CameraRig) -> CameraRig:
    def stacked(name: str) -> Tensor:
        return torch.from_numpy(np.nan_to_num(np.array([getattr(answer, name) for answer in answers], dtype=float)))

    return replace(
        like,
        focal_length=stacked("focal_length"),
        principal_point=stacked("principal_point"),
        distortion=stacked("distortion"),
        cam_from_rig=RigidTransform(stacked("rotation"), stacked("translation")),
    )


def _misfit(rigs: CameraRig, observations: Observations, cases: Cases) -> np.ndarray:
    """RMS residual (B,) with fixed rigs and fitted poses."""
    held = torch.zeros_like(cases.prior_std)
    snapshots = observations.uv.shape[1]
    parts = (observations.uv, observations.sigma, observations.seen)
    every = Observations(*(value.flatten(0, 1)[:, None] for value in parts))
    repeated = rigs.map_tensors(lambda tensor, _: tensor.repeat_interleave(snapshots, 0))
    found = estimate(every, repeated, cases.obj, prior_std=held, options=SQUARED)
    return (found.rms.unflatten(0, (-1, snapshots)).square().mean(1) / 2).sqrt().nan_to_num(math.inf).numpy()

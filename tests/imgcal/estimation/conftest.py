"""Simulated observations for the tests of estimation."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from imgcal.estimation import Problem, State, initial_state, make_problem
from imgcal.geometry import RigidTransform
from imgcal.synthesis import Drift, PhysicalDrift, PoseRange
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import CalibrationObject, CameraRig, Observations


@dataclass(frozen=True)
class Case:
    """Simulated observations and the truth behind them."""

    factory: CameraRig
    obj: CalibrationObject
    truth: CameraRig  # (*B)
    poses: RigidTransform  # (*B, S)
    observations: Observations  # (*B, S, C, N)
    prior_std: Tensor  # (C, 15)
    shape: Tensor  # (*B, N, 3) mm, the fiducials as they truly are

    def problem(self) -> Problem:
        """Flatten and whiten."""
        return make_problem(self.observations, self.factory, self.obj, self.prior_std)

    def start(self, problem: Problem, shift: float = 2.0, initial_rig: CameraRig | None = None) -> State:
        """Start at the factory values, or a guess, and `shift` mm from the true poses."""
        return initial_state(problem, RigidTransform(self.poses.rotation, self.poses.translation + shift), initial_rig)


Simulate = Callable[..., Case]


@pytest.fixture(scope="package", autouse=True)
def one_thread() -> Iterator[None]:
    """Keep to one thread: on a busy machine, threads that wait for each other after every tiny product crawl."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def simulate(o10: CameraRig, asymmetric8: CalibrationObject) -> Simulate:
    """Return a function that simulates observations of drifted rigs."""

    def make(
        *batch: int,
        snapshots: int = 2,
        cameras: int = 10,
        fiducials: int = 8,
        noise: float = 0.05,
        sigma: float = 0.05,
        drift: Drift = PhysicalDrift(),
        missing: float = 0.0,
        radius: float | None = None,
        tolerance: float | None = None,
        bent: float = 0.0,
        scale_tolerance: float = 0.0,
        seed: int = 0,
    ) -> Case:
        generator = torch.Generator().manual_seed(seed)
        factory = o10.select(range(cameras))
        radii = None if radius is None else torch.full((fiducials,), radius, dtype=torch.float64)
        obj = replace(
            asymmetric8, points=asymmetric8.points[:fiducials], colours=asymmetric8.colours[:fiducials], radius=radii
        )
        given = obj
        if tolerance is not None or scale_tolerance:
            prior_std = None if tolerance is None else torch.full((fiducials,), tolerance, dtype=torch.float64)
            given = replace(obj, tolerance=prior_std, scale_tolerance=scale_tolerance)
        truth = drift.apply(factory, generator, *batch)
        count = torch.Size((*batch, snapshots)).numel()
        centroid, distance = obj.points.mean(0), factory.working_distance
        assert distance is not None
        poses = sample_rig_from_object(count, distance, centroid, PoseRange(), generator).reshape(*batch, snapshots)
        own = torch.Generator().manual_seed(seed)
        offset = bent * torch.randn(*batch, 1, fiducials, 3, generator=own, dtype=torch.float64)
        scale = scale_tolerance * torch.randn(*batch, 1, 1, 1, generator=own, dtype=torch.float64)
        shape = obj.points + scale * (obj.points - obj.points.mean(0)) + offset
        shape = shape.expand(*batch, snapshots, fiducials, 3)
        points = poses.apply(shape)  # (*B, S, N, 3)
        repeated = None if radii is None else radii.repeat(snapshots)
        uv = truth.project(points.flatten(-3, -2), repeated).uv
        uv = uv.unflatten(-2, (snapshots, fiducials)).movedim(-3, -4).contiguous()  # (*B, S, C, N, 2)
        uv = uv + noise * torch.randn(uv.shape, generator=generator, dtype=uv.dtype)
        seen = torch.rand(uv.shape[:-1], generator=generator) >= missing
        uv = torch.where(seen[..., None], uv, -1e6)
        observations = Observations(uv, torch.full_like(uv[..., 0], sigma), seen)
        return Case(factory, given, truth, poses, observations, drift.std(factory), shape[..., 0, :, :])

    return make

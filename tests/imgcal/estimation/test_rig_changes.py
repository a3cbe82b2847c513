"""Scores of changes: chi-squared while nothing changes, and what a change would add."""

import math

import torch

import imgcal
from imgcal.estimation import CHANGES, RigBelief, absorbed, change_scores, jump, widened
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CameraRig, Observations

NOISE = 0.1


def seen(rig: CameraRig, obj, poses, generator: torch.Generator) -> Observations:
    """Noisy observations (S, C, N) of an object."""
    uv = rig.expand(len(poses.translation)).project(poses.apply(obj.points)).uv
    uv = uv + NOISE * torch.randn(uv.shape, generator=generator, dtype=torch.float64)
    sure = torch.ones(uv.shape[:-1], dtype=torch.bool)
    return Observations(uv, torch.full(sure.shape, NOISE, dtype=torch.float64), sure)


def test_scores_of_a_steady_rig_are_chi_squared_and_those_of_a_bumped_camera_are_not() -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(2)
    truth = simulate_truth(factory, obj, 40, generator, PhysicalDrift())
    poses = truth.rig_from_object
    known = absorbed(RigBelief.of_prior(factory, obj), seen(truth.rig, obj, poses[:20], generator), poses[:20]).belief
    steady = []
    for first in range(20, 40, 2):
        later = absorbed(known, seen(truth.rig, obj, poses[first : first + 2], generator), poses[first : first + 2])
        steady.append(torch.stack(list(change_scores(known, later.belief).values())))
    scores = torch.stack(steady)  # (10, kinds, C)
    for number, part in enumerate(CHANGES.values()):
        freedom = part.stop - part.start
        assert abs(float(scores[:, number].mean()) - freedom) < 4 * math.sqrt(2 * freedom / 40)
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[2, 8] = 1.0  # px
    bumped = truth.rig.retract(step)
    later = absorbed(known, seen(bumped, obj, poses[20:23], generator), poses[20:23]).belief
    found = change_scores(known, later)
    assert int(found["principal_point"].argmax()) == 2
    assert float(found["principal_point"][2]) > 100


def test_the_covariance_of_a_jump_is_that_of_what_is_found() -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(3)
    truth = simulate_truth(factory, obj, 24, generator, PhysicalDrift())
    poses = truth.rig_from_object
    known = absorbed(RigBelief.of_prior(factory, obj), seen(truth.rig, obj, poses[:20], generator), poses[:20]).belief
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[1, 6:8] = torch.tensor([3.0, -2.0])
    variance = torch.zeros(4, 15, dtype=torch.float64)
    variance[1, 6:8] = 30.0**2
    let_free = widened(known, variance)
    squares = []
    for _ in range(8):
        there = seen(truth.rig.retract(step), obj, poses[20:], generator)
        after = absorbed(let_free, there, poses[20:]).belief
        found, covariance = jump(known, let_free, after, 1, "focal_length")
        error = found - step[1, 6:8]
        squares.append(float(error @ torch.linalg.solve(covariance, error)))
    assert 0.5 < sum(squares) / len(squares) / 2 < 2.2  # 16 degrees of freedom, the 20 first snapshots are common

"""Tests for changes: chi-squared without a change, its growth with one, and probabilities of the kinds."""

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.monitoring import (
    CHANGES,
    ChangeTest,
    Comparison,
    MeasurementUpdate,
    RigBelief,
    absorb,
    camera_change_errors,
    change_std,
    pixel_changes,
    widen,
)
from imgcal.synthesis import PhysicalDrift, Truth, simulate_truth
from imgcal.types import CalibrationObject, CameraRig, Observations

NOISE = 0.1


@pytest.fixture(scope="module")
def followed() -> tuple[CameraRig, CalibrationObject, Truth, RigBelief]:
    """A rig, and what is known of it after 20 snapshots."""
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(2)
    truth = simulate_truth(factory, obj, 60, generator, PhysicalDrift())
    poses = truth.rig_from_object[:20]
    known = absorb(RigBelief.of_prior(factory, obj), seen(truth.rig, obj, poses, generator), poses)
    return factory, obj, truth, known.belief


def seen(rig: CameraRig, obj: CalibrationObject, poses: RigidTransform, generator: torch.Generator) -> Observations:
    """Noisy observations (S, C, N) of an object."""
    uv = rig.expand(len(poses.translation)).project(poses.apply(obj.points)).uv
    uv = uv + NOISE * torch.randn(uv.shape, generator=generator, dtype=torch.float64)
    sure = torch.ones(uv.shape[:-1], dtype=torch.bool)
    return Observations(uv, torch.full(sure.shape, NOISE, dtype=torch.float64), sure)


def against(later: MeasurementUpdate, before: RigBelief | None = None) -> ChangeTest:
    """What later snapshots say against what they were absorbed into, or against something else."""
    before, brought = before or later.before, later.brought
    at, information = brought.distance_from(before.rig, before.object_offset), brought.information()
    pull = brought.pull.sum(0) - information @ at
    change = camera_change_errors(before.rig, before.unit)
    return Comparison(before.information, information, pull, change, pixel_changes(before.rig)).test_together()


def test_each_camera_alone_is_tested_like_all_together(followed) -> None:
    later = bumped(followed, 2, slice(0, 3), [1e-3, 0, 0], 11)
    before, brought = later.before, later.brought
    information = brought.information()
    pull = brought.pull.sum(0) - information @ brought.distance_from(before.rig, before.object_offset)
    lasting = torch.tensor([0.02, 0.1, 0.02, 0.5], dtype=torch.float64)
    change, pixels = camera_change_errors(before.rig, before.unit), pixel_changes(before.rig)
    given = Comparison(before.information, information, pull, change, pixels, lasting)
    alone, together = given.test_each().scores(), given.test_together().each.scores()
    for kind in CHANGES:
        torch.testing.assert_close(alone[kind], together[kind], rtol=1e-6, atol=1e-9)


def bumped(
    followed, camera: int, part: slice, step: list[float], seed: int, first: int = 20, last: int = 26
) -> MeasurementUpdate:
    """Absorb some snapshots after a bump."""
    _, obj, truth, known = followed
    change = torch.zeros(4, 15, dtype=torch.float64)
    change[camera, part] = torch.tensor(step, dtype=torch.float64)
    poses = truth.rig_from_object[first:last]
    there = seen(truth.rig.retract(change), obj, poses, torch.Generator().manual_seed(seed))
    return absorb(known, there, poses)


def test_scores_of_a_steady_rig_are_chi_squared_and_those_of_a_bumped_camera_are_not(followed) -> None:
    steady = []
    for number, first in enumerate(range(20, 60, 2)):
        later = bumped(followed, 0, slice(0, 0), [], 100 + number, first, first + 2)
        steady.append(torch.stack(list(against(later).each.scores().values())))
    scores = torch.stack(steady)  # (20, kinds, C)
    for number, part in enumerate(CHANGES.values()):
        freedom = part.stop - part.start
        mean = float(scores[:, number].mean())
        assert 0.5 * freedom < mean < freedom + 4 * math.sqrt(2 * freedom / 80)  # model errors make it smaller
    found = against(bumped(followed, 2, slice(8, 9), [1.0], 5)).each.scores()
    assert int(found["principal_point"].argmax()) == 2
    assert float(found["principal_point"][2]) > 100


@pytest.mark.parametrize("kind", list(CHANGES))
def test_the_kind_of_a_change_is_the_most_probable_one(followed, kind: str) -> None:
    part = CHANGES[kind]
    size = {"rotation": 3e-3, "position": 3.0, "focal_length": 8.0, "principal_point": 5.0}[kind]
    known = followed[-1]
    free = widen(known, change_std({1: None}, pixel_changes(known.rig)).square())
    step = [size, -0.5 * size, 0.3 * size][: part.stop - part.start]
    test = against(bumped((*followed[:-1], free), 1, part, step, 7, 20, 40), known)
    odds = {name: test.odds({1: name}) for name in CHANGES}
    assert max(odds, key=lambda name: odds[name]) == kind
    assert test.odds({1: kind}) > test.odds({0: kind})
    assert max(float(scores[[0, 2, 3]].max()) for scores in test.condition_on({1: None}).each.scores().values()) < 40
    change, covariance = test.jump(1, kind)
    error = change - torch.tensor([size, -0.5 * size, 0.3 * size], dtype=torch.float64)[: len(change)]
    assert float(error @ torch.linalg.solve(covariance, error)) < 25


def test_odds_are_those_of_normal_distributions(followed) -> None:
    test = against(bumped(followed, 3, slice(6, 7), [2.0], 9))
    rows = torch.arange(45, 60)[CHANGES["focal_length"]]
    own, pull = test.learnt[rows[:, None], rows], test.pull[rows]

    def density(jump: float) -> Tensor:
        spread = torch.diag((jump * test.pixels[3, CHANGES["focal_length"]]).square())
        return MultivariateNormal(torch.zeros(2, dtype=torch.float64), own + own @ spread @ own).log_prob(pull)

    mixed = torch.logsumexp(torch.stack([density(jump) for jump in (0.6, 6.0, 60.0, 60.0)]), 0)
    mixed = mixed - math.log(4)  # a lens changes by no more than 60 pixels
    assert math.isclose(test.odds({3: "focal_length"}), float(mixed - density(0.0)), rel_tol=1e-6, abs_tol=1e-6)

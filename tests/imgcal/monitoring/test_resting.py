"""Snapshots of an object at rest count less and less, in one running rig and in the next."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.monitoring import RigFilter, RigMonitor
from imgcal.monitoring.resting import LEAST_WEIGHT, MOST_FLICKER, MOST_LEARNT, Rest
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations

RIG = imgcal.load_rig("T4").to(torch.float64)
OBJECT = imgcal.load_object("asymmetric8")
SIGMA = 0.1


def seen_at(uv: torch.Tensor) -> Observations:
    return Observations(
        uv[None], torch.full(uv.shape[:-1], SIGMA, dtype=uv.dtype)[None], torch.ones(1, *uv.shape[:-1]) > 0
    )


def worth(rest: Rest, snapshots: list[Observations], **options) -> float:
    """Independent snapshots that these are worth."""
    return float(sum(rest.widen(one, **options)[0] ** -2 for one in snapshots))


def scattered(count: int, fixed: float, flicker: float, move: float = 0.0, seed: int = 0) -> list[Observations]:
    """Snapshots of a rest: fixed and varying errors in units of sigma, and a motion (px) from each to the next."""
    draw = torch.Generator().manual_seed(seed)
    place = 500 + 100 * torch.randn(4, 8, 2, generator=draw, dtype=torch.float64)
    place = place + fixed * SIGMA * torch.randn(place.shape, generator=draw, dtype=torch.float64)
    noise = flicker * SIGMA * torch.randn(count, *place.shape, generator=draw, dtype=torch.float64)
    return [seen_at(place + number * move + each) for number, each in enumerate(noise)]


@pytest.mark.parametrize("flicker", [0.3, 0.7, 0.9])
def test_a_rest_is_worth_what_differs_in_it(flicker: float) -> None:
    rest = Rest()
    worth(rest, scattered(60, 0.0, flicker, seed=1))  # learns the share
    found = worth(rest, scattered(MOST_LEARNT, 0.0, flicker, seed=2))
    share = flicker**2
    assert rest.frames == [MOST_LEARNT] * 8
    assert found == pytest.approx(MOST_LEARNT / (MOST_LEARNT * (1 - share) + share), rel=0.25)


def test_a_long_rest_is_worth_six_snapshots_at_most() -> None:
    found = worth(Rest(), scattered(1000, 0.0, 1.0))
    limit = MOST_LEARNT / (MOST_LEARNT * (1 - MOST_FLICKER) + MOST_FLICKER)
    assert limit - 0.6 < found < limit + 1000 * LEAST_WEIGHT


def test_a_moving_object_counts_in_full() -> None:
    rest = Rest()
    assert worth(rest, scattered(50, 0.0, 1.0, move=1.0)) == 50 and rest.began
    assert not rest.says_nothing(1.0, None)


def test_a_camera_that_is_bumped_ends_the_rest() -> None:
    rest, snapshots = Rest(), scattered(40, 0.5, 0.5)
    assert worth(rest, snapshots[:30]) < 8 and rest.says_nothing(0.1, None)
    bumped = snapshots[30].uv.clone()
    bumped[0, 2] += 1.0
    assert float(rest.widen(replace(snapshots[30], uv=bumped))[0]) == 1.0 and rest.began


def test_hidden_markers_and_long_rests() -> None:
    rest, snapshots = Rest(), scattered(40, 0.5, 0.5)
    hidden = snapshots[1].seen.clone()
    hidden[0, :, :3] = False
    rest.widen(replace(snapshots[0], seen=hidden))
    for one in snapshots[1:]:
        rest.widen(one)
    assert min(rest.frames) == len(snapshots)
    assert rest.says_nothing(3.0, None) and not rest.says_nothing(3.0, 5) and not rest.says_nothing(30.0, None)
    assert rest.pause() == 36.0 and rest.pause() == 0.0


def test_a_short_horizon_shares_what_its_snapshots_are_worth() -> None:
    rest, snapshots = Rest(), scattered(40, 0.0, 0.7)
    for one in snapshots[:30]:
        rest.widen(one, horizon=5)
    share = min(rest.flicker, MOST_FLICKER)
    assert worth(rest, snapshots[30:35], horizon=5) == pytest.approx(5 / (5 * (1 - share) + share), rel=0.1)
    assert float(rest.widen(snapshots[36], horizon=1)[0]) == 1.0


def test_markers_of_their_own_rest_alone() -> None:
    rest, (one, two) = Rest(), scattered(2, 0.0, 0.5)
    rest.widen(one, single=False)
    moved = two.uv.clone()
    moved[0, :, 5] += 3.0
    root = rest.widen(replace(two, uv=moved), single=False)
    assert float(root[5]) == 1.0 and bool((root[[0, 1, 2, 3, 4, 6, 7]] > 1).all())


def normalized_error(monitor: RigMonitor, truth: imgcal.CameraRig) -> float:
    """Squared error of focal lengths over their covariance, per degree of freedom."""
    belief = monitor.filter.belief
    kept = (torch.arange(4)[:, None] * RIG.num_parameters + torch.tensor([6, 7])).flatten()
    covariance = belief.covariance().reshape(4 * RIG.num_parameters, -1)[kept][:, kept]
    error = (belief.rig.focal_length - truth.focal_length).flatten()
    return float(error @ torch.linalg.solve(covariance, error)) / len(error)


def test_a_rig_learned_from_rests_is_as_uncertain_as_it_is_wrong() -> None:
    """Twelve poses of two seconds; it was wrong by 3 to 20 standard deviations, and cameras seemed to have moved."""
    errors = []
    for seed in range(4):
        truth = simulate_truth(RIG, OBJECT, 12, torch.Generator().manual_seed(seed), PhysicalDrift())
        noise, monitor = np.random.default_rng(seed), RigMonitor(RigFilter(RIG, OBJECT))
        for pose in range(12):
            uv = truth.uv[pose] + 0.7 * SIGMA * torch.from_numpy(noise.standard_normal(truth.uv[pose].shape))
            for _ in range(40):
                shaken = uv + 0.7 * SIGMA * torch.from_numpy(noise.standard_normal(uv.shape))
                found = monitor.update(seen_at(shaken), truth.rig_from_object[[pose]], 0.05)
                assert not found.changes
        assert monitor.filter.count == 12 * MOST_LEARNT
        errors.append(normalized_error(monitor, truth.rig))
    assert 0.4 < np.mean(errors) < 1.7

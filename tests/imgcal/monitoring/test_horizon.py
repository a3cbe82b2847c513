"""A filter with a horizon is the batch estimate of the last N snapshots, and knows nothing older."""

from dataclasses import replace

import pytest
import torch

from imgcal.estimation import EstimationOptions, camera_covariance, estimate
from imgcal.monitoring import RigFilter
from imgcal.monitoring.horizon import Horizon
from imgcal.types import DriftRate, Observations
from tests.imgcal.monitoring.made_snapshots import SQUARED, made_snapshots, part, snapshots, worst


@pytest.fixture(scope="module")
def made():
    return made_snapshots()


def followed(made, horizon: int, count: int, blind: int | None = None, since: int = 0) -> RigFilter:
    """A filter after some snapshots; one camera may see nothing since one of them."""
    factory, obj, *_ = made
    follows = RigFilter(factory, obj, DriftRate(), SQUARED, horizon=horizon)
    for s in range(count):
        observations, pose = snapshots(made, s, s + 1)
        if blind is not None and s >= since:
            seen = observations.seen.clone()
            seen[:, blind] = False
            observations = Observations(observations.uv, observations.sigma, seen)
        follows.update(observations, pose, seconds=1000.0)
    return follows


@pytest.mark.parametrize(("horizon", "counts"), [(1, (1, 15, 24)), (2, (2, 16, 24)), (4, (4, 16, 22)), (8, (8, 20))])
def test_it_is_the_batch_estimate_of_the_last_snapshots(made, horizon: int, counts: tuple[int, ...]) -> None:
    factory, obj, truth, observations = made
    for count in counts:
        rows = slice(count - horizon, count)
        batch = estimate(
            part(observations, rows.start, rows.stop), factory, obj, truth.rig_from_object[rows], options=SQUARED
        )
        difference, ratio = worst(followed(made, horizon, count).belief, batch)
        assert difference < 0.1
        assert ratio < 1.05


def test_between_two_times_of_forgetting_a_few_older_ones_count_too(made) -> None:
    factory, obj, truth, observations = made
    follows = followed(made, 16, 21)
    batch = estimate(part(observations, 0, 21), factory, obj, truth.rig_from_object[:21], options=SQUARED)
    assert worst(follows.belief, batch)[0] < 0.2  # the last five were linearized by themselves
    follows.update(*snapshots(made, 21, 22))
    batch = estimate(part(observations, 6, 22), factory, obj, truth.rig_from_object[6:22], options=SQUARED)
    assert worst(follows.belief, batch)[0] < 0.1


def test_what_is_older_has_no_part_in_it(made) -> None:
    factory, obj, truth, observations = made
    other = replace(observations, uv=observations.uv.clone())
    other.uv[:12] += 3.0 * torch.randn(other.uv[:12].shape, generator=torch.Generator().manual_seed(1)).double()
    spoilt = (factory, obj, truth, other)
    first, second = followed(made, 6, 21).belief, followed(spoilt, 6, 21).belief
    assert float((first.rig.local(second.rig) / first.std()).abs().max()) < 1e-3
    torch.testing.assert_close(first.std(), second.std(), rtol=1e-3, atol=0)


def test_a_camera_that_sees_nothing_keeps_its_last_values_beside_the_others(made) -> None:
    factory, _, truth, _ = made
    before = followed(made, 3, 10, blind=1, since=8).belief  # one snapshot shows it yet
    after = followed(made, 3, 20, blind=1, since=8).belief
    change = after.rig.local(before.rig)[1, 6:] / before.std()[1, 6:]
    assert float(change.abs().max()) < 0.5
    torch.testing.assert_close(after.std()[1, 6:], before.std()[1, 6:], rtol=0.1, atol=0)
    # Relative to its neighbours it is known about as well as it was, and far better than the factory knows it.
    error, spread = after.rig.local(truth.rig).flatten(), after.covariance()
    squared = float(error @ torch.linalg.solve(spread, error))
    assert squared < 60 + 4 * 120**0.5
    assert float(after.std()[1, 6]) < 0.3 * float(factory.prior.std(factory)[1, 6])


def test_a_camera_that_comes_back_is_estimated_from_what_it_sees_now(made) -> None:
    factory, obj, truth, observations = made
    follows = followed(made, 3, 12, blind=1, since=6)
    assert set(follows.horizon.away) == {1}
    for s in range(12, 15):
        follows.update(*snapshots(made, s, s + 1))
    assert not follows.horizon.away
    batch = estimate(part(observations, 12, 15), factory, obj, truth.rig_from_object[12:15], options=SQUARED)
    assert worst(follows.belief, batch)[0] < 0.1


def test_cameras_that_moved_keep_no_last_values(made) -> None:
    follows = followed(made, 3, 12, blind=1, since=6)
    horizon: Horizon = follows.horizon
    horizon.free(horizon.prior, [2])
    assert set(horizon.away) == {1}
    horizon.free(horizon.prior, [1])
    assert not horizon.away


def test_an_object_with_tolerances_is_not_forgotten() -> None:
    factory, obj, truth, observations = made_snapshots()
    loose = replace(obj, tolerance=torch.full((8,), 0.05, dtype=torch.float64), scale_tolerance=1e-3)
    follows = RigFilter(factory, loose, DriftRate(), SQUARED, horizon=3)
    for s in range(9):
        follows.update(part(observations, s, s + 1), truth.rig_from_object[s : s + 1])
    batch = estimate(part(observations, 6, 9), factory, loose, truth.rig_from_object[6:9], options=SQUARED)
    assert worst(follows.belief, batch)[0] < 0.1
    std = camera_covariance(batch, curved=False).diagonal().sqrt()
    torch.testing.assert_close(follows.belief.std().flatten(), std, rtol=0.05, atol=0)


def test_the_robust_loss_of_a_running_rig_is_used_within_the_horizon(made) -> None:
    factory, obj, truth, observations = made
    follows = RigFilter(factory, obj, options=EstimationOptions(), horizon=4)
    for s in range(9):
        there = part(observations, s, s + 1)
        if s == 8:
            there.uv[0, 0, 0] += 40.0
        follows.update(there, truth.rig_from_object[s : s + 1])
    error = follows.belief.rig.local(truth.rig)[:, 6:10]
    assert float((error / follows.belief.std()[:, 6:10]).abs().max()) < 5.0

"""How long errors last: white noise stays as it is, errors that last count by their effective number."""

import math

import numpy as np
import pytest
import torch

from imgcal.monitoring.noise_correlation import (
    FASTEST,
    FIRST_MEASUREMENTS,
    LEAST_JUDGED,
    LEAST_WEIGHT,
    MEMORY_SNAPSHOTS,
    NoiseCorrelation,
    usual_time,
)
from imgcal.types import Observations

SIGMA = 0.1
ALONE = torch.ones(1, dtype=torch.float64)  # no snapshot repeats another


def observations(cameras: int = 2, fiducials: int = 5) -> Observations:
    shape = (1, cameras, fiducials)
    return Observations(
        torch.zeros(*shape, 2, dtype=torch.float64),
        torch.full(shape, SIGMA, dtype=torch.float64),
        torch.ones(shape, dtype=torch.bool),
    )


def follow(remain: list[float], count: int = 1200, seed: int = 1) -> NoiseCorrelation:
    """Follow cameras with noise of each point, and a shift of the image of which a part remains each time."""
    rng, noise = np.random.default_rng(seed), NoiseCorrelation(len(remain))
    shift, keep = np.zeros((len(remain), 2)), np.array(remain)[:, None]
    for _ in range(count):
        shift = keep * shift + np.sqrt(1 - keep**2) * rng.normal(0, SIGMA, shift.shape)
        residual = np.where(keep > 0, shift, 0.0)[:, None] + rng.normal(0, SIGMA, (len(remain), 5, 2))
        noise.add(observations(len(remain)), torch.from_numpy(residual)[None])
    return noise


def test_white_noise_counts_as_it_is() -> None:
    noise = follow([0.0, 0.0, 0.0])
    assert noise.time.tolist() == [1.0, 1.0, 1.0]
    seen = observations(3)
    assert noise.weigh(seen, ALONE) is seen
    assert noise.episodes == [1, 1, 1]
    assert float(noise.lasting.max()) == 0.0


def test_errors_that_last_count_by_their_effective_number() -> None:
    noise = follow([0.9, 0.0], count=MEMORY_SNAPSHOTS)
    # The shift has 5/6 of the variance of the mean of five points; its correlation time is (1 + r) / (1 - r).
    expected = 1 + 2 * (5 / 6) * 0.9 / 0.1
    assert 0.5 * expected < float(noise.time[0]) < 1.6 * expected
    noise.weigh(observations(), ALONE)  # the next one knows nothing of a snapshot before
    weighed = noise.weigh(observations(), ALONE)
    assert torch.allclose(weighed.sigma[0, 0], SIGMA * noise.time[0].sqrt())
    assert 0.7 * SIGMA < float(noise.lasting[0]) < 1.3 * SIGMA
    assert noise.episodes[0] == max(math.ceil(2 * float(noise.time[0])), 60)  # 1 s at 60 Hz


def test_passing_errors_last_for_seconds_whatever_the_rate() -> None:
    noise = follow([0.9, 0.9])
    noise.time[:] = 1.5
    for seconds, episode in ((1 / 60, 60), (1 / 30, 30), (0.1, 10), (0.5, 3)):
        noise.interval = 0.0
        noise.pass_time(seconds)
        assert noise.episodes == [episode] * 2
        noise.pass_time(60.0)  # a pause
        assert noise.episodes == [episode] * 2


def test_a_large_error_passes_in_less_time_than_the_correlation_of_small_ones() -> None:
    noise = follow([0.98, 0.98], count=MEMORY_SNAPSHOTS)
    usual = float(noise.model_error[0])
    assert noise.episode(0, 3 * usual) == noise.episodes[0] >= 60
    assert noise.episode(0, 30 * usual) == 24


def test_a_calibrated_rig_expects_what_is_usual_until_it_knows_better() -> None:
    noise = NoiseCorrelation(2)
    noise.expect_usual()
    assert noise.time.tolist() == [usual_time(FASTEST)] * 2
    noise.pass_time(1.0)
    noise.expect_usual()
    assert noise.time.tolist() == pytest.approx([1.0, 1.0], abs=1e-3)
    noise.interval = FASTEST
    for number in range(512):
        noise.expect_usual()
        noise.add(observations(), torch.randn(1, 2, 5, 2, dtype=torch.float64))
        if FIRST_MEASUREMENTS[0] <= number < 200:
            assert float(noise.time.min()) >= usual_time(FASTEST)  # too few to tell
    assert float(noise.time.max()) < 3


@pytest.mark.parametrize(("lasting", "ends"), [(0.0, True), (0.5, False)])
def test_an_uncalibrated_rig_is_weighed_as_usual_unless_its_errors_seem_independent(lasting: float, ends: bool) -> None:
    generator, noise, error = torch.Generator().manual_seed(1), NoiseCorrelation(4), 0.0
    for number in range(160):
        noise.pass_time(FASTEST)
        noise.expect_usual(calibrated=False)
        fresh = torch.randn(1, 4, 1, 2, generator=generator, dtype=torch.float64)
        error = lasting * error + (1 - lasting**2) ** 0.5 * fresh  # of the whole image
        noise.add(observations(4), error.expand(1, 4, 5, 2))
        if number < FIRST_MEASUREMENTS[0] - 1:
            assert noise.time.tolist() == [1.0] * 4  # cameras are tested as if nothing were assumed
        if number < LEAST_JUDGED:  # the rig follows the errors of its first snapshots
            assert noise.assumed_time.tolist() == pytest.approx([usual_time(FASTEST)] * 4)
    assert (noise.usual == 1.0) == ends and (float(noise.assumed_time.min()) < 2) == ends


@pytest.mark.parametrize("late", [6, 60, 120])
def test_a_shift_that_has_begun_lately_is_no_persistent_error_yet(late: int) -> None:
    noise = follow([0.9, 0.9], count=1024 - late)
    before = noise.least_shifts[0]
    shifted = torch.tensor([[1.0, 0.0]]).double().expand(1, 2, 5, 2)
    for number in range(late):
        noise.add(observations(), shifted + SIGMA * torch.randn(1, 2, 5, 2, generator=torch.manual_seed(number)))
    assert noise.taken == 1024 and noise.least_shifts[0] < 1.3 * before
    noise.settle((0, 1))  # the change has been found
    for number in range(512):
        noise.add(observations(), SIGMA * torch.randn(1, 2, 5, 2, generator=torch.manual_seed(number)))
    assert noise.least_shifts[0] < 1.3 * before


def test_a_camera_that_sees_nothing_for_long_has_the_noise_of_the_others() -> None:
    noise, rng, shift = NoiseCorrelation(3), np.random.default_rng(3), np.zeros((3, 2))
    seen = observations(3)
    seen.seen[0, 2] = False
    for _ in range(700):
        shift = 0.9 * shift + rng.normal(0, 0.044, shift.shape)
        residual = shift[:, None] + rng.normal(0, SIGMA / 3, (3, 5, 2))
        noise.add(seen, torch.from_numpy(np.where(seen.seen[0].numpy()[..., None], residual, 0.0))[None])
    assert float(noise.time[2]) > 3


def test_an_image_that_was_off_a_moment_ago_counts_less() -> None:
    noise = follow([0.9, 0.9])
    seen, off = observations(), torch.zeros(1, 2, 5, 2, dtype=torch.float64)
    off[:, 0, :, 0] = 1.0
    usual = SIGMA * noise.time.sqrt()

    def weights() -> list[float]:
        return (noise.weigh(seen, ALONE).sigma[0, :, 0] / usual).pow(-2).tolist()

    noise.pass_time(FASTEST)
    noise.add(seen, off)
    first, second = weights()
    assert LEAST_WEIGHT <= first < 0.2 and 1.0 <= second < 1.5
    assert weights() == [1.0, 1.0]  # nothing was learnt since
    noise.add(seen, off)
    noise.pass_time(1.0)  # a pause
    assert weights() == [1.0, 1.0]
    noise.settle((0,))
    noise.add(seen, off)
    assert weights()[0] == 1.0  # it is being learnt anew


def test_the_mean_weight_of_usual_shifts_is_one() -> None:
    noise, rng, shift, weights = follow([0.9]), np.random.default_rng(5), np.zeros(2), []
    for _ in range(2000):
        shift = 0.9 * shift + np.sqrt(1 - 0.81) * rng.normal(0, SIGMA, 2)
        residual = shift + rng.normal(0, SIGMA, (1, 1, 5, 2))
        noise.add(observations(1), torch.from_numpy(residual))
        weights.append(SIGMA**2 * float(noise.time[0]) / float(noise.weigh(observations(1), ALONE).sigma[0, 0, 0]) ** 2)
    assert 0.9 < np.mean(weights) < 1.1

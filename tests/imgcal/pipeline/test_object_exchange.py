"""An object that was exchanged for a larger one during a capture is noticed; one that stays is not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.pipeline.object_exchange import find_step, measure_sizes
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Detections, Observations
from scripts.benchmarks.rig_streams import Conditions, Stream

EXCHANGED = 12


def capture(growth: float, seed: int = 1, count: int = 20) -> Detections:
    obj = imgcal.load_object("asymmetric8")
    made = Stream(imgcal.load_rig("T4"), obj, seed, Conditions(rate=1.0, clutter=0.2, labelled=True))
    parts = []
    for number in range(count):
        made.obj = replace(obj, points=obj.points * (1 + growth * (number >= EXCHANGED)))
        parts.append(made.snapshot(number))
    return Detections.join(parts)


@pytest.mark.parametrize("growth", [0.003, -0.003, 0.01])
def test_an_exchanged_object_is_refused_with_its_moment_and_size(growth: float) -> None:
    with pytest.raises(
        RefusedError, match=r"object: from snapshot 12 on it is (0\.29|0\.3|0\.96|0\.97|0\.98) "
    ) as refusal:
        imgcal.calibrate(capture(growth), imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"))
    assert ("larger" if growth > 0 else "smaller") in str(refusal.value)


def test_each_snapshot_measures_the_size_as_well_as_it_says() -> None:
    fit = imgcal.calibrate(capture(0.0), imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")).estimate
    size, sigma = measure_sizes(fit)
    assert size.shape == sigma.shape == (20,)
    assert 0.5 < np.sqrt(np.mean(np.square(size / sigma))) < 1.5
    assert sigma.max() < 5e-4
    larger = replace(fit, points_object=fit.points_object * 1.001)
    assert np.allclose(measure_sizes(larger)[1], sigma, rtol=0.01)


def test_a_snapshot_of_one_camera_says_nothing_about_the_size() -> None:
    rig, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    truth = simulate_truth(rig, obj, 6, torch.Generator().manual_seed(1), PhysicalDrift())
    seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
    seen[4, 1:] = False
    _, sigma = measure_sizes(imgcal.estimate(Observations(truth.uv, torch.full(seen.shape, 0.1), seen), rig, obj))
    assert np.isinf(sigma[4]) and np.isfinite(np.delete(sigma, 4)).all()


def test_sizes_that_wander_or_scatter_are_no_step() -> None:
    rng, sigma = np.random.default_rng(2), np.full(200, 2e-4)
    assert find_step(sigma * rng.normal(size=200), sigma) is None
    wandering = 2e-3 * np.sin(np.arange(200) / 9.0)
    assert find_step(wandering + sigma * rng.normal(size=200), sigma) is None
    assert find_step(10 * sigma * rng.normal(size=200), sigma) is None  # far more than they say
    stepped = np.where(np.arange(200) < 150, 0.0, 4e-3) + sigma * rng.normal(size=200)
    step = find_step(stepped, sigma)
    assert step is not None and step.first == 150
    assert step.change == pytest.approx(4e-3, abs=5 * step.sigma)
    unknown = np.where(np.arange(200) % 2, np.inf, sigma)  # every other snapshot is of one camera alone
    step = find_step(stepped, unknown)
    assert step is not None and step.first == 150

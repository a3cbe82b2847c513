import numpy as np
import pytest
import torch

from imgcal.matching import measure_markers
from renderers import SensorModel, Spots, infrared_frames


def frame(uv, shape, sensor, seed=0):
    count = len(uv)
    ones = torch.ones(1, count)
    spots = Spots(torch.as_tensor(uv)[None].float(), torch.as_tensor(shape)[None].float(), ones, ones > 0, ones)
    made = infrared_frames(spots, (200, 260), sensor, generator=torch.Generator().manual_seed(seed))
    return made.frames[0].numpy()


def places(count=9, seed=0):
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid([50, 125, 200], [40, 100, 160]), -1).reshape(-1, 2)[:count]
    return grid + rng.uniform(-0.5, 0.5, (count, 2))


@pytest.mark.parametrize("radius", [2.0, 7.0])
def test_bright_discs_are_measured_finely(radius):
    uv, size = places(), radius * np.linspace(0.8, 1.2, 9)
    seen = frame(uv, np.eye(2) * size[:, None, None] ** 2, SensorModel())
    found = measure_markers(seen, uv + 0.9, size, False, np.ones(9, bool))
    assert found.seen.all() and np.abs(found.uv - uv).max() < 0.1 and np.median(np.abs(found.uv - uv)) < 0.03
    assert found.radius == pytest.approx(radius, rel=0.2)


@pytest.mark.parametrize("dark", [False, True])
def test_dim_and_smeared_markers_with_an_honest_sigma(dark):
    uv, smeared = places(), np.array([[120.0, 60.0], [60.0, 60.0]])
    sensor = SensorModel(contrast=0.05, read_noise=4.0, background=0.5, polarity="dark" if dark else "bright")
    normalized = []
    for seed in range(5):
        seen = frame(uv, np.tile(smeared, (9, 1, 1)), sensor, seed)
        found = measure_markers(seen, uv + 0.8, np.full(9, 7.0), dark, np.ones(9, bool))
        assert found.seen.sum() >= 8
        good = found.seen
        normalized += list(((found.uv - uv)[good] ** 2).sum(1) / 2 / found.sigma[good] ** 2)
    assert 0.3 < np.mean(normalized) < 2.5


def test_where_nothing_is_nothing_is_seen():
    ground = frame(np.zeros((0, 2)), np.zeros((0, 2, 2)), SensorModel(read_noise=3.0))
    found = measure_markers(ground, places(), np.full(9, 6.0), False, np.ones(9, bool))
    assert found.seen.sum() <= 1
    outside = measure_markers(ground, places() + 1000, np.full(9, 6.0), False, np.ones(9, bool))
    assert not outside.seen.any()


def test_a_half_hidden_marker_has_a_large_sigma():
    uv = places()
    seen = frame(uv, np.tile(64 * np.eye(2), (9, 1, 1)), SensorModel())
    seen[int(uv[4, 1]) - 12 : int(uv[4, 1]) + 12, int(uv[4, 0]) : int(uv[4, 0]) + 12] = 15
    found = measure_markers(seen, uv + 0.5, np.full(9, 8.0), False, np.ones(9, bool))
    off = np.linalg.norm(found.uv - uv, axis=1)
    assert off[4] > 1 and found.sigma[4] > off[4] / 4 and found.sigma[4] > 10 * np.median(found.sigma)


def uneven(uv, rng, radius=9.0):
    """Bright discs, each with a dark spot somewhere on it and a neighbour that touches it."""
    v, u = np.mgrid[:200, :260].astype(float)
    total = np.full(u.shape, 12.0)
    for x, y in uv:
        spot = rng.uniform(-0.7, 0.7, 2) * radius + (x, y)
        dark = 1 - 0.7 * np.exp(-((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / (2 * (0.3 * radius) ** 2))
        total += 150 * dark / (1 + np.exp(np.hypot(u - x, v - y) - radius))
        angle = rng.uniform(0, 2 * np.pi)
        other = (x, y) + 1.9 * radius * np.array([np.cos(angle), np.sin(angle)])
        total += 60 * rng.uniform() / (1 + np.exp(np.hypot(u - other[0], v - other[1]) - 0.8 * radius))
    return np.clip(np.rint(total + rng.normal(0, 1.0, u.shape)), 0, 255).astype(np.uint8)


def test_the_sigma_of_dirty_markers_that_others_touch_is_honest():
    rng, normalized = np.random.default_rng(0), []
    for seed in range(8):
        uv = places(seed=seed)
        found = measure_markers(uneven(uv, rng), uv + 0.7, np.full(9, 9.0), False, np.ones(9, bool))
        normalized.append(((found.uv - uv) ** 2).sum(1) / 2 / found.sigma**2)
    assert 0.2 < np.median(normalized) < 2 and np.mean(normalized) < 4

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from imgcal.matching.marker_shape import FAINT, RINGS, common_shape, median


def slow(patches):
    """Whitening, profile and longer axis over the shorter, array by array."""
    half = patches.shape[1] // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    rim, core = np.maximum(abs(u), abs(v)) >= half - 1, np.hypot(u, v) <= max(1.5, 0.25 * half)
    stack = patches - np.median(patches[:, rim], axis=1)[:, None, None]
    peak = np.median(stack[:, core], axis=1)
    mean = np.median(stack[peak > 0] / peak[peak > 0, None, None], axis=0)
    mean = (mean + mean[::-1, ::-1]) / 2
    smooth = gaussian_filter(mean, 1.0, mode="nearest")
    covariance = np.eye(2) * (0.3 * half) ** 2
    for _ in range(6):
        inverse = np.linalg.inv(covariance)
        distance = inverse[0, 0] * u * u + 2 * inverse[0, 1] * u * v + inverse[1, 1] * v * v
        weight = np.maximum(smooth - FAINT * smooth[core].max(), 0) * (distance < 9)
        uv = (weight * u * v).sum()
        covariance = np.array([[(weight * u * u).sum(), uv], [uv, (weight * v * v).sum()]]) / weight.sum()
        covariance += 0.1 * np.eye(2)
    values, axes = np.linalg.eigh(covariance)
    whitening = axes @ np.diag(np.sqrt(values[0] / values)) @ axes.T
    white = np.stack((u, v), -1) @ whitening.T
    ring = np.floor(np.hypot(white[..., 0], white[..., 1]) / RINGS + 0.5).astype(int)
    most = int(np.ceil(min(4.5 * np.sqrt(values[0]) + 2, half) / RINGS))
    kept = ring <= most
    profile = np.bincount(ring[kept], mean[kept], most + 1) / np.maximum(np.bincount(ring[kept], minlength=most + 1), 1)
    profile = np.maximum.accumulate(gaussian_filter(profile, 1.0, mode="nearest")[::-1])[::-1]
    profile = np.append(profile - profile[-1], 0.0)
    return whitening, profile / profile[0], np.sqrt(values[1] / values[0])


def windows(count, noise=0.0, half=14):
    """Smeared markers, each of its own brightness on its own ground."""
    rng = np.random.default_rng(count)
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    disc = 1 / (1 + np.exp((np.sqrt((0.8 * u + 0.2 * v) ** 2 + (0.2 * u + 1.1 * v) ** 2) - 5) / 0.6))
    levels, peaks = rng.uniform(10, 40, (2, count, 1, 1))
    return (levels + peaks * disc + rng.normal(0, 1, (count, *disc.shape)) * noise).astype(np.float32)


@pytest.mark.parametrize("count", [1, 4, 7])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_the_compiled_shape_is_the_slow_one(count, noise):
    patches = windows(count, noise)
    whitening, profile = np.empty((2, 2)), np.empty(patches.shape[1] + 2)
    number, longer = common_shape(patches, whitening, profile)
    expected = slow(patches.astype(float))
    assert np.allclose(whitening, expected[0], atol=1e-4)
    assert number == len(expected[1]) and np.allclose(profile[:number], expected[1], atol=1e-3)
    assert longer == pytest.approx(expected[2], rel=1e-4)


def test_where_nothing_is_brighter_there_is_no_shape():
    patches = -windows(3)
    assert common_shape(patches, np.empty((2, 2)), np.empty(patches.shape[1] + 2))[0] == 0


@pytest.mark.parametrize("count", [1, 2, 5, 8, 101])
def test_median_is_that_of_numpy(count):
    values = np.random.default_rng(count).normal(size=count + 3)
    assert median(values.copy(), count) == pytest.approx(np.median(values[:count]))

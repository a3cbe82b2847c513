import numpy as np
import pytest

from imgcal.matching.maps import Maps, surprise_maps
from imgcal.matching.ranks import MOST


def noise(seed=0, size=(256, 320)):
    return np.random.default_rng(seed).normal(40, 3, size)


def as_frame(values):
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("dark", [False, True])
def test_a_faint_spot_surprises_where_it_is_and_nowhere_else(dark):
    v, u = np.mgrid[:256, :320]
    spot = 5 * np.exp(-((u - 130.0) ** 2 + (v - 90.0) ** 2) / 72)
    maps, response = surprise_maps([as_frame(noise() + (-spot if dark else spot)), None], 4, dark, [None, None])
    cell = np.unravel_index(maps.surprise[0].argmax(), maps.surprise[0].shape)
    assert np.abs((np.array(cell[::-1]) + 0.5) * 4 - 0.5 - (130, 90)).max() <= 6
    assert response[0].max() > 8 and (maps.surprise[1] == 0).all()
    assert maps.size.tolist() == [[80, 64], [0, 0]]


def test_what_is_masked_says_nothing():
    frame = noise()
    frame[80:100, 120:140] = 200
    mask = np.zeros(frame.shape, bool)
    mask[70:110, 110:150] = True
    maps, _ = surprise_maps([as_frame(frame)], 4, False, [mask])
    assert maps.surprise[0, 18:27, 28:37].max() < 2


def test_larger_cells_keep_what_is_most_surprising_and_stay_exponential():
    maps, _ = surprise_maps([as_frame(noise())], 4, False, [None])
    pooled = maps.pool(16)
    assert pooled.factor == 16 and pooled.surprise.shape == (1, 16, 20) and pooled.size.tolist() == [[20, 16]]
    assert (pooled.surprise > 1).mean() == pytest.approx(np.exp(-1), rel=0.2)
    top = np.unravel_index(maps.surprise[0].argmax(), maps.surprise[0].shape)
    assert pooled.surprise[0].argmax() == (top[0] // 4) * 20 + top[1] // 4
    assert maps.pool(4) is maps


def test_nothing_counts_more_than_the_most():
    maps = Maps(np.zeros((1, 64, 64), np.float32), 4, np.array([[64, 64]]), np.zeros((1, 2), int))
    frame = noise(size=(512, 512))
    frame[200:220, 200:220] = 255
    found, _ = surprise_maps([as_frame(frame)], 4, False, [None])
    assert found.surprise.max() <= MOST and maps.surprise.max() == 0


def test_a_window_shows_what_the_frame_shows_there():
    frame = noise()
    frame[84:92, 124:132] += 60
    windows = np.array([[64, 224, 32, 192], [32, 32, 0, 0]])
    maps, response = surprise_maps([as_frame(frame)] * 2, 4, False, [None, np.zeros(frame.shape, bool)], windows)
    assert maps.size.tolist() == [[40, 40], [0, 0]] and maps.corner[0].tolist() == [16, 8]
    peak = np.unravel_index(maps.surprise[0].argmax(), maps.surprise[0].shape)
    place = maps.pixels(np.array(peak[::-1])[None, None] + 0.5)[0, 0]
    assert np.abs(place - (127.5, 87.5)).max() < 3
    assert (np.floor(maps.cells(place[None, None]))[0, 0] == peak[::-1]).all()
    whole, _ = surprise_maps([as_frame(frame)], 4, False, [None])
    there = np.unravel_index(whole.surprise[0].argmax(), whole.surprise[0].shape)
    assert (np.array(there) - maps.corner[0, ::-1] == peak).all()
    pooled = maps.pool(16)
    assert pooled.corner[0].tolist() == [4, 2] and pooled.size[0].tolist() == [10, 10] and response[1].max() == 0

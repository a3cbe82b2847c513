"""Soft blobs: discs far out of focus and Gaussian spots, with known centres; sharp blobs beside them are untouched."""

import numpy as np
import pytest
from scipy.special import ndtr

from imgcal.detection import Blobs, DetectionOptions, blob_search, detect_frame
from imgcal.detection.soft_blobs import halve_frame, replace_soft
from imgcal.types import BlobFlag
from tests.imgcal.detection.discs import draw_discs, exposed, nearest, scattered

SHAPE = (240, 320)
CONTRAST = 150.0


def draw_spots(uv, sigma):
    """Draw Gaussian spots (M, 2), integrated over the pixels: (H, W) grey levels."""
    light = np.full(SHAPE, 12.0)
    for place in uv:
        v, u = (np.diff(ndtr((np.arange(n + 1) - 0.5 - c) / sigma)) for n, c in zip(SHAPE, place[::-1], strict=True))
        light += CONTRAST * 2 * np.pi * sigma**2 * np.outer(v, u)
    return light


def draw_soft_discs(uv, radius, blur):
    """Draw discs of `CONTRAST` at their brightest: (H, W) grey levels."""
    light = draw_discs(SHAPE, uv, radius, blur=blur, contrast=1.0, background=0.0)
    return 12 + CONTRAST / light.max() * light


def errors(draw, size, noise, seeds=range(4)):
    """Errors of the centres (K, 2) in px, and their sigmas (K,). All spots must be found, and nothing else."""
    found, sigma = [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        uv = scattered(SHAPE, 80, rng)
        blobs = detect_frame(exposed(draw(uv, *size), noise, rng), DetectionOptions())
        rows, distance = nearest(blobs.uv, uv)
        assert len(blobs.uv) == len(uv) and len(set(rows)) == len(uv)
        assert distance.max() < 1 and not blobs.flags.any()
        found.append(blobs.uv[rows] - uv)
        sigma.append(blobs.sigma[rows])
    return np.concatenate(found), np.concatenate(sigma)


@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0])
@pytest.mark.parametrize(
    ("draw", "size"),
    [(draw_soft_discs, size) for size in ((2.0, 3.0), (4.0, 2.5), (4.0, 3.0), (4.0, 4.0), (6.0, 3.0), (9.0, 4.0))]
    + [(draw_spots, (sigma,)) for sigma in (3.0, 4.0, 5.5, 7.0)],
)
def test_soft_blobs_are_found_once_and_as_exactly_as_they_say(draw, size, noise):
    error, sigma = errors(draw, size, noise)
    ratio = (error**2).mean() / (sigma**2).mean()
    assert 0.3 < ratio < 1.5 and abs(error / sigma[:, None]).max() < 5
    # The Cramér-Rao bound of a Gaussian spot; the light of a disc is nowhere wider than that of one with its variance.
    bound = np.hypot(noise, 12**-0.5) / (CONTRAST * np.sqrt(np.pi / 2))
    assert np.sqrt((error**2).mean()) < 1.4 * bound


def test_sharp_blobs_are_not_searched_again(monkeypatch):
    monkeypatch.setattr(blob_search, "halve_frame", None)
    rng = np.random.default_rng(0)
    uv = scattered(SHAPE, 40, rng)
    for radius in (1.5, 3.0, 6.0, 10.0):
        for blur, noise in ((0.5, 1.0), (1.5, 1.0), (0.7, 6.0)):
            light = draw_discs(SHAPE, uv, radius, blur=blur, squeeze=0.7, angle=0.4)
            assert len(detect_frame(exposed(light, noise, rng), DetectionOptions()).uv) >= len(uv)


def test_sharp_blobs_beside_soft_ones_stay_as_they_are(monkeypatch):
    rng = np.random.default_rng(1)
    uv = scattered(SHAPE, 80, rng)
    light = draw_discs(SHAPE, uv[::2], 4.0, blur=0.8, background=0.0) + draw_soft_discs(uv[1::2], 4.0, 4.0)
    frame = exposed(light, 1.0, rng)
    blobs = detect_frame(frame, DetectionOptions())
    rows, distance = nearest(blobs.uv, uv)
    assert len(blobs.uv) == len(uv) and distance.max() < 0.05
    assert (blobs.blur[rows[::2]] < 1).all() and (blobs.blur[rows[1::2]] > 3).all()
    monkeypatch.setattr(blob_search, "has_soft_blobs", lambda *_: False)
    before = detect_frame(frame, DetectionOptions())
    kept = nearest(before.uv, uv[::2])[0]
    for name in ("uv", "sigma", "radius", "contrast"):
        np.testing.assert_array_equal(getattr(blobs, name)[rows[::2]], getattr(before, name)[kept])


@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_soft_blobs_of_dark_and_deep_frames_are_found_and_clipped_ones_say_what_they_are_worth(polarity):
    rng = np.random.default_rng(2)
    uv = scattered(SHAPE, 80, rng)
    light = draw_soft_discs(uv, 4.0, 4.0)
    options = DetectionOptions(polarity=polarity)

    def find(frame, scale):
        return detect_frame((scale - frame if polarity == "dark" else frame).astype(frame.dtype), options)

    for bits in (8, 12, 16):
        scale = 2**bits - 1
        deep = exposed(light * (scale / 255), scale / 255, rng, bits)
        deep[0, 0] = 0 if polarity == "dark" else scale  # tells the bit depth
        found = find(deep, scale)
        rows, distance = nearest(found.uv, uv)
        assert distance.max() < 0.03 and not found.flags[rows].any()
    found = find(exposed(1.8 * light, 1.0, rng), 255)
    rows, distance = nearest(found.uv, uv)
    assert (found.flags[rows] == BlobFlag.SATURATED).all() and (distance < 3 * found.sigma[rows]).all()


@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_a_halved_frame_holds_sums_and_clips_where_a_pixel_is_clipped(polarity):
    frame = np.random.default_rng(3).integers(3, 250, (5, 7)).astype(np.uint8)
    frame[1, 1] = 255 if polarity == "bright" else 0
    options = DetectionOptions(polarity=polarity, threshold=20.0, max_radius=10.0)
    halved, suited, scale = halve_frame(frame, options, 255)
    expected = frame[:4, :6].reshape(2, 2, 3, 2).astype(int).sum((1, 3))
    expected[0, 0] = 1020 if polarity == "bright" else 0
    np.testing.assert_array_equal(halved, expected)
    assert scale == 1020 and (suited.threshold, suited.max_radius, suited.min_radius) == (80.0, 5.0, 0.45)
    assert suited.saturation == pytest.approx(0.995 * 1020)
    deep, _, scale = halve_frame(frame.astype(np.uint16) * 257, DetectionOptions(polarity=polarity), 65535)
    assert scale == 65535 and abs(deep[1:] - expected[1:] * 257 / 4).max() <= 0.5


def blobs_of(uv, radius, blur, flags):
    uv = np.array(uv, dtype=float).reshape(-1, 2)
    column = np.ones(len(uv))
    return Blobs(
        uv, 0.01 * column, np.array(radius, float), np.array(flags, np.uint8), np.zeros(len(uv), np.int64), column,
        np.full(len(uv), -1), np.array(blur, float),
    )  # fmt: skip


def test_only_the_same_blob_is_replaced_and_only_its_pieces_are_removed():
    merged = int(BlobFlag.MERGED)
    # A soft blob, a piece of its skirt, a sharp neighbour, and a soft one that is two blobs in the halved frame.
    blobs = blobs_of([[50, 50], [59, 50], [54, 50], [90, 90]], [6, 1.1, 2, 6], [2.5, 0, 0.7, 2.5], [0, merged, 0, 0])
    halved = blobs_of([[24.9, 24.75], [45, 45]], [3.2, 4], [1.6, 0], [0, merged])
    found = replace_soft(blobs, halved)
    np.testing.assert_allclose(found.uv, [[50.3, 50.0], [54, 50], [90, 90]])
    np.testing.assert_allclose(found.sigma, [0.02, 0.01, 0.01])
    np.testing.assert_array_equal(found.flags, [0, 0, merged])
    empty = halved.select(np.zeros(2, bool))
    np.testing.assert_array_equal(replace_soft(blobs, empty).uv, blobs.uv)

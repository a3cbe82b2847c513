"""The compiled functions against the plain ones of reference.py."""

import numpy as np
import pytest
from scipy.special import ndtr

from imgcal.detection import DetectionOptions
from imgcal.detection.candidates import block_means, outline, screen
from imgcal.detection.centroids import measure
from imgcal.detection.kernels import half_size
from imgcal.types import BlobFlag
from tests.imgcal.detection import reference
from tests.imgcal.detection.discs import draw_discs, draw_lamps, exposed, scattered

SHAPE = (243, 322)  # no multiples of the blocks


def crowded_frame(seed, bits=8, peak=200.0):
    """Discs of many sizes, in pairs at all distances, some at the border, over a gradient."""
    rng = np.random.default_rng(seed)
    uv = scattered(SHAPE, 36, rng)
    partner = uv[::2] + rng.uniform(-12, 12, uv[::2].shape)
    radius = rng.uniform(1.0, 6.0, len(uv) + len(partner))
    background = np.linspace(15, 40, SHAPE[1])[None, :] * 2 ** (bits - 8)
    light = draw_discs(
        SHAPE,
        np.concatenate([uv, partner, [[2.0, 100.0]]]),
        np.append(radius, 5.0),
        contrast=rng.uniform(0.2, 1.0, len(radius) + 1) * peak,
        background=background,
    )
    return exposed(light, 2.0 * 2 ** (bits - 8), rng, bits)


def candidates_of(frame, options, scale):
    screening = screen(block_means(frame, options, scale), options, scale)
    return screening, outline(frame, screening, options, scale)


def image_of(candidates, shape):
    """The components' labels as an image (H, W)."""
    labels = candidates.labels[candidates.tile[1:-1, 1:-1]]  # (R, Q, 4, 4)
    return labels.transpose(0, 2, 1, 3).reshape(4 * labels.shape[0], -1)[: shape[0], : shape[1]]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_components_are_those_of_opencv(seed, polarity):
    frame, options = crowded_frame(seed), DetectionOptions(polarity=polarity)
    invert = None
    if polarity == "dark":
        frame, invert = 255 - frame, 255
    screening, found = candidates_of(frame, options, 255)
    expected = reference.components(frame, screening, invert)
    image = image_of(found, frame.shape)
    assert len(found.boxes) == expected.max() > 40
    pairs = np.unique(np.stack([image.ravel(), expected.ravel()]), axis=1)
    assert pairs.shape[1] == expected.max() + 1  # one to one, background included
    order = pairs[1, np.argsort(pairs[0])][1:]
    np.testing.assert_array_equal(found.boxes, reference.boxes_of(expected)[order - 1])


@pytest.mark.parametrize("peak", [1.5, 2.0, 4.0, 10.0])
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_clipped_peaks_are_parted_as_in_the_reference(peak, polarity):
    rng, invert = np.random.default_rng(0), None
    uv = scattered(SHAPE, 60, rng)
    uv = np.concatenate([uv, uv + rng.uniform(4, 11, uv.shape)])
    frame = exposed(draw_lamps(SHAPE, uv, peak), 1.5, rng)
    if polarity == "dark":
        frame, invert = 255 - frame, 255
    screening, found = candidates_of(frame, DetectionOptions(polarity=polarity, max_radius=60.0), 255)
    expected = reference.parted_components(frame, screening, 0.995 * 255, invert)
    pairs = np.unique(np.stack([image_of(found, frame.shape).ravel(), expected.ravel()]), axis=1)
    assert pairs.shape[1] == expected.max() + 1 == len(np.unique(found.labels))
    assert (found.boxes != found.whole).any(1).sum() >= 8


@pytest.mark.parametrize(
    ("bits", "peak", "polarity"),
    [(8, 200.0, "bright"), (8, 900.0, "bright"), (8, 200.0, "dark"), (12, 3000.0, "bright")],
)
def test_measures_are_those_of_the_reference(bits, peak, polarity):
    scale = 2**bits - 1
    frame, options = crowded_frame(7, bits, peak), DetectionOptions(polarity=polarity, min_radius=1.2)
    invert = None
    if polarity == "dark":
        frame, invert = (scale - frame.astype(np.int64)).astype(frame.dtype), scale
    _, found = candidates_of(frame, options, scale)
    blobs = measure(frame, found, options, scale)
    labels = image_of(found, frame.shape)
    expected, pixels = [], set()
    for label, box, whole in zip(found.label, found.boxes, found.whole, strict=True):
        half, parted = half_size(box, whole), bool((whole != box).any())
        one = reference.measure(frame, labels, label, box, half, 0.995 * scale, invert, parted)
        pixel = None if one is None else (round(one[0]), round(one[1]))
        if one is not None and 1.2 <= one[3] <= 16 and one[4] <= 4 and pixel not in pixels:
            pixels.add(pixel)
            expected.append(one)
    assert len(expected) == len(blobs.uv) > 40
    for row, (u, v, sigma, radius, _, flags) in enumerate(expected):
        assert abs(blobs.uv[row] - (u, v)).max() < 2e-4
        assert blobs.sigma[row] == pytest.approx(sigma, rel=1e-3)
        assert blobs.radius[row] == pytest.approx(radius, rel=1e-4)
        assert int(blobs.flags[row]) & ~int(BlobFlag.BORDER) == flags
    kinds = {int(flag) for flag in blobs.flags}
    assert any(kind & BlobFlag.MERGED for kind in kinds)
    assert any(kind & BlobFlag.SATURATED for kind in kinds) == (peak == 900.0)


def test_components_too_large_are_cut_at_higher_levels():
    rng = np.random.default_rng(3)
    light = np.full(SHAPE, 20.0)
    light[60:180, 60:260] = 60  # a bright plate, far larger than any blob
    uv = np.array([[100.3, 100.6], [150.2, 130.1], [200.7, 90.4]])
    frame = exposed(draw_discs(SHAPE, uv, 4.0, contrast=190.0 - light[0, 0], background=light), 2.0, rng)
    _, found = candidates_of(frame, DetectionOptions(max_radius=6.0), 255)
    assert ((found.boxes[:, 2:] - found.boxes[:, :2]) < 4 * 6 + 8).all()
    for u, v in uv:
        assert ((found.boxes[:, :2] <= (u, v)) & (found.boxes[:, 2:] >= (u, v))).all(1).sum() == 1


def test_a_frame_full_of_blobs_and_an_empty_one():
    rng = np.random.default_rng(4)
    speckle = (rng.random((64, 68)) < 0.3).astype(np.uint8) * 200
    _, found = candidates_of(np.kron(speckle, np.ones((2, 2), np.uint8)), DetectionOptions(max_radius=3.0), 255)
    assert (found.boxes[:, 0] <= found.boxes[:, 2]).all()
    empty = np.zeros((64, 68), np.uint8)
    _, found = candidates_of(empty, DetectionOptions(), 255)
    assert len(found.boxes) == len(measure(empty, found, DetectionOptions(), 255).uv) == 0


def test_the_edge_is_a_normal_distribution():
    t = np.linspace(-6, 6, 1201)
    rise, density = reference.phi(t)
    np.testing.assert_allclose(rise, ndtr(t), atol=2.5e-4)
    np.testing.assert_allclose(density, np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi), atol=3e-3)
    assert (np.diff(rise) > -1e-7).all()

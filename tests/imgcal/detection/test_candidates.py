"""Candidates of frames whose blobs are known, shifted and turned; connecting and thresholds: test_kernels."""

import numpy as np
import pytest

from imgcal.detection import DetectionOptions
from imgcal.detection.candidates import BLOCK, block_means, outline, screen
from tests.imgcal.detection.discs import draw_discs, exposed, scattered

SHAPE = (160, 208)


def frame_of(seed=0, pitch=40, radius=3.5, noise=2.0):
    rng = np.random.default_rng(seed)
    uv = scattered(SHAPE, pitch, rng)
    return exposed(draw_discs(SHAPE, uv, radius), noise, rng), uv


def candidates_of(frame, options=DetectionOptions(), scale=255):
    screening = screen(block_means(frame, options, scale), options, scale)
    return outline(frame, screening, options, scale)


def boxes(found):
    return sorted(map(tuple, found.boxes.tolist()))


@pytest.mark.parametrize("shape", [(160, 208), (161, 210), (163, 207)])
def test_means_are_those_of_blocks_the_border_repeated(shape) -> None:
    frame = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    found = block_means(frame, DetectionOptions(), 255)
    rows, columns = (-(-n // BLOCK) for n in shape)
    padded = np.pad(frame, ((0, rows * BLOCK - shape[0]), (0, columns * BLOCK - shape[1])), mode="edge").astype(int)
    expected = (padded.reshape(rows, BLOCK, columns, BLOCK).sum((1, 3)) + 8) // 16
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_every_disc_is_one_whole_candidate_that_holds_it(seed, polarity) -> None:
    frame, uv = frame_of(seed)
    options = DetectionOptions(polarity=polarity)
    found = candidates_of(255 - frame if polarity == "dark" else frame, options)
    inside = (found.boxes[:, None, :2] <= uv) & (found.boxes[:, None, 2:] >= uv)
    np.testing.assert_array_equal(inside.all(-1).sum(0), 1)
    assert len(found.boxes) == len(uv) and (found.whole == found.boxes).all()
    size = found.boxes[:, 2:] - found.boxes[:, :2] + 1
    assert (size >= 5).all() and (size <= 13).all()


def test_a_shift_by_a_block_and_a_transposed_frame_give_shifted_and_transposed_boxes() -> None:
    frame, _ = frame_of(noise=0.0)
    expected = boxes(candidates_of(frame))
    shifted = np.roll(frame, (BLOCK, 2 * BLOCK), axis=(0, 1))
    moved = [(l + 2 * BLOCK, t + BLOCK, r + 2 * BLOCK, b + BLOCK) for l, t, r, b in expected]  # noqa: E741
    assert boxes(candidates_of(shifted)) == moved
    turned = boxes(candidates_of(np.ascontiguousarray(frame.T)))
    assert turned == sorted((t, l, b, r) for l, t, r, b in expected)  # noqa: E741


def test_grey_levels_of_another_scale_give_the_same_candidates() -> None:
    frame, _ = frame_of(noise=0.0)
    deep = candidates_of(frame.astype(np.uint16) * 16, scale=255 * 16)
    assert boxes(deep) == boxes(candidates_of(frame))


def test_a_threshold_leaves_out_what_is_dimmer() -> None:
    rng = np.random.default_rng(1)
    uv = scattered(SHAPE, 40, rng)
    contrast = np.where(np.arange(len(uv)) % 2, 200.0, 40.0)
    frame = exposed(draw_discs(SHAPE, uv, 3.5, contrast=contrast), 1.0, rng)
    assert len(candidates_of(frame).boxes) == len(uv)
    # Candidates are what may be brighter: a block mean holds a fifth of a peak at least.
    few = candidates_of(frame, DetectionOptions(threshold=250.0))
    bright = uv[contrast > 100]
    assert (((few.boxes[:, None, :2] <= bright) & (few.boxes[:, None, 2:] >= bright)).all(-1).sum(0) == 1).all()
    assert len(few.boxes) < len(uv)


def test_an_empty_frame_and_a_ramp_hold_nothing() -> None:
    ramp = np.linspace(10, 200, SHAPE[1])[None].repeat(SHAPE[0], 0)
    for frame in (np.zeros(SHAPE, np.uint8), np.full(SHAPE, 255, np.uint8), ramp.astype(np.uint8)):
        assert len(candidates_of(frame).boxes) == 0

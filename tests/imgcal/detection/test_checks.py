import numpy as np
import pytest

from imgcal.detection import detect
from imgcal.detection.checks import check_frame, check_mask, full_scale
from imgcal.errors import InputError


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ([[1, 2]], "found a list, expected a NumPy array"),
        (np.zeros((20, 20, 2), np.uint8), r"frame of shape \(20, 20, 2\), expected grey"),
        (np.zeros((20, 20), np.float32), "found float32 grey values"),
        (np.ma.masked_equal(np.zeros((20, 20), np.uint8), 0), "found a masked array"),
        (np.zeros((15, 200), np.uint8), "frame of 200 x 15, expected at least 16 x 16"),
    ],
)
def test_frames_that_cannot_be_are_named(frame, message) -> None:
    with pytest.raises(InputError, match=f"camera left: .*{message}"):
        check_frame(frame, "left")


@pytest.mark.parametrize("order", ["<u2", ">u2"])
def test_frames_of_any_byte_order_are_taken(order: str) -> None:
    frame = np.arange(400, dtype=np.uint16).reshape(20, 20)
    for given in (frame.astype(order), np.repeat(frame[..., None], 3, -1).astype(order)):
        found = check_frame(given, "left")
        assert found.dtype == np.uint16 and np.array_equal(found, frame)


def test_what_is_no_mapping_of_frames_is_named() -> None:
    frame = np.zeros((20, 20), np.uint8)
    for given in (frame, [frame]):
        with pytest.raises(InputError, match=r"frames: found a .*, expected \{camera name"):
            detect(given)


def test_frames_are_taken_as_they_are_and_masks_as_bits() -> None:
    frame = np.zeros((16, 20), np.uint16)
    assert check_frame(frame, "left") is frame
    mask = np.zeros((16, 20), np.uint8)
    mask[3, 4] = 255
    found = check_mask(mask, frame, "left")
    assert found.dtype == np.bool_ and found.sum() == 1 and found[3, 4]
    assert check_mask(found, frame, "left") is found
    for wrong in (mask[:8], "mask"):
        with pytest.raises(InputError, match="camera left: found a mask of"):
            check_mask(wrong, frame, "left")


@pytest.mark.parametrize(
    ("brightest", "expected"), [(0, 1023), (1023, 1023), (1024, 4095), (4096, 16383), (16384, 65535)]
)
def test_the_brightest_pixel_tells_the_depth_of_16_bit_frames(brightest: int, expected: int) -> None:
    frame = np.zeros((16, 16), np.uint16)
    frame[2, 2] = brightest
    assert full_scale(frame, None, "left") == expected


def test_a_given_depth_must_fit_the_frame() -> None:
    frame = np.full((16, 16), 4000, np.uint16)
    assert full_scale(frame, 12, "left") == 4095
    assert full_scale(frame.astype(np.uint8), None, "left") == full_scale(frame.astype(np.uint8), 8, "left") == 255
    with pytest.raises(InputError, match=r"grey value of 4000, expected at most 1023 \(10 bit\)"):
        full_scale(frame, 10, "left")
    with pytest.raises(InputError, match="found a frame of 8 bit, expected 12 bit"):
        full_scale(frame.astype(np.uint8), 12, "left")

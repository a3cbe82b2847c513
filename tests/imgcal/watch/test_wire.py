import json

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.watch.wire import LONGEST_LINE, exposure_from_json, exposure_from_pixels

HEADER = {"camera": "a", "time": 1, "width": 3, "height": 2, "type": "uint16"}


def test_blobs_of_each_and_of_all():
    line = b'{"camera": "a", "time": 3, "uv": [[1, 2], [3, 4]], "sigma": [0.1, 0.2], "radius": 2}'
    exposure = exposure_from_json(line)
    assert (exposure.camera, exposure.time, exposure.snapshot) == ("a", 3.0, None)
    assert exposure.content.sigma.tolist() == [0.1, 0.2] and exposure.content.radius.tolist() == [2.0, 2.0]
    assert len(exposure_from_json('{"camera": "a", "time": 0.5, "uv": []}').content.uv) == 0


def test_pixels_come_row_by_row_low_byte_first():
    frame = np.arange(6, dtype="<u2").reshape(2, 3) * 1000
    assert (exposure_from_pixels(json.dumps(HEADER), frame.tobytes()).content == frame).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a line of JSON"),
        (b"\xff\xfe", "expected a line of JSON"),
        ("[1, 2]", r"found \[1, 2\], expected the keys"),
        ("{}", "found no keys, expected the keys camera, time, uv, optional radius, sigma"),
        ('{"camera": "a", "time": 1, "uv": [], "sigmas": 1}', "sigmas, expected the keys"),
        ('{"camera": 1, "time": 1, "uv": []}', "expected a name and seconds"),
        ('{"camera": "a", "time": "1", "uv": []}', "expected a name and seconds"),
        ('{"camera": "a", "time": true, "uv": []}', "expected a name and seconds"),
        ('{"camera": "a", "time": 1' + "0" * 400 + ', "uv": []}', "expected seconds"),
        ('{"camera": "a", "time": 1, "uv": [[1, 2, 3]]}', "found shape"),
        ('{"camera": "a", "time": 1, "uv": {"u": 1}}', "expected numbers"),
        ("[" * 100_000, "nested"),
        (" " * (LONGEST_LINE + 1), "at most"),
    ],
)
def test_what_is_no_blobs(text, message):
    with pytest.raises(InputError, match=message):
        exposure_from_json(text)


@pytest.mark.parametrize(
    ("change", "pixels", "message"),
    [
        ({}, 11, "found 11 bytes of pixels, expected 12"),
        ({"width": -3}, 12, "expected whole numbers"),
        ({"width": 10**9, "height": 10**9}, 12, "expected whole numbers"),
        ({"width": 1.5}, 12, "expected whole numbers"),
        ({"type": "float64"}, 48, "expected uint8 or uint16"),
        ({"type": ["uint8"]}, 6, "expected uint8 or uint16"),
        ({"uv": []}, 12, "expected the keys"),
    ],
)
def test_what_is_no_frame(change, pixels, message):
    with pytest.raises(InputError, match=message):
        exposure_from_pixels(json.dumps({**HEADER, **change}), bytes(pixels))

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.watch import CameraBlobs, Exposure, check_exposure
from imgcal.watch.exposures import MOST_BLOBS


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"uv": [[1.0, 2.0, 3.0]]}, r"found shape \(1, 3\)"),
        ({"uv": [[1.0], [2.0, 3.0]]}, "expected numbers"),
        ({"uv": "abc"}, "expected numbers"),
        ({"uv": [[10**400, 1.0]]}, "expected numbers"),
        ({"uv": [[float("nan"), 1.0]]}, "found nan"),
        ({"uv": [[1.0, 1e300]]}, r"found 1e\+300"),
        ({"uv": [[None, 1.0]]}, "found nan"),
        ({"uv": [[0.0, 0.0]] * (MOST_BLOBS + 1)}, "at most 10,000"),
        ({"uv": [[1.0, 1.0]], "sigma": 0.0}, "sigma: found 0"),
        ({"uv": [[1.0, 1.0]], "sigma": [0.1, 0.1]}, "expected one number or 1"),
        ({"uv": [[1.0, 1.0]], "radius": [-1.0]}, "radius: found -1"),
    ],
)
def test_blobs_that_no_camera_sees(values, message):
    with pytest.raises(InputError, match=message):
        CameraBlobs.of(**values)


def test_no_blobs_are_an_answer():
    assert CameraBlobs.of([]).uv.shape == (0, 2)


def test_exposures_are_compared_with_the_rig(o10):
    width, height = o10.image_size[0].tolist()
    good = [
        Exposure("cam01", 1.7e9, np.zeros((height, width), np.uint16)),
        Exposure("cam01", 0.0, CameraBlobs.of([[0.0, 0.0], [width - 1, height - 1]])),
    ]
    assert [check_exposure(exposure, o10) for exposure in good] == good
    bad = [
        (Exposure("cam99", 0.0, good[0].content), "found camera 'cam99'"),
        (Exposure("cam01", float("inf"), good[0].content), "found the time inf"),
        (Exposure("cam01", -1.0, good[0].content), "found the time -1"),
        (Exposure("cam01", 1.7e18, good[0].content), "expected seconds"),
        (Exposure("cam01", 0.0, np.zeros((width, height), np.uint8)), f"found {height}x{width} pixels of uint8"),
        (Exposure("cam01", 0.0, np.zeros((height, width, 3), np.uint8)), "pixels of uint8, expected"),
        (Exposure("cam01", 0.0, np.zeros((height, width), np.float32)), "float32"),
        (Exposure("cam01", 0.0, CameraBlobs.of([[width + 100.0, 0.0]])), "expected a pixel of its"),
    ]
    for exposure, message in bad:
        with pytest.raises(InputError, match=message):
            check_exposure(exposure, o10)

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.types import ConvexVolume


def test_a_tetrahedron_is_no_box():
    volume = ConvexVolume(((0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 10)))
    assert not volume.is_box and volume.high == (10.0, 10.0, 10.0)
    assert volume.contains(np.array([[1, 1, 1], [9, 9, 9], [-1, 1, 1], [0, 0, 0]])).tolist() == [
        True, False, False, True,
    ]  # fmt: skip


def test_a_box_is_one_whatever_the_order_of_its_corners():
    volume = ConvexVolume.box((0, 0, 0), (1, 2, 3))
    assert ConvexVolume(volume.points[::-1]).is_box


@pytest.mark.parametrize(
    "points",
    [
        ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
        ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)),
        ((5, 5, 5),) * 4,
        ((0, 0, np.inf), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 0, np.nan), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ],
)
def test_what_encloses_nothing_is_refused(points):
    with pytest.raises(InputError, match="expected"):
        ConvexVolume(points)

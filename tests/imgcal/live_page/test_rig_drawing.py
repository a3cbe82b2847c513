import numpy as np
import pytest

from imgcal.io import read_rig
from imgcal.live_page.rig_drawing import arrangement, forward, upright, viewing_volume
from tests.imgcal.live_page.pages import dome


@pytest.mark.parametrize(
    ("name", "up", "inward"), [("O10", [0, -1, 0], False), ("T4", [0, -1, 0], False), ("room10", [0, 0, 1], True)]
)
def test_up_is_where_the_images_have_their_top(name, up, inward):
    rig = read_rig(name)
    found = arrangement(rig, viewing_volume(rig))
    assert found["up"] == pytest.approx(up, abs=0.01) and found["inward"] is inward
    assert np.dot(found["up"], found["ahead"]) == pytest.approx(0, abs=1e-4)
    assert np.linalg.norm(found["ahead"]) == pytest.approx(1, abs=1e-4)


def test_a_dome_is_upright_and_cameras_are_small_beside_it():
    rig = dome(64)
    found = arrangement(rig, viewing_volume(rig))
    assert found["up"] == pytest.approx([0, 0, 1], abs=0.05) and 50 < _size(found) < 350


def test_cameras_that_are_rolled_every_way_leave_the_normal_of_their_plane():
    angle = np.arange(6) * np.pi / 3
    centres = np.stack((np.cos(angle), np.sin(angle), np.zeros(6)), -1)
    axes = np.stack(
        [np.array([[-s, c, 0], [c, s, 0], [0, 0, -1.0]]) for c, s in zip(np.cos(angle), np.sin(angle), strict=True)]
    )
    up = upright(centres, axes, np.array([0.0, 0.0, -5.0]))
    assert up == pytest.approx([0, 0, 1], abs=1e-6)
    assert abs(forward(centres, axes, up)[2]) < 1e-9  # they look straight down: any level direction


def test_one_camera_has_a_size():
    rig = read_rig("O10").select([0])
    assert _size(arrangement(rig, viewing_volume(rig))) > 0


def _size(found):
    """Length of the first drawn camera."""
    apex, corner = np.array(found["cameras"])[0, :2]
    return np.linalg.norm(corner - apex)

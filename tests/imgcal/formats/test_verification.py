from dataclasses import replace

import numpy as np
import pytest

from imgcal.formats import Lens, known_points, worst_difference
from tests.imgcal.formats.rigs import brown, rig_of

RIG = rig_of(brown(-0.1), brown(0.05))


def test_points_are_all_over_the_images_and_in_depth() -> None:
    for camera, points in zip(RIG.cameras, known_points(RIG), strict=True):
        uv = camera.project(points)
        assert uv.min(axis=0) == pytest.approx([-0.5, -0.5])
        assert uv.max(axis=0) == pytest.approx([1279.5, 959.5])
        depth = camera.in_camera(points)[:, 2]
        assert depth.max() / depth.min() == pytest.approx(8.0)


def test_a_pixel_is_seen() -> None:
    one = RIG.cameras[1]
    moved = replace(
        one, lens=replace(one.lens, principal_point=(one.lens.principal_point[0] + 0.25, one.lens.principal_point[1]))
    )
    worst, count = worst_difference(RIG, replace(RIG, cameras=(RIG.cameras[0], moved)))
    assert worst == pytest.approx(0.25)
    assert count == 2 * 3 * 49


def test_the_frame_is_free_and_a_camera_s_place_is_not() -> None:
    assert worst_difference(RIG, RIG.in_camera_frame())[0] < 1e-9
    one = RIG.cameras[1]
    moved = replace(one, translation=one.translation + np.array([1.0, 0.0, 0.0]))
    assert worst_difference(RIG, replace(RIG, cameras=(RIG.cameras[0], moved)))[0] > 0.5


def test_what_one_of_them_cannot_see_is_infinitely_far() -> None:
    folded = replace(RIG.cameras[1], lens=Lens((1010.5, 1012.25), (641.3, 478.9), (3e-7, 0, 0), "to_ideal"))
    assert worst_difference(RIG, replace(RIG, cameras=(RIG.cameras[0], folded)))[0] > 5

import numpy as np

from tests.imgcal.formats.rigs import apart, brown, rig_of


def test_the_frame_of_the_first_camera() -> None:
    rig = rig_of(brown(-0.1), brown(0.05), brown())
    moved = rig.in_camera_frame()
    assert np.array_equal(moved.cameras[0].rotation, np.eye(3))
    assert not moved.cameras[0].translation.any()
    assert apart(rig, moved) < 1e-9
    assert np.allclose(
        np.linalg.norm(moved.cameras[2].centre - moved.cameras[1].centre),
        np.linalg.norm(rig.cameras[2].centre - rig.cameras[1].centre),
    )


def test_another_unit() -> None:
    rig = rig_of(brown(-0.1), brown())
    metres = rig.scale(1e-3, "m")
    assert metres.unit == "m"
    points = np.array([[10.0, -20.0, 900.0]])
    assert np.allclose(metres.cameras[1].project(points * 1e-3), rig.cameras[1].project(points), atol=1e-9)
    assert np.allclose(metres.cameras[1].centre, rig.cameras[1].centre * 1e-3)

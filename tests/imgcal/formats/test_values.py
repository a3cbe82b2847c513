import cv2
import numpy as np
import pytest

from imgcal.formats import values
from imgcal.formats.foreign_rig import FormatError


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0, np.pi - 1e-9, np.pi])
def test_rotations_agree_with_opencv(angle: float) -> None:
    for axis in ([1.0, 0, 0], [0, 1.0, 0], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]):
        vector = np.array(axis) * angle
        matrix = values.rotation_from_vector(vector)
        assert np.abs(matrix - cv2.Rodrigues(vector)[0]).max() < 1e-12
        assert np.abs(values.rotation_from_vector(values.vector_from_rotation(matrix)) - matrix).max() < 1e-12
        q = values.quaternion_from_rotation(matrix)
        assert np.abs(values.rotation_from_quaternion(q.tolist(), "q") - matrix).max() < 1e-12


def test_a_quaternion_is_hamilton_s_w_first() -> None:
    quarter = values.rotation_from_quaternion([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], "q")  # about z
    assert np.allclose(quarter @ [1, 0, 0], [0, 1, 0])


def test_what_a_number_may_be() -> None:
    assert values.numbers("1 2,3.5", "x") == [1, 2, 3.5]
    assert values.numbers({"rows": 1, "cols": 2, "data": [1, 2]}, "x") == [1, 2]
    assert values.numbers([[1, 2], [3]], "x") == [1, 2, 3]
    for bad in (float("nan"), float("inf"), True, "a", None, 1e300, {}, 10**400):
        with pytest.raises(FormatError, match="x: found"):
            values.number(bad, "x")


def test_what_a_rotation_may_be() -> None:
    rounded = np.round(values.rotation_from_vector(np.array([0.1, -0.2, 0.3])), 5)
    found = values.rotation(rounded.tolist(), "R")
    assert np.abs(found @ found.T - np.eye(3)).max() < 1e-12
    assert np.abs(found - rounded).max() < 1e-4
    with pytest.raises(FormatError, match="mirror"):
        values.rotation(np.diag([1.0, 1.0, -1.0]).tolist(), "R")
    with pytest.raises(FormatError, match="expected a rotation"):
        values.rotation((2 * np.eye(3)).tolist(), "R")
    with pytest.raises(FormatError, match="quaternion of length 0"):
        values.rotation_from_quaternion([0, 0, 0, 0], "q")


def test_what_a_camera_matrix_may_be() -> None:
    focal, centre, skew = values.camera_matrix([[900, 0.5, 640], [0, 905, 400], [0, 0, 1]], "K")
    assert (focal, centre, skew) == ((900, 905), (640, 400), 0.5)
    for bad in (
        [[900, 0, 640], [3, 905, 400], [0, 0, 1]],
        [[-900, 0, 640], [0, 905, 400], [0, 0, 1]],
        [[0] * 3] * 3,
        [1],
    ):
        with pytest.raises(FormatError, match="K: found"):
            values.camera_matrix(bad, "K")


def test_what_an_image_size_may_be() -> None:
    assert values.image_size(None, "s") is None
    assert values.image_size([0, 0], "s") is None
    assert values.image_size(["1280", 720.0], "s") == (1280, 720)
    for bad in ([1280.5, 720], [-1, 2], [10**6, 3], [0, 5]):
        with pytest.raises(FormatError, match="s: found"):
            values.image_size(bad, "s")


def test_coefficients_are_as_many_as_some_model_has() -> None:
    assert values.coefficients([[0.1, 0.2, 0, 0]], "d") == (0.1, 0.2, 0, 0)
    assert values.coefficients(None, "d") == ()
    with pytest.raises(FormatError, match="found 3 distortion coefficients"):
        values.coefficients([1, 2, 3], "d")


def test_a_scale_of_a_camera_matrix_that_nothing_can_be_divided_by_is_refused_without_a_warning() -> None:
    with pytest.raises(FormatError, match="expected a camera matrix"):
        values.camera_matrix([[900, 0, 640], [0, 905, 400], [0, 0, 1e-310]], "K")

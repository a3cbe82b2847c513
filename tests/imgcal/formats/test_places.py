import numpy as np

from imgcal.formats import places
from imgcal.formats.values import quaternion_from_rotation, rotation_from_vector
from tests.imgcal.formats.rigs import brown, rig_of

CAMERA = rig_of(brown(), brown(0.1)).cameras[1]


def test_rotations_stay_on_the_branch_of_the_file() -> None:
    vector = np.array([0.0, 3.0, 0.5])
    turned = rotation_from_vector(vector)
    camera = type(CAMERA)("a", CAMERA.lens, None, turned, np.zeros(3))
    other = vector * (1 - 2 * np.pi / np.linalg.norm(vector))
    assert np.allclose(places.rotation_like(vector.tolist())(camera), vector)
    assert np.allclose(places.rotation_like(other.tolist())(camera), other)
    q = quaternion_from_rotation(turned)
    assert np.allclose(places.near_quaternion(turned, (-q).tolist()), -q)


def test_a_pose_that_goes_along() -> None:
    before = (CAMERA.rotation, CAMERA.translation)
    pose = (rotation_from_vector(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    numbers = places.carry_pose(before, pose, places.matrix_rows)
    assert np.allclose(numbers(CAMERA), np.column_stack(pose).ravel())
    moved = type(CAMERA)("a", CAMERA.lens, None, CAMERA.rotation, CAMERA.translation + np.array([5.0, 0, 0]))
    assert np.allclose(np.reshape(numbers(moved), (3, 4))[:, 3], [6.0, 2.0, 3.0])

"""A rig's values as compiled loops are given them."""

import numpy as np

import imgcal
from imgcal.monitoring.rig_arrays import RigArrays


def test_they_are_those_of_the_rig_in_the_order_of_the_loops() -> None:
    rig = imgcal.load_rig("T4")
    arrays = RigArrays.of(rig)
    rotation, position, focal, principal, distortion = arrays.parts
    np.testing.assert_array_equal(rotation, rig.cam_from_rig.rotation.numpy())
    np.testing.assert_allclose(position, rig.positions.numpy())
    for found, expected in ((focal, rig.focal_length), (principal, rig.principal_point), (distortion, rig.distortion)):
        np.testing.assert_array_equal(found, expected.numpy())
    assert all(part.flags.c_contiguous for part in arrays.parts)

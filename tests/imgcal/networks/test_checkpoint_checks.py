"""The same rig and object through text are the same; any other value is named."""

from dataclasses import replace

import pytest
import torch

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.networks import check_object, check_rig


def test_single_precision_is_the_same_rig_and_object(o10, asymmetric8) -> None:
    check_rig("model", o10, o10)
    check_rig("model", o10.to(torch.float32), o10)
    check_object("model", asymmetric8, asymmetric8)
    single = replace(asymmetric8, points=asymmetric8.points.float())
    check_object("model", single, asymmetric8)


@pytest.mark.parametrize(
    ("field", "what"),
    [("focal_length", "focal length"), ("principal_point", "principal point"), ("distortion", "distortion")],
)
def test_a_value_that_differs_is_named_with_its_camera(field, what, o10) -> None:
    values = getattr(o10, field).clone()
    values[3, 1] += 0.01
    with pytest.raises(InputError, match=f"model: trained for another rig than O10 .*: {what} of cam04: found"):
        check_rig("model", o10, replace(o10, **{field: values}))


def test_a_camera_that_is_elsewhere_turned_or_missing_is_named(o10) -> None:
    turn = rotation_from_vector(torch.tensor([1e-4, 0, 0], dtype=torch.float64))
    rotation = o10.cam_from_rig.rotation.clone()
    rotation[2] = turn @ rotation[2]
    position = o10.positions
    same_place = RigidTransform(rotation, -(rotation @ position[..., None])[..., 0])
    with pytest.raises(InputError, match="rotation of cam03"):
        check_rig("model", o10, replace(o10, cam_from_rig=same_place))
    shift = o10.cam_from_rig.translation.clone()
    shift[5, 0] += 0.1
    with pytest.raises(InputError, match="position of cam06"):
        check_rig("model", o10, replace(o10, cam_from_rig=RigidTransform(o10.cam_from_rig.rotation, shift)))
    with pytest.raises(InputError, match=r"cameras: found cam01, cam02, expected cam01, cam02, cam03"):
        check_rig("model", o10, o10.select([0, 1]))


def test_a_fiducial_that_differs_is_named(asymmetric8) -> None:
    points = asymmetric8.points.clone()
    points[4, 2] += 0.1
    with pytest.raises(InputError, match=r"another object than asymmetric8 .*: fiducial 5: found x, y, z, radius"):
        check_object("model", asymmetric8, replace(asymmetric8, points=points))
    with pytest.raises(InputError, match="fiducial 1: found"):
        check_object("model", asymmetric8, replace(asymmetric8, radius=torch.full((8,), 3.0).double()))
    few = replace(asymmetric8, points=asymmetric8.points[:7], colours=asymmetric8.colours[:7])
    with pytest.raises(InputError, match="found 7 fiducials, expected 8"):
        check_object("model", asymmetric8, few)

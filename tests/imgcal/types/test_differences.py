from dataclasses import replace

import torch

from imgcal.types import object_difference, rig_difference


def test_what_came_through_single_precision_is_the_same(o10, asymmetric8):
    assert rig_difference(o10.to(torch.float32), o10) is None
    assert object_difference(replace(asymmetric8, points=asymmetric8.points.float()), asymmetric8) is None


def test_the_first_value_that_differs_is_named_with_what_was_found_and_expected(o10, asymmetric8):
    assert rig_difference(o10.select([0]), o10.select([0, 1])) == "cameras: found cam01, expected cam01, cam02"
    values = o10.focal_length.clone()
    values[3] = torch.tensor([900.0, 900.5])
    found = rig_difference(replace(o10, focal_length=values), o10)
    assert found.startswith("focal length of cam04: found 900, 900.5, expected ")
    points = asymmetric8.points.clone()
    points[4] = 7.0
    found = object_difference(replace(asymmetric8, points=points), asymmetric8)
    assert found.startswith("fiducial 5: found x, y, z, radius 7, 7, 7, 0, expected ")

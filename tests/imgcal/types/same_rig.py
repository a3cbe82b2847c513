"""Rigs compared value by value."""

import torch

from imgcal.types import CameraRig


def assert_same(first: CameraRig, second: CameraRig) -> None:
    torch.testing.assert_close(first.focal_length, second.focal_length)
    torch.testing.assert_close(first.principal_point, second.principal_point)
    torch.testing.assert_close(first.distortion, second.distortion)
    torch.testing.assert_close(first.cam_from_rig.rotation, second.cam_from_rig.rotation)
    torch.testing.assert_close(first.cam_from_rig.translation, second.cam_from_rig.translation)

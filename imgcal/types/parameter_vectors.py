"""Convert rigs to the paper's vectors of 21 and 18 numbers per camera, and back."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from imgcal.geometry import RigidTransform, rotation_from_6d, sixd_from_rotation
from imgcal.types.rig import CameraRig


def pack21(rig: CameraRig) -> Tensor:
    """Pack the paper's 21 numbers per camera: rotation (9, row-major), translation, f, principal point, distortion (5).

    Args:
        rig: a rig in the object's frame (`CameraRig.from_object`).

    Returns:
        (*B, C, 16 + D), 21 for five coefficients. Convention: distortion in our order k1, k2, p1, p2, k3; the paper
        lists k1, k2, k3, p1, p2.

    Examples:
        >>> import imgcal
        >>> pack21(imgcal.load_rig("T4")).shape
        torch.Size([4, 21])
    """
    return torch.cat((rig.cam_from_rig.rotation.flatten(-2), _pack_rest(rig)), dim=-1)


def pack18(rig: CameraRig) -> Tensor:
    """Pack the paper's 18 network outputs per camera, `pack21` with a 6D rotation for the matrix: (*B, C, 13 + D)."""
    return torch.cat((sixd_from_rotation(rig.cam_from_rig.rotation), _pack_rest(rig)), dim=-1)


def unpack21(packed: Tensor, like: CameraRig) -> CameraRig:
    """Invert `pack21`; names and image sizes come from `like`.

    Examples:
        >>> import imgcal
        >>> rig = imgcal.load_rig("T4")
        >>> torch.equal(unpack21(pack21(rig), like=rig).focal_length, rig.focal_length)
        True
    """
    return _unpack(packed[..., :9].unflatten(-1, (3, 3)), packed[..., 9:], like)


def unpack18(packed: Tensor, like: CameraRig) -> CameraRig:
    """Invert `pack18`: (*B, C, 13 + D) to rigs (*B), orthogonalizing the 6D rotation; the rest as for `unpack21`."""
    return _unpack(rotation_from_6d(packed[..., :6]), packed[..., 6:], like)


def _pack_rest(rig: CameraRig) -> Tensor:
    return torch.cat((rig.cam_from_rig.translation, rig.focal_length, rig.principal_point, rig.distortion), dim=-1)


def _unpack(rotation: Tensor, rest: Tensor, like: CameraRig) -> CameraRig:
    translation, focal_length, principal_point, distortion = rest.split((3, 2, 2, like.distortion.shape[-1]), dim=-1)
    return replace(
        like,
        focal_length=focal_length,
        principal_point=principal_point,
        distortion=distortion,
        cam_from_rig=RigidTransform(rotation, translation),
    )

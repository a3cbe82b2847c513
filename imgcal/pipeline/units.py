"""Whether a rig and an object are in millimetres, as all files are to be: lengths that no camera or marker has."""

from __future__ import annotations

import torch

from imgcal.types import CalibrationObject, CameraRig

LEAST_IMAGE, LARGEST_IMAGE = 3.0, 5.0
"""An object whose image would be smaller (pixels) or larger (times the width of a frame) is of another unit."""
LEAST_DISTANCE, LEAST_SIZE = 20.0, 2.0
"""Millimetres: what is nearer and smaller than this is in metres."""
THOUSAND = 1000.0


def unit_doubt(rig: CameraRig, obj: CalibrationObject, from_scratch: bool = False) -> str:
    """Say which of a rig and an object seems to be in metres; empty where nothing does.

    Nothing is made of it but words: images alone cannot tell.

    Args:
        rig: its places, or how far it is from the object, say what is plausible.
        obj: the calibration object.
        from_scratch: the rig's lengths are those of the object.

    Examples:
        >>> import imgcal
        >>> from dataclasses import replace
        >>> rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
        >>> unit_doubt(rig, obj)
        ''
        >>> unit_doubt(rig, replace(obj, points=obj.points / 1000))
        'the object seems to be in metres, expected millimetres: it is 0.108 mm large, and 850 mm from the cameras'
    """
    distance = _distance(rig)
    if distance is None:
        return ""
    size, width = obj.size, float(rig.image_size[:, 0].double().median())
    image = float(rig.focal_length.mean()) * size / distance
    seen = f"it is {size:.3g} mm large, and {distance:.3g} mm from the cameras"

    def plausible(pixels: float) -> bool:
        return LEAST_IMAGE <= pixels <= LARGEST_IMAGE * width

    if not plausible(image) and image < LEAST_IMAGE and plausible(THOUSAND * image):
        return f"the object seems to be in metres, expected millimetres: {seen}"
    if not plausible(image) and image > LARGEST_IMAGE * width and plausible(image / THOUSAND):
        return f"the rig seems to be in metres, expected millimetres: the object is {seen.removeprefix('it is ')}"
    if distance < LEAST_DISTANCE and size < LEAST_SIZE:
        if from_scratch:
            return f"the object seems to be in metres, expected millimetres: {seen}"
        return f"rig and object seem to be in metres, expected millimetres: the object is {seen.removeprefix('it is ')}"
    return ""


def _distance(rig: CameraRig) -> float | None:
    """How far the cameras are from what they look at, in the unit of their positions; None = nobody knows."""
    if rig.working_distance is not None:
        return max(float(rig.working_distance), 1e-9)
    if rig.num_cameras < 2:
        return None
    axes, centres = rig.cam_from_rig.rotation[:, 2].double(), rig.positions.double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None]
    # Where the optical axes meet; parallel ones meet far away, held back to some baselines.
    baseline = float(torch.cdist(centres, centres).max())
    weak = 1e-2 * torch.eye(3, dtype=torch.float64)
    middle = centres.mean(0)
    right = (across @ (centres - middle)[..., None]).sum(0)[:, 0]
    point = middle + torch.linalg.solve(across.sum(0) + weak, right)
    depth = float(((point - centres) * axes).sum(1).median())
    return max(depth, baseline, 1e-9)

"""Check that a rig and an object are in millimetres, radians and pixels, as in all files.

Implausible lengths of cameras or markers show a wrong unit at once. After an estimate has failed, labelled images show
more: each camera alone determines its pose relative to the object, and two of them their distance in the object's unit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import to_observations
from imgcal.errors import RefusedError
from imgcal.estimation import single_camera_poses
from imgcal.geometry import RigidTransform, vector_from_rotation
from imgcal.pipeline.lines_of_sight import choose_telling_snapshots, sight_angles
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations

UNSOLVABLE = (np.linalg.LinAlgError, torch.linalg.LinAlgError)
"""Raised where equations have no solution."""
LEAST_IMAGE, LARGEST_IMAGE = 3.0, 5.0
"""If an object's image is smaller (pixels) or larger (times the image width) than this, its unit is wrong."""
LEAST_DISTANCE, LEAST_SIZE = 20.0, 1.0
"""Millimetres: objects nearer and smaller than this are in metres; an endoscope sees larger ones from there."""
NARROW = 5.0
"""Focal length in image widths from which the rig may be of microscopes, which are as near to objects as small."""
LARGEST_DISTANCE, LARGEST_SIZE = 200_000.0, 20_000.0
"""Millimetres: objects farther and larger than this are in micrometres."""
THOUSAND = 1000.0
LEAST_FOCAL = 0.05
"""Minimum focal length in image widths; an all-round fisheye lens has 0.16."""
LENGTHS = {"centimetres": 10.0, "inches": 25.4, "feet": 304.8, "metres": THOUSAND}
SAME_UNIT = 1.3
"""Maximum deviation, as a factor, of a ratio of lengths from that of a unit."""
LEAST_RATIO, LEAST_LOOKS = 3.0, 6.0
"""Minimum ratio of lengths for different units: between cameras with labels, and from image sizes without labels."""
LEAST_TURN, MOST_TURNED = math.radians(20), 0.9
"""Minimum rotation error for a rig with rotations in degrees, and minimum share of the pairs of cameras with it: if two
of four cameras are exchanged, 0.83."""
LARGEST_MISFIT = 0.02
"""Largest residual of an image by itself, as a share of the object's extent in it, if object and labels are right."""


def unit_doubt(rig: CameraRig, obj: CalibrationObject, from_scratch: bool = False) -> str:
    """Say which of a rig and an object seems to be in another unit; empty if neither does.

    This only makes a message: images alone cannot tell. A rig and an object both in inches are not noticed: millimetres
    would be as plausible.

    Args:
        rig: its positions, or distance from the object, define what is plausible.
        obj: the calibration object; a single marker, or unknown markers, show no size.
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
    if doubt := _focal_doubt(rig):
        return doubt
    distance = _distance(rig)
    if distance is None:
        return ""
    width = float(rig.image_size[:, 0].double().median())
    unit = _implausible_unit(distance, obj, float(rig.focal_length.mean()) / width)
    if obj.pose_rank == 3:
        seen = f"the markers are {distance:.3g} mm from the cameras"
        return f"the rig seems to be in {unit}, expected millimetres: {seen}" if unit else ""
    size = obj.size
    image = float(rig.focal_length.mean()) * size / distance
    seen = f"it is {size:.3g} mm large, and {distance:.3g} mm from the cameras"

    def plausible(pixels: float) -> bool:
        return LEAST_IMAGE <= pixels <= LARGEST_IMAGE * width

    if not plausible(image) and image < LEAST_IMAGE and plausible(THOUSAND * image):
        return f"the object seems to be in metres, expected millimetres: {seen}"
    if not plausible(image) and image > LARGEST_IMAGE * width and plausible(image / THOUSAND):
        return f"the rig seems to be in metres, expected millimetres: the object is {seen.removeprefix('it is ')}"
    if unit and from_scratch:
        return f"the object seems to be in {unit}, expected millimetres: {seen}"
    if unit:
        return f"rig and object seem to be in {unit}, expected millimetres: the object is {seen.removeprefix('it is ')}"
    return ""


def _implausible_unit(distance: float, obj: CalibrationObject, focal_share: float) -> str:
    """Name the unit of a rig and its object if no such rig can be in millimetres; empty if it can.

    Args:
        distance: from the cameras to the object.
        obj: the object; the size of a single marker, or of unknown ones, does not count.
        focal_share: focal length in image widths.
    """
    has_size = obj.pose_rank > 3
    if distance < LEAST_DISTANCE and focal_share < NARROW and (obj.size < LEAST_SIZE or not has_size):
        return "metres"
    if distance > LARGEST_DISTANCE and (obj.size > LARGEST_SIZE or not has_size):
        return "micrometres"
    return ""


def image_doubt(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> str:
    """Say how the images contradict the units of a rig and an object; empty if they do not.

    For use after an estimate has failed: an object far from its expected place looks the same.

    Args:
        detections: blobs. With labels, each camera alone gives its pose relative to the object; without, they show the
            apparent size of the object.
        rig: the factory calibration.
        obj: the calibration object.
    """
    if (detections.fiducial >= 0).any():
        return _doubt_by_poses(detections, rig, obj)
    return _doubt_by_directions(detections, rig) or _doubt_by_size(detections, rig, obj)


def is_solid(obj: CalibrationObject) -> bool:
    """Tell whether its extent in an image means something; that of a light says nothing, and of a stick little."""
    return obj.pose_rank == 6 and not obj.parts


def require_units(
    error: RefusedError, detections: Detections, rig: CameraRig, obj: CalibrationObject, from_scratch: bool = False
) -> None:
    """Replace a refusal by one with the cause if values seem to be in another unit.

    Args:
        error: the refusal.
        detections: the blobs that were refused.
        rig: the factory calibration.
        obj: the calibration object.
        from_scratch: the rig's lengths are those of the object.

    Raises:
        RefusedError: a unit is in doubt.
    """
    by_images = ""
    if is_solid(obj) and not from_scratch and not _focal_doubt(rig):
        by_images = image_doubt(detections, rig, obj)
    if doubt := by_images or unit_doubt(rig, obj, from_scratch):
        raise RefusedError(f"{doubt}; so {error.reason}") from error


@contextmanager
def require_solvable() -> Iterator[None]:
    """Refuse if equations in the block cannot be solved: no camera or object has values of such a size.

    Raises:
        RefusedError: in place of a linear algebra error.
    """
    try:
        yield
    except UNSOLVABLE as error:
        raise RefusedError(
            "estimation: the equations cannot be solved: rig, object and blobs do not belong together, or their units "
            "are not millimetres, radians and pixels"
        ) from error


def _focal_doubt(rig: CameraRig) -> str:
    share = rig.focal_length.double().mean(-1) / rig.image_size[:, 0]
    if not bool((share < LEAST_FOCAL).any()):
        return ""
    camera = int(share.argmin())
    focal, width = float(rig.focal_length[camera].mean()), int(rig.image_size[camera, 0])
    unit = "relative to the width" if focal < 3 else "in millimetres"
    return (
        f"the focal length of camera {rig.camera_names[camera]} seems to be {unit}, expected pixels: it is "
        f"{focal:.3g}, and images are {width} pixels wide"
    )


def _doubt_by_poses(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> str:
    """Compare the cameras' relative poses, by the object in each camera alone, with the rig's."""
    labelled = detections.select((detections.fiducial >= 0) & detections.usable)
    chosen = labelled.choose_snapshots(choose_telling_snapshots(labelled, rig.num_cameras))
    seen = to_observations(chosen, rig, obj)
    placed, known = single_camera_poses(seen, rig, obj)
    images = int(known.sum())
    known &= _fit_alone(seen, placed, rig, obj)
    if 2 * int(known.sum()) < images:  # object or labels are wrong: the others fit by chance
        return ""
    lengths, turns, alike = [], [], []
    for first in range(rig.num_cameras):
        for second in range(first):
            both = known[:, first] & known[:, second]
            if both.any():
                in_rig = rig.cam_from_rig[second] @ rig.cam_from_rig[first].inverse()
                found = placed[both, second] @ placed[both, first].inverse()
                turns.append(_angles(found.rotation, in_rig.rotation).median())
                # The relation of two cameras is the same in every snapshot, or the object or its labels are wrong.
                alike.append(_angles(found.rotation[:, None], found.rotation).median(-1).values.min() < LEAST_TURN / 2)
                lengths.append(found.translation.norm(dim=-1) / in_rig.translation.norm().clamp_min(1e-12))
    if not lengths:
        return ""
    turn, ratio = torch.stack(turns), float(torch.cat(lengths).median())
    if bool(((turn > LEAST_TURN) & torch.stack(alike)).double().mean() >= MOST_TURNED):
        return (
            f"the rotations between cameras are {math.degrees(turn.median()):.0f} deg off what the images show; "
            "expected rotations in radians that take the rig to the camera (cam_from_rig)"
        )
    return _describe_smaller(ratio, LEAST_RATIO)


def _angles(some: Tensor, others: Tensor) -> Tensor:
    """Angles (...,) between rotations (..., 3, 3), rad."""
    return vector_from_rotation(some @ others.mT).norm(dim=-1)


def _fit_alone(seen: Observations, placed: RigidTransform, rig: CameraRig, obj: CalibrationObject) -> NDArray[np.bool_]:
    """Tell in which images (S, C) the object fits its labels, at cam_from_object (S, C): others show no pose."""
    cameras = replace(rig.to(torch.float64), cam_from_rig=RigidTransform.identity(rig.num_cameras, dtype=torch.float64))
    points = placed.apply(obj.points.double())  # (S, C, N, 3)
    uv = torch.stack(
        [cameras.select([c]).expand(len(points)).project(points[:, c]).uv[:, 0] for c in range(rig.num_cameras)], 1
    )
    there, count = seen.seen[..., None], seen.seen.sum(-1).clamp_min(1)[..., None]
    middle = torch.where(there, seen.uv, 0.0).sum(-2) / count
    missed, extent = (
        torch.where(seen.seen, values.square().sum(-1), 0.0).sum(-1)
        for values in (uv - seen.uv, seen.uv - middle[..., None, :])
    )
    return np.asarray(missed <= LARGEST_MISFIT**2 * extent)


def _doubt_by_directions(detections: Detections, rig: CameraRig) -> str:
    """Test by how much the cameras' lines of sight to the object miss each other."""
    angles = sight_angles(detections, rig.to(torch.float64))
    missed = float(np.median(angles[np.isfinite(angles)])) if np.isfinite(angles).any() else 0.0
    if missed < LEAST_TURN:
        return ""
    return (
        "with the rig's rotations, the cameras' lines of sight to the object miss each other by "
        f"{math.degrees(missed):.0f} deg; expected rotations in radians that take the rig to the camera (cam_from_rig)"
    )


def _doubt_by_size(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> str:
    """Compare the object's apparent size, in images with hardly anything else, with the expected size."""
    distance = _distance(rig)
    if distance is None:
        return ""
    sizes = []
    for snapshot in choose_telling_snapshots(detections, rig.num_cameras, least_cameras=1):
        for camera in range(rig.num_cameras):
            mine = (detections.snapshot == snapshot) & (detections.camera == camera) & detections.usable
            if 3 <= int(mine.sum()) <= obj.num_fiducials:
                uv = detections.uv[mine]
                extent = float(np.linalg.norm(uv - uv.mean(0), axis=1).max())
                sizes.append(extent / float(rig.focal_length[camera].mean()))
    if not sizes:
        return ""
    centred = obj.points.double() - obj.points.double().mean(0)
    expected = float(centred.norm(dim=-1).max()) / distance
    ratio = expected / max(float(np.median(sizes)), 1e-12)
    return _describe_smaller(ratio, LEAST_LOOKS)


def _describe_smaller(ratio: float, least: float) -> str:
    """Say which of rig (ratio > 1) and object is too small for the other, and which unit would explain it."""
    factor = max(ratio, 1 / max(ratio, 1e-12))
    if factor < least:
        return ""
    unit = min(LENGTHS, key=lambda name: abs(math.log(factor / LENGTHS[name])))
    same = 1 / SAME_UNIT < factor / LENGTHS[unit] < SAME_UNIT
    small, other = ("rig", "object") if ratio > 1 else ("object", "rig")
    known = unit if same else "another unit"
    return (
        f"the {small} is {factor:.3g} times too small for the {other}, as if it were in {known}; expected millimetres"
    )


def _distance(rig: CameraRig) -> float | None:
    """Usual distance of the object, in the unit of the positions: the rig's own, or where the optical axes meet."""
    if rig.working_distance is not None:
        return max(float(rig.working_distance), 1e-9)
    if rig.num_cameras < 2:
        return None
    axes, centres = rig.cam_from_rig.rotation[:, 2].double(), rig.positions.double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None]
    # Where the optical axes meet; the limit for parallel ones is some baselines away.
    baseline = float(torch.cdist(centres, centres).max())
    weak = 1e-2 * torch.eye(3, dtype=torch.float64)
    middle = centres.mean(0)
    right = (across @ (centres - middle)[..., None]).sum(0)[:, 0]
    point = middle + torch.linalg.solve(across.sum(0) + weak, right)
    depth = float(((point - centres) * axes).sum(1).median())
    return max(depth, baseline, 1e-9)

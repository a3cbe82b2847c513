"""Made-up rigs: cameras in rings, domes and rows that look at a point."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.synthesis.lens import Lens, Shape
from imgcal.types import CameraRig, ConvexVolume, RigPrior, limits

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
USED = 0.5
"""Half the width of the working volume, in parts of the cameras' distance from the point that they look at."""


def look_at(positions: Tensor, target: Tensor, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> RigidTransform:
    """Turn cameras to a point.

    Args:
        positions: (*B, 3) mm, the camera centres in the rig frame.
        target: (3,) mm or one for each, (*B, 3): what is seen in the middle of the images.
        up: direction of the rig frame that points up in the images; a camera that looks along it has another axis up.

    Returns:
        (*B) cam_from_rig.

    Raises:
        InputError: a camera is where it should look.

    Examples:
        >>> cam_from_rig = look_at(torch.tensor([[0.0, -2000.0, 0.0]]), torch.zeros(3))
        >>> cam_from_rig.apply(torch.tensor([[[0.0, 0.0, 100.0]]]))  # above the target: y is down
        tensor([[[   0., -100., 2000.]]])
    """
    forward = target - positions
    if bool((forward.norm(dim=-1) < 1e-6).any()):
        raise InputError("look_at: found a camera at the very point that it looks at, expected another position")
    forward = torch.nn.functional.normalize(forward, dim=-1)
    above = torch.tensor(up).to(forward).expand_as(forward)
    along = torch.linalg.cross(forward, above).norm(dim=-1, keepdim=True) < 1e-4 * above.norm(dim=-1, keepdim=True)
    above = torch.where(along, above.roll(1, -1), above)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, above), dim=-1)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
    return RigidTransform(rotation, -(rotation @ positions[..., None]).squeeze(-1))


def arrange_positions(shape: Shape, cameras: int, radius: float, height: float) -> Tensor:
    """Place cameras around the z axis: (C, 3) mm.

    Args:
        shape: ring = on a circle, evenly; dome = on a half sphere above z = `height`, evenly by its area; row = on a
            straight line of length 2 `radius` along x.
        cameras: how many, C.
        radius: mm: of the circle or the sphere.
        height: mm: z of the circle, the sphere's centre or the line.

    Examples:
        >>> arrange_positions("ring", 4, 1000.0, 500.0)[1].round(decimals=6)
        tensor([   0., 1000.,  500.], dtype=torch.float64)
    """
    number = torch.arange(cameras, dtype=torch.float64)
    if shape == "row":
        x = radius * (2 * number / max(cameras - 1, 1) - 1) if cameras > 1 else torch.zeros(1, dtype=torch.float64)
        return torch.stack((x, torch.zeros_like(x), torch.full_like(x, height)), dim=-1)
    up = (number + 0.5) / cameras if shape == "dome" else torch.zeros_like(number)
    angle = number * (GOLDEN_ANGLE if shape == "dome" else 2 * math.pi / cameras)
    out = radius * (1 - up.square()).sqrt()
    return torch.stack((out * angle.cos(), out * angle.sin(), height + radius * up), dim=-1)


def arrange_rig(
    shape: Shape,
    cameras: int,
    radius: float,
    *,
    height: float = 0.0,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    lens: Lens = Lens(),
    volume: ConvexVolume | None = None,
    prior: RigPrior | None = None,
    name: str | None = None,
) -> CameraRig:
    """Make a rig of equal cameras that all look at one point.

    Args:
        shape: ring, dome or row; see `arrange_positions`.
        cameras: how many.
        radius: mm.
        height: mm.
        target: mm, in the rig frame, whose z axis is up.
        lens: of every camera.
        volume: where it is used; None = a cube about the target, as wide as half the distance of the nearest camera,
            and not below z = 0 where the target is above.
        prior: what is known of its values; None = the defaults.
        name: None = the shape and the number of cameras.

    Raises:
        InputError: no camera or too many; a radius that is not positive; a length of more than a kilometre; a camera at
            the target.

    Examples:
        >>> rig = arrange_rig("ring", 8, 4000.0, height=2500.0, target=(0.0, 0.0, 1000.0))
        >>> rig.name, rig.num_cameras, rig.volume.low
        ('ring8', 8, (-1068.0..., -1068.0..., 0.0))
    """
    if not 1 <= cameras <= limits.MOST_CAMERAS:
        raise InputError(f"cameras: found {cameras}, expected 1 to {limits.MOST_CAMERAS}")
    if not 1e-3 <= radius <= 1e6:
        raise InputError(f"radius: found {radius:g}, expected 0.001 to 1e+06 mm")
    for what, values in (("height", (height,)), ("target", target)):
        if not all(abs(value) <= 1e6 for value in values):
            raise InputError(f"{what}: found {' '.join(f'{v:g}' for v in values)}, expected -1e+06 to 1e+06 mm")
    positions, middle = arrange_positions(shape, cameras, radius, height), torch.tensor(target, dtype=torch.float64)
    cam_from_rig = look_at(positions, middle)
    if volume is None:
        reach = USED / 2 * float((positions - middle).norm(dim=-1).min())
        (x, y, z), floor = target, 0.0 if target[2] > 0 else -math.inf
        volume = ConvexVolume.box((x - reach, y - reach, max(z - reach, floor)), (x + reach, y + reach, z + reach))
    digits = len(str(cameras))
    return CameraRig(
        focal_length=torch.full((cameras, 2), lens.focal_length, dtype=torch.float64),
        principal_point=torch.tensor(lens.principal_point, dtype=torch.float64).repeat(cameras, 1),
        distortion=torch.zeros(cameras, 5, dtype=torch.float64),
        cam_from_rig=cam_from_rig,
        image_size=torch.tensor(lens.image_size).repeat(cameras, 1),
        camera_names=tuple(f"cam{number + 1:0{max(digits, 2)}d}" for number in range(cameras)),
        name=name or f"{shape}{cameras}",
        prior=prior,
        volume=volume,
    )

"""Objects carried through a working volume: poses anywhere in it, or the smooth path of a hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.synthesis.captures import Motion, Truth
from imgcal.synthesis.hand_held import HandHeld
from imgcal.synthesis.rigs import Drift
from imgcal.types import CalibrationObject, CameraRig, ConvexVolume
from renderers import palette

Floats = NDArray[np.float64]

BODY = 0.3
"""Side of a body with markers, in parts of the volume's shortest side, or of the working distance."""
MOMENT = 1e-3
"""Seconds between the two poses whose difference is the velocity."""
DEPTHS = (0.3, 10.0)
"""Where a volume is searched for if no file gives one: depths in parts of the largest distance between two cameras."""
DRAWS = 20_000
TURNS = 1.5
"""Radians, standard deviation of each component of the rotation vectors between which an object turns."""
TRIALS, FINE = 64, 16
"""Controls of the spline whose speed is measured, and steps from control to control."""
MOST_CONTROLS = 1_000_000
OUTER = 0.05
"""Share of what is seen that is left out at each side of a volume that is looked for."""


def sample_path(
    hand: HandHeld, volume: ConvexVolume, count: int, generator: torch.Generator
) -> tuple[RigidTransform, Motion]:
    """Draw a path through a volume and sample it.

    Returns:
        rig_from_object (S,) of an object with its centroid in the origin, in each of `count` snapshots, and its
        motion there.
    """
    duration = (count - 1) / hand.rate

    def draw_turns(number: int) -> Floats:
        return TURNS * torch.randn(number, 3, generator=generator, dtype=torch.float64).numpy()

    places = _spline(lambda number: sample_volume(volume, number, generator).numpy(), _lengths, hand.speed, duration)
    turns = _spline(draw_turns, _angles, math.radians(hand.turning), duration)
    times = np.arange(count) / hand.rate

    def at(times: Floats) -> RigidTransform:
        rotation = Rotation.from_rotvec(turns(times)).as_matrix()
        return RigidTransform(torch.from_numpy(rotation), torch.from_numpy(places(times)))

    return at(times), Motion(at(times - MOMENT / 2), at(times + MOMENT / 2), MOMENT)


def simulate_volume(
    rig: CameraRig,
    obj: CalibrationObject,
    snapshots: int,
    generator: torch.Generator,
    drift: Drift | None,
    *,
    volume: ConvexVolume | None = None,
    hand: HandHeld | None = None,
) -> Truth:
    """Disturb the rig once, then carry the object through a volume: a wand in a room, seen by some cameras at a time.

    Args:
        rig: the factory rig, without batch axes.
        obj: the calibration object; its centroid stays in the volume.
        snapshots: number of poses, S.
        generator: source of randomness.
        drift: how the parameters differ from the factory's; None = not at all.
        volume: where; None = the rig's own, or what its cameras see together.
        hand: how it is carried; None = places even in the volume, orientations even over all rotations.

    Raises:
        InputError: the rig has no volume, and none can be found.

    Examples:
        >>> import imgcal
        >>> room, wand = imgcal.load_rig("room10"), imgcal.load_object("wand4")
        >>> truth = simulate_volume(room, wand, 5, torch.Generator().manual_seed(0), None, hand=HandHeld())
        >>> truth.uv.shape, truth.motion is not None
        (torch.Size([5, 10, 4, 2]), True)
    """
    true_rig = rig if drift is None else drift.apply(rig, generator)
    volume = volume or rig.volume or find_seen_volume(rig)
    points = obj.points.to(rig.focal_length)
    centroid = points.mean(0)
    motion: Motion | None = None
    if hand is None:
        places = sample_volume(volume, snapshots, generator)
        quaternion = torch.randn(snapshots, 4, generator=generator, dtype=torch.float64)
        poses = RigidTransform(torch.from_numpy(Rotation.from_quat(quaternion.numpy()).as_matrix()), places)
    else:
        poses, motion = sample_path(hand, volume, snapshots, generator)
        motion = replace(motion, before=_about(centroid, motion.before), after=_about(centroid, motion.after))
    poses = _about(centroid, poses)
    seen = true_rig.expand(snapshots).project(poses.apply(points), obj.radius)
    return Truth(true_rig, poses, seen.uv, seen.visible, motion)


def place_markers(rig: CameraRig, count: int, generator: torch.Generator) -> CalibrationObject:
    """Put markers on a body, anywhere within a box that fits the rig: a stand-in for markers that were never measured.

    Args:
        rig: has a volume, or a working distance, or cameras that see the same.
        count: number of markers, N.
        generator: source of randomness.

    Examples:
        >>> import imgcal
        >>> body = place_markers(imgcal.load_rig("room10"), 15, torch.Generator().manual_seed(0))
        >>> body.num_fiducials, float(body.points.abs().max()) < 500  # mm
        (15, True)
    """
    if rig.volume is None and rig.working_distance is not None:
        side = BODY * rig.working_distance
    else:
        volume = rig.volume or find_seen_volume(rig)
        side = BODY * min(b - a for a, b in zip(volume.low, volume.high, strict=True))
    unit = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return CalibrationObject((unit - 0.5) * side, palette(count).double(), name="body")


def sample_volume(volume: ConvexVolume, count: int, generator: torch.Generator) -> Tensor:
    """Draw places evenly over a volume: (count, 3) mm, float64.

    Examples:
        >>> box = ConvexVolume.box((0, 0, 0), (10, 10, 10))
        >>> sample_volume(box, 5, torch.Generator().manual_seed(0)).shape
        torch.Size([5, 3])
    """
    corners = torch.tensor((volume.low, volume.high), dtype=torch.float64)

    def draw_in_box(number: int) -> Tensor:
        unit = torch.rand(number, 3, generator=generator, dtype=torch.float64)
        return torch.lerp(corners[0], corners[1], unit)

    if volume.is_box:
        return draw_in_box(count)
    found = torch.empty(0, 3, dtype=torch.float64)
    while len(found) < count:
        places = draw_in_box(max(2 * (count - len(found)), 64))
        found = torch.cat((found, places[torch.from_numpy(volume.contains(places.numpy()))]))
    return found[:count]


def find_seen_volume(rig: CameraRig) -> ConvexVolume:
    """Find a volume for a rig whose file gives none: a box about what most of its cameras see together.

    Raises:
        InputError: there is one camera only, or no two see the same.

    Examples:
        >>> import imgcal
        >>> box = find_seen_volume(imgcal.load_rig("T4"))
        >>> 0 < box.low[2] < box.high[2]
        True
    """
    positions = rig.positions.double()
    apart = float(torch.cdist(positions, positions).max())
    if not apart > 0:
        raise InputError(f"rig {rig.name}: found no volume, expected the key `volume` (or `working_distance`), in mm")
    draws = torch.rand(DRAWS, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    camera = (draws[:, 0] * rig.num_cameras).long()
    depth = apart * DEPTHS[0] * (DEPTHS[1] / DEPTHS[0]) ** draws[:, 1:2]
    pixel = draws[:, 2:] * rig.image_size[camera]
    rays = (pixel - rig.principal_point[camera]) / rig.focal_length[camera]
    there = torch.cat((rays * depth, depth), dim=-1) - rig.cam_from_rig.translation[camera]
    places = torch.einsum("pji,pj->pi", rig.cam_from_rig.rotation[camera].double(), there)
    seen = rig.to(torch.float64).project(places).visible.sum(0)
    most = int(seen.max())
    if most < 2:
        raise InputError(f"rig {rig.name}: found no two cameras with a common view, expected the key `volume`, in mm")
    together = places[seen >= max(2, (most + 1) // 2)]
    low, high = torch.quantile(together, torch.tensor([OUTER, 1 - OUTER], dtype=torch.float64), dim=0).tolist()
    return ConvexVolume.box(tuple(low), tuple(high))


def _about(centroid: Tensor, poses: RigidTransform) -> RigidTransform:
    """Poses (S,) that put an object's centroid where these put the origin."""
    rotation, places = poses.rotation.to(centroid), poses.translation.to(centroid)
    return RigidTransform(rotation, places - rotation @ centroid)


def _lengths(places: Floats) -> Floats:
    """Distances from place to place: (M, 3) -> (M - 1,)."""
    return np.asarray(np.linalg.norm(np.diff(places, axis=0), axis=1))


def _angles(turns: Floats) -> Floats:
    """Angles from one rotation vector to the next: (M, 3) -> (M - 1,) rad."""
    rotations = Rotation.from_rotvec(turns)
    return np.asarray((rotations[1:] * rotations[:-1].inv()).magnitude())


def _spline(
    draw: Callable[[int], Floats], steps: Callable[[Floats], Floats], speed: float, duration: float
) -> Callable[[Floats], Floats]:
    """A cubic B-spline between random controls, over `duration` seconds, at a mean speed.

    Args:
        draw: gives controls (M, 3).
        steps: lengths of the way from each of some points (M, 3) to the next: (M - 1,).
        speed: in the unit of the steps, a second.
        duration: seconds.
    """
    trial = BSpline(np.arange(TRIALS + 4) - 3.0, draw(TRIALS), 3)
    way = float(steps(trial(np.linspace(0, TRIALS - 3, FINE * (TRIALS - 3)))).sum()) / (TRIALS - 3)
    interval = way / speed  # seconds from control to control
    count = min(math.ceil(duration / interval), MOST_CONTROLS) + 5
    curve = BSpline(np.arange(count + 4) - 3.0, draw(count), 3)
    return lambda times: np.asarray(curve(times / interval + 0.5))

"""Dynamic camera pose synthesis: random rig poses on a hemisphere, drifted parameters, visibility check.

Source: paper section 4.1. Random numbers come from an explicit `torch.Generator`, whose device is where all runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import torch
from pydantic import BeforeValidator, Field, TypeAdapter
from torch import Tensor

from imgcal.errors import InputError, RefusedError
from imgcal.geometry import Projection, RigidTransform, euler_from_rotation, rotate, rotation_from_euler
from imgcal.io import StrictRecord
from imgcal.messages import shorten
from imgcal.synthesis.physical_drift import PhysicalDrift
from imgcal.types import CalibrationObject, CameraRig

Angle = Annotated[float, Field(ge=-360, le=360)]
Kappa = Annotated[float, Field(ge=0, lt=1)]


def _pair(values: Any) -> Any:
    """Convert a list, as files have it, to a tuple."""
    if isinstance(values, list | tuple) and len(values) != 2:
        raise ValueError(f"found {len(values)} values, expected 2")
    return tuple(values) if isinstance(values, list) else values


Interval = Annotated[tuple[Angle, Angle], BeforeValidator(_pair)]


@dataclass(frozen=True)
class PoseRange(StrictRecord):
    """Where the rig may be: on the hemisphere around the object, looking at it, rolled about its axis.

    In degrees, the smaller angle first. It is also the block `poses` of an experiment file.

    Examples:
        >>> PoseRange(phi_deg=(0.0, 60.0)).phi_deg
        (0.0, 60.0)
        >>> PoseRange.overhead().phi_deg
        (0.0, 0.0)
    """

    theta_deg: Interval = (0.0, 360.0)  # azimuth
    phi_deg: Interval = (0.0, 90.0)  # angle from the zenith
    alpha_deg: Interval = (0.0, 360.0)  # roll

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (low, high) in vars(self).items():
            if low > high:
                raise InputError(f"{name}: found [{low:g}, {high:g}], expected the smaller angle first")

    @property
    def radians(self) -> tuple[tuple[float, float], ...]:
        """Limits of theta, phi and alpha in rad."""
        return tuple((math.radians(low), math.radians(high)) for low, high in vars(self).values())

    @classmethod
    def overhead(cls) -> PoseRange:
        """Stay at the zenith with any roll: the paper's "fixed overhead" rows."""
        return cls(theta_deg=(0.0, 0.0), phi_deg=(0.0, 0.0))


@dataclass(frozen=True)
class RelativeDrift(StrictRecord):
    """The paper's perturbation: every value times 1 + delta, delta uniform in [-kappa, kappa]; 0.025 is 2.5 %.

    Examples:
        >>> import imgcal
        >>> rig = imgcal.load_rig("T4")
        >>> drifted = RelativeDrift(0.025, 0.025).apply(rig, torch.Generator().manual_seed(0))
        >>> bool(((drifted.focal_length / rig.focal_length - 1).abs() <= 0.025).all())
        True
    """

    kappa_intrinsics: Kappa = 0.025  # of focal lengths, principal points, distortion; not named in a file = none
    kappa_extrinsics: Kappa = 0.025  # of Euler angles and positions; not named in a file = none

    def apply(self, rig: CameraRig, generator: torch.Generator, *batch: int) -> CameraRig:
        """Disturb focal lengths, principal points, distortion; Euler angles and positions of the cameras in the rig.

        Returns:
            (*batch, *B) rigs, each disturbed on its own.
        """
        draws = _parameters_first(torch.rand, rig, generator, batch)
        extrinsics = draws[..., :6] * (2 * self.kappa_extrinsics) + (1 - self.kappa_extrinsics)
        intrinsics = draws[..., 6:] * (2 * self.kappa_intrinsics) + (1 - self.kappa_intrinsics)
        angles = extrinsics[..., 0:3] * euler_from_rotation(rig.cam_from_rig.rotation)
        positions = extrinsics[..., 3:6] * rig.positions
        rotation = rotation_from_euler(angles)
        return replace(
            rig,
            focal_length=intrinsics[..., 0:2] * rig.focal_length,
            principal_point=intrinsics[..., 2:4] * rig.principal_point,
            distortion=intrinsics[..., 4:] * rig.distortion,
            cam_from_rig=RigidTransform(rotation, -rotate(rotation, positions)),
        )

    def std(self, rig: CameraRig) -> Tensor:
        """Standard deviation of each parameter under this drift: (*B, C, 15), to first order in kappa."""
        uniform = 1 / math.sqrt(3)
        k_int, k_ext = self.kappa_intrinsics * uniform, self.kappa_extrinsics * uniform
        a, b, c = euler_from_rotation(rig.cam_from_rig.rotation).unbind(-1)
        # d(rotation)/d(angles) as rotation vectors on the left of Rz(c) Ry(b) Rx(a).
        zero, one = torch.zeros_like(a), torch.ones_like(a)
        about_x = torch.stack((c.cos() * b.cos(), c.sin() * b.cos(), -b.sin()), -1) * a[..., None]
        about_y = torch.stack((-c.sin(), c.cos(), zero), -1) * b[..., None]
        about_z = torch.stack((zero, zero, one), -1) * c[..., None]
        rotation = (about_x.square() + about_y.square() + about_z.square()).sqrt()
        return torch.cat(
            (
                rotation * k_ext,
                rig.positions.abs() * k_ext,
                rig.focal_length * k_int,
                rig.principal_point * k_int,
                rig.distortion.abs() * k_int,
            ),
            dim=-1,
        )


def make_drift(block: Any) -> Any:
    """Make a drift from the block of an experiment file; values that are not named do not drift.

    Args:
        block: a mapping, or a drift, which is returned as it is.

    Raises:
        ValueError: kappas beside physical units, unknown keys or impossible values (pydantic's ValidationError).
    """
    if isinstance(block, RelativeDrift | PhysicalDrift):
        return block
    if not isinstance(block, Mapping):
        raise ValueError(f"found {shorten(repr(block))}, expected kappas or physical units by name")
    values = {name: value for name, value in block.items() if value is not None}
    named = sorted(map(str, values))
    relative = [name for name in named if name.startswith("kappa")]
    if relative and len(relative) < len(named):
        physical = next(name for name in named if name not in relative)
        raise ValueError(f"found {relative[0]} and {physical}, expected kappas or physical units, not both")
    kind = PhysicalDrift if named and not relative else RelativeDrift
    return TypeAdapter(kind).validate_python({field.name: 0.0 for field in fields(kind)} | values)


Drift = Annotated[RelativeDrift | PhysicalDrift, BeforeValidator(make_drift)]
"""A value in Python; in an experiment file the block `drift`."""


@dataclass(frozen=True)
class Snapshots:
    """Synthetic rigs, each with one view of the object."""

    rig: CameraRig  # (B,) drifted rigs
    rig_from_object: RigidTransform  # (B,)
    projection: Projection  # (B, C, N)


@torch.no_grad()
def synthesize(
    rig: CameraRig,
    obj: CalibrationObject,
    count: int,
    generator: torch.Generator,
    *,
    drift: Drift | None = RelativeDrift(),
    pose_range: PoseRange = PoseRange(),
    max_rounds: int = 100,
) -> Snapshots:
    """Make exactly `count` random rigs that see every fiducial in every camera.

    Args:
        rig: the factory rig, without batch axes; device and dtype come from it.
        obj: the calibration object; its centroid is put on the rig's axis at the working distance.
        count: number of rigs, B.
        generator: source of randomness, on the rig's device.
        drift: how the parameters differ from the factory's; None = not at all.
        pose_range: where the rig may be.
        max_rounds: rounds of rejection before giving up.

    Raises:
        RefusedError: too few random rigs see everything; the message names the camera that fails most.

    Source: paper section 4.1: hemisphere point, R_focus, R_random, perturbation, visibility check.

    Examples:
        >>> import imgcal
        >>> rig, obj = imgcal.load_rig("O10").to(torch.float32), imgcal.load_object("cube8")
        >>> snapshots = synthesize(rig, obj, 16, torch.Generator().manual_seed(0))
        >>> snapshots.projection.uv.shape, bool(snapshots.projection.visible.all())
        (torch.Size([16, 10, 8, 2]), True)
    """
    kept: list[Snapshots] = []
    missing, tried, failures = count, 0, torch.zeros(rig.num_cameras, device=rig.focal_length.device)
    for _ in range(max_rounds):
        accepted = max(tried - int(failures.amax()), 1) / max(tried, 1)
        batch = count if not kept and not tried else min(math.ceil(1.2 * missing / accepted) + 8, 4 * count + 64)
        trial = _sample(rig, obj, batch, generator, drift, pose_range)
        seen = trial.projection.visible.all(-1)  # (B, C)
        good = seen.all(-1)
        found = int(good.sum())
        if found == batch and not kept and batch == count:
            return trial
        tried, failures = tried + batch, failures + (~seen).sum(0)
        kept.append(_take(trial, good.nonzero().squeeze(-1)[:missing]))
        missing -= min(found, missing)
        if missing == 0:
            return _concatenate(kept)
    worst = int(failures.argmax())
    raise RefusedError(
        f"synthesis: {count - missing} of {count} rigs after {tried} trials; camera {rig.camera_names[worst]} misses "
        f"part of object {obj.name} in {100 * float(failures[worst]) / tried:.0f} % of them: reduce the drift, the "
        "pose range or the object, or change the working distance"
    )


@torch.no_grad()
def synthesize_at_once(
    rig: CameraRig,
    obj: CalibrationObject,
    count: int,
    trials: int,
    generator: torch.Generator,
    *,
    drift: Drift | None = RelativeDrift(),
    pose_range: PoseRange = PoseRange(),
) -> Snapshots:
    """Make `count` random rigs as `synthesize` does, but never wait for the device: the first good ones of `trials`.

    Where fewer see every fiducial in every camera, those that do come again; where none does, rigs that miss some stay.

    Args:
        rig: the factory rig, without batch axes; device and dtype come from it.
        obj: the calibration object.
        count: number of rigs, B.
        trials: how many are tried; see `share_of_good_rigs`.
        generator: source of randomness, on the rig's device.
        drift: how the parameters differ from the factory's; None = not at all.
        pose_range: where the rig may be.
    """
    trial = _sample(rig, obj, trials, generator, drift, pose_range)
    good = trial.projection.visible.all(-1).all(-1)
    first = torch.argsort((~good).byte(), stable=True)
    return _take(trial, first[torch.arange(count, device=first.device) % good.sum().clamp_min(1)])


@torch.no_grad()
def share_of_good_rigs(
    rig: CameraRig, obj: CalibrationObject, generator: torch.Generator, *, drift: Drift, pose_range: PoseRange
) -> float:
    """Estimate, from 1024, how many random rigs see every fiducial in every camera: 0 to 1."""
    trial = _sample(rig, obj, 1024, generator, drift, pose_range)
    return float(trial.projection.visible.all(-1).all(-1).float().mean())


def sample_rig_from_object(
    count: int, working_distance: float, centroid: Tensor, pose_range: PoseRange, generator: torch.Generator
) -> RigidTransform:
    """Sample poses of an object seen from a rig on a hemisphere around it.

    Args:
        count: number of poses, B.
        working_distance: mm from the rig's origin to the object's centroid.
        centroid: (3,) mm in the object's frame; gives dtype and device.
        pose_range: where the rig may be.
        generator: source of randomness.

    Returns:
        (B,) rig_from_object: the object's centroid at (0, 0, working_distance), R_focus, then the roll R_random.
    """
    draws = torch.rand((3, count), generator=generator, dtype=centroid.dtype, device=centroid.device)
    low, high = centroid.new_tensor(pose_range.radians).unsqueeze(-2).unbind(-1)
    angles = torch.lerp(low, high, draws)
    (st, sp, sa), (ct, cp, ca) = angles.sin(), angles.cos()
    # R_random times R_focus, whose rows are the unit vectors of azimuth and zenith angle and the viewing direction.
    inward_x, inward_y = -sp * ct, -sp * st
    along_x, along_y = cp * ct, cp * st
    entries = (
        -ca * st - sa * along_x, ca * ct - sa * along_y, sa * sp,
        ca * along_x - sa * st, sa * ct + ca * along_y, -ca * sp,
        inward_x, inward_y, -cp,
    )  # fmt: skip
    rotation = torch.stack(entries, dim=-1).unflatten(-1, (3, 3))
    target = centroid.new_tensor((0.0, 0.0, working_distance))
    return RigidTransform(rotation, target - rotation @ centroid)


def _sample(
    rig: CameraRig,
    obj: CalibrationObject,
    count: int,
    generator: torch.Generator,
    drift: Drift | None,
    pose_range: PoseRange,
) -> Snapshots:
    if rig.working_distance is None:
        raise InputError(f"rig {rig.name}: found no working_distance, expected one (mm) to place the rig by")
    points, radius = obj.points.to(rig.focal_length), None if obj.radius is None else obj.radius.to(rig.focal_length)
    poses = sample_rig_from_object(count, rig.working_distance, points.mean(0), pose_range, generator)
    drifted = rig.expand(count) if drift is None else drift.apply(rig, generator, count)
    return Snapshots(drifted, poses, drifted.project_values(poses.apply(points), radius))


def _take(snapshots: Snapshots, rows: Tensor) -> Snapshots:
    projection = Projection(*(values[rows] for values in vars(snapshots.projection).values()))
    return Snapshots(snapshots.rig[rows], snapshots.rig_from_object[rows], projection)


def _concatenate(parts: list[Snapshots]) -> Snapshots:
    rig = CameraRig.cat([part.rig for part in parts])
    columns = zip(*(vars(part.projection).values() for part in parts), strict=True)
    projection = Projection(*map(torch.cat, columns))
    return Snapshots(rig, RigidTransform.cat([part.rig_from_object for part in parts]), projection)


def _parameters_first(
    draw: Callable[..., Tensor], rig: CameraRig, generator: torch.Generator, batch: tuple[int, ...]
) -> Tensor:
    """Draw a number for every parameter: (*batch, *B, C, 15), parameters first in memory, for long contiguous rows.

    Elementwise operations keep the memory order of their first operand.
    """
    like = rig.focal_length
    shape = (rig.num_parameters, *batch, *like.shape[:-1])
    return draw(shape, generator=generator, dtype=like.dtype, device=like.device).movedim(0, -1)

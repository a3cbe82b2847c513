"""Estimate an object's motion, to second order in time, from its poses in neighbouring snapshots."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.geometry import RigidTransform, rotation_from_vector, vector_from_rotation

AROUND = 7
"""Number of snapshots used to estimate the motion at one of them."""
REACH = 0.21
"""Usual number of seconds within which they must be: a hand changes direction within half a second. With room for the
rounding of times at 5 Hz."""
NOISE = (5e-4,) * 3 + (0.1,) * 3
"""Standard deviations of a pose (rad, mm) relative to its neighbours ..."""
FAST, SUDDEN = (10.0,) * 3 + (5e3,) * 3, (100.0,) * 3 + (2e4,) * 3
"""... and prior standard deviations of velocities (rad/s, mm/s) and accelerations (per second)."""


@dataclass(frozen=True)
class ObjectMotion:
    """An object's poses and motion at several times.

    Examples:
        >>> poses = RigidTransform(torch.eye(3).expand(4, 3, 3), torch.tensor([[0.0, 0.0, 9.0 * s] for s in range(4)]))
        >>> motion = ObjectMotion.of(poses, torch.arange(4) / 60)
        >>> motion.interpolate(torch.tensor([1.5 / 60, 4 / 60])).translation[:, 2].round(decimals=1)
        tensor([13.5000, 36.0000], dtype=torch.float64)
    """

    seconds: Tensor  # (S,) in ascending order
    rig_from_object: RigidTransform  # (S,)
    velocity: Tensor  # (S, 6) rad/s rotation, mm/s origin
    acceleration: Tensor  # (S, 6) the same per second
    known: Tensor  # (S,) bool: has enough neighbours

    @classmethod
    def of(cls, rig_from_object: RigidTransform, seconds: Tensor, reach: float = REACH) -> ObjectMotion:
        """Estimate the motion from poses (S,) at ascending times (S,) s, each from those within `reach` seconds."""
        count = len(seconds)
        wide = min(AROUND, count)
        first = (torch.arange(count) - wide // 2).clamp(0, count - wide)
        near = first[:, None] + torch.arange(wide)  # (S, W)
        after = (seconds[near] - seconds[:, None]).double()
        weight = (after.abs() <= reach).double()
        rotation, place = rig_from_object.rotation.double(), rig_from_object.translation.double()
        turned = vector_from_rotation(rotation[near] @ rotation[:, None].mT)
        way = torch.cat((turned, place[near] - place[:, None]), -1)  # (S, W, 6)
        noise, fast, sudden = (torch.tensor(values, dtype=torch.float64) for values in (NOISE, FAST, SUDDEN))
        unit = torch.stack((noise, fast, sudden), -1) / noise[:, None]  # (6, 3), in standard deviations of a pose
        design = torch.stack((torch.ones_like(after), after, after.square() / 2), -1)[:, :, None] * unit  # (S, W, 6, 3)
        weighted = weight[:, :, None, None] * design
        normal = torch.einsum("swik,swil->sikl", weighted, design) + torch.eye(3, dtype=torch.float64)
        right = torch.einsum("swik,swi->sik", weighted, way / noise)
        found = torch.linalg.solve(normal, right[..., None])[..., 0] * unit * noise[:, None]
        poses = RigidTransform(rotation, place)
        return cls(seconds.double(), poses, found[..., 1], found[..., 2], weight.sum(1) >= 2)

    def nearest(self, seconds: Tensor) -> Tensor:
        """Indices (M,) of the times nearest to some times (M,) s."""
        return (seconds.double()[:, None] - self.seconds).abs().argmin(1)

    def interpolate(self, seconds: Tensor) -> RigidTransform:
        """Poses of the object at some times (M,) s: (M,), each from the motion at the nearest known time."""
        near = self.nearest(seconds)
        passed = (seconds.double() - self.seconds[near])[:, None]
        way = self.velocity[near] * passed + self.acceleration[near] * (passed.square() / 2)
        start = self.rig_from_object[near]
        return RigidTransform(rotation_from_vector(way[:, :3]) @ start.rotation, start.translation + way[:, 3:])

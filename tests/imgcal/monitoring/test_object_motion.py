"""Where an object is between its snapshots, and shortly after the last one."""

import torch

from imgcal.geometry import RigidTransform, geodesic_angle, rotation_from_vector
from imgcal.monitoring import ObjectMotion


def waved(seconds: torch.Tensor) -> RigidTransform:
    turn = torch.stack((0.4 * torch.sin(2 * seconds), 0.3 * torch.cos(3 * seconds), 0.2 * seconds), -1)
    place = torch.stack((80 * torch.sin(3 * seconds), 60 * torch.cos(2 * seconds), 800 + 40 * seconds), -1)
    return RigidTransform(rotation_from_vector(turn), place)


def test_poses_between_and_after_snapshots_are_those_of_the_motion() -> None:
    seconds = torch.arange(20, dtype=torch.float64) / 60
    motion = ObjectMotion.of(waved(seconds), seconds)
    asked = torch.tensor([0.1, 0.1042, 19 / 60 + 0.0167], dtype=torch.float64)
    found, true = motion.interpolate(asked), waved(asked)
    assert (found.translation - true.translation).norm(dim=-1).max() < 0.05  # of 4 mm a snapshot
    assert geodesic_angle(found.rotation, true.rotation).max() < 3e-4
    assert bool(motion.known.all())


def test_snapshots_far_apart_tell_nothing_of_each_other() -> None:
    seconds = torch.tensor([0.0, 1.0, 2.0, 2.1], dtype=torch.float64)
    motion = ObjectMotion.of(waved(seconds), seconds)
    assert motion.known.tolist() == [False, False, True, True]
    assert float(motion.velocity[0].abs().max()) == 0.0

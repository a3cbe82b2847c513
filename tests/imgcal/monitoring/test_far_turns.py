"""Cameras that have turned far are placed anew."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import imgcal
from imgcal.errors import RefusedError
from imgcal.geometry import geodesic_angle
from imgcal.monitoring import RigBelief, absorb, far_turned_cameras
from imgcal.monitoring.case import Snapshot
from imgcal.monitoring.far_turns import place_cameras, resect_cameras
from imgcal.monitoring.measurement_update import stack_snapshots
from imgcal.monitoring.pending_change import free_anywhere, free_cameras
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CameraRig, Observations

NOISE = 0.1


def turned(roll: float) -> tuple[RigBelief, CameraRig, list[Snapshot]]:
    """The factory's belief, the rig whose second camera has been rolled (rad), and four snapshots of it."""
    factory, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(3)
    truth = simulate_truth(factory, obj, 4, generator, PhysicalDrift())
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[1, 2] = roll
    rig, poses = truth.rig.to(torch.float64).retract(step), truth.rig_from_object.to(torch.float64)
    uv = rig.expand(4).project_values(poses.apply(obj.points.double()), obj.radius).uv
    uv = uv + NOISE * torch.randn(uv.shape, generator=generator, dtype=torch.float64)
    seen = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), torch.ones_like(uv[..., 0]) > 0)
    return RigBelief.of_prior(factory, obj), rig, [(seen.of_snapshots([s]), poses[s : s + 1]) for s in range(4)]


def angle(rig: CameraRig, other: CameraRig) -> Tensor:
    return geodesic_angle(rig.cam_from_rig.rotation, other.cam_from_rig.rotation)


@pytest.mark.parametrize("degrees", [60.0, 135.0, 180.0])
@pytest.mark.parametrize("count", [1, 4])
def test_a_camera_that_has_turned_far_is_placed_where_the_snapshots_show_it(degrees: float, count: int) -> None:
    belief, rig, snapshots = turned(math.radians(degrees))
    placed = resect_cameras(belief, snapshots[:count], [1, 2])
    assert math.degrees(float(angle(placed, rig)[1])) < 5.0
    assert far_turned_cameras(belief, snapshots[:count], [1, 2]) == {1}
    moved = place_cameras(belief, placed, [1, 2])
    assert (angle(moved.rig, belief.rig)[[0, 2, 3]] == 0).all() and moved.factor is belief.factor
    result = absorb(free_anywhere(belief, [1], snapshots), *stack_snapshots(snapshots))
    assert result.chi2 < 2 * result.dof
    assert float((result.belief.rig.focal_length / rig.focal_length - 1).abs().max()) < 0.02


def test_a_rig_with_a_negative_focal_length_explains_nothing() -> None:
    belief, _, snapshots = turned(math.pi)
    with pytest.raises(RefusedError, match="impossible values"):
        absorb(free_cameras(belief, {1: None}, 600.0), *stack_snapshots(snapshots))


def test_a_camera_that_has_turned_a_little_stays_for_the_linear_step() -> None:
    belief, _, snapshots = turned(math.radians(10.0))
    assert far_turned_cameras(belief, snapshots, [1]) == set()
    assert place_cameras(belief, resect_cameras(belief, snapshots, [1]), [1]) is belief


def test_labels_that_give_no_pose_or_agree_with_none_place_no_camera() -> None:
    belief, _, snapshots = turned(math.pi)
    few = [(replace(one, seen=one.seen & (torch.arange(8) < 2)), pose) for one, pose in snapshots[:1]]
    wrong = [(replace(one, uv=one.uv.roll(1, 2)), pose) for one, pose in snapshots]
    for shown in (few, wrong, []):
        assert far_turned_cameras(belief, shown, [1]) == set()

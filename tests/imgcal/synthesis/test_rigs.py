"""Synthesis: exact counts, the paper's distributions, drift and its deviations, requests that cannot be met."""

import math
from dataclasses import replace

import pytest
import torch
from scipy import stats

from imgcal.errors import InputError, RefusedError
from imgcal.geometry import euler_from_rotation
from imgcal.synthesis import (
    Drift,
    PhysicalDrift,
    PoseRange,
    RelativeDrift,
    Snapshots,
    share_of_good_rigs,
    synthesize,
    synthesize_at_once,
)
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import CalibrationObject, CameraRig


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def larger(obj: CalibrationObject, factor: float) -> CalibrationObject:
    return replace(obj, points=obj.points * factor)


def count_of(snapshots: Snapshots) -> int:
    return len(snapshots.projection.uv)


@pytest.mark.parametrize("count", [0, 1, 3, 200])
@pytest.mark.parametrize("factor", [1.0, 2.6])
def test_exact_count_and_everything_visible(
    o10: CameraRig, asymmetric8: CalibrationObject, count: int, factor: float
) -> None:
    obj = larger(asymmetric8, factor)  # the larger one is seen whole by some of the rigs only
    snapshots = synthesize(o10, obj, count, seeded())
    assert count_of(snapshots) == count
    assert snapshots.rig.batch_shape == (count,)
    assert snapshots.projection.visible.all()
    again = snapshots.rig.project(snapshots.rig_from_object.apply(obj.points))
    torch.testing.assert_close(again.uv, snapshots.projection.uv, rtol=0, atol=1e-9)
    assert again.visible.all()


def test_rejection_happens(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    poses = sample_rig_from_object(500, 850.14, torch.zeros(3).double(), PoseRange(), seeded())
    visible = o10.project(poses.apply(larger(asymmetric8, 2.6).points)).visible.flatten(1).all(1)
    assert 0.1 < float(visible.double().mean()) < 0.9


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("drift", [RelativeDrift(), PhysicalDrift(), None])
def test_seeded(o10: CameraRig, asymmetric8: CalibrationObject, dtype: torch.dtype, drift: Drift | None) -> None:
    first, second, other = (synthesize(o10.to(dtype), asymmetric8, 7, seeded(seed), drift=drift) for seed in (3, 3, 4))
    assert first.projection.uv.dtype == dtype
    assert torch.equal(first.projection.uv, second.projection.uv)
    assert torch.equal(first.rig.cam_from_rig.rotation, second.rig.cam_from_rig.rotation)
    assert not torch.equal(first.projection.uv, other.projection.uv)


def test_rigs_are_on_the_hemisphere_and_look_at_the_object() -> None:
    centroid = torch.tensor([3.0, -20.0, 50.0], dtype=torch.float64)
    poses = sample_rig_from_object(4000, 850.14, centroid, PoseRange(), seeded())
    seen_at = poses.apply(centroid[None]).squeeze(1)
    torch.testing.assert_close(seen_at, torch.tensor([0.0, 0.0, 850.14]).double().expand_as(seen_at), rtol=0, atol=1e-4)
    torch.testing.assert_close(torch.linalg.det(poses.rotation), torch.ones(4000).double())
    place = poses.inverse().translation - centroid
    torch.testing.assert_close(place.norm(dim=-1), torch.full((4000,), 850.14).double())
    assert (place[:, 2] >= 0).all()
    # The paper draws both angles and the roll uniformly.
    x, y, z = (place / 850.14).unbind(-1)
    around = stats.uniform(-math.pi, 2 * math.pi).cdf
    assert stats.kstest(z.clamp(-1, 1).acos().numpy(), stats.uniform(0, math.pi / 2).cdf).pvalue > 0.01
    assert stats.kstest(torch.atan2(y, x).numpy(), around).pvalue > 0.01
    azimuth_axis = torch.stack((-y, x, torch.zeros_like(x)), dim=-1)
    in_rig = (poses.rotation @ azimuth_axis[..., None]).squeeze(-1)
    assert stats.kstest(torch.atan2(in_rig[:, 1], in_rig[:, 0]).numpy(), around).pvalue > 0.01


def test_pose_ranges() -> None:
    centroid = torch.zeros(3, dtype=torch.float64)
    narrow = PoseRange(theta_deg=(6.0, 12.0), phi_deg=(17.0, 23.0), alpha_deg=(57.0, 57.0))
    x, y, z = sample_rig_from_object(300, 1.0, centroid, narrow, seeded()).inverse().translation.unbind(-1)
    theta, phi = torch.atan2(y, x).rad2deg(), z.acos().rad2deg()
    assert theta.min() >= 6.0 and theta.max() <= 12.0
    assert phi.min() >= 17.0 and phi.max() <= 23.0
    overhead = sample_rig_from_object(50, 1.0, centroid, PoseRange.overhead(), seeded()).inverse().translation
    torch.testing.assert_close(overhead, torch.tensor([0.0, 0.0, 1.0]).double().expand(50, 3))


def test_roll_zero_leaves_the_azimuth_direction_on_the_x_axis() -> None:
    upright = PoseRange(theta_deg=(0.0, 0.0), phi_deg=(45.0, 45.0), alpha_deg=(0.0, 0.0))
    rotation = sample_rig_from_object(1, 1.0, torch.zeros(3).double(), upright, seeded()).rotation[0]
    h = math.sqrt(0.5)
    expected = torch.tensor([[0.0, 1.0, 0.0], [h, 0.0, -h], [-h, 0.0, -h]], dtype=torch.float64)
    torch.testing.assert_close(rotation, expected)


def test_relative_drift_stays_within_kappa(o10: CameraRig) -> None:
    drifted = RelativeDrift(0.05, 0.02).apply(o10, seeded(), 2000)
    angles = euler_from_rotation(drifted.cam_from_rig.rotation)
    pairs = (
        (drifted.focal_length, o10.focal_length, 0.05),
        (drifted.principal_point, o10.principal_point, 0.05),
        (drifted.distortion, o10.distortion, 0.05),
        (drifted.positions, o10.positions, 0.02),
        (angles, euler_from_rotation(o10.cam_from_rig.rotation), 0.02),
    )
    for values, factory, kappa in pairs:
        factory = factory.expand_as(values)
        nonzero = factory.abs() > 1e-6
        relative = (values[nonzero] / factory[nonzero] - 1).numpy() / kappa
        assert abs(relative).max() <= 1 + 1e-6
        assert stats.kstest(relative, stats.uniform(-1, 2).cdf).statistic < 0.01
        assert (values[~nonzero] - factory[~nonzero]).abs().max() < 1e-6 if (~nonzero).any() else True


@pytest.mark.parametrize("drift", [RelativeDrift(0.03, 0.01), PhysicalDrift(), RelativeDrift(0.02, 0.0)])
def test_standard_deviations_match_the_samples(o10: CameraRig, drift: Drift) -> None:
    drifted = drift.apply(o10, seeded(), 20000)
    steps = drifted.local(o10.expand(20000))
    expected = drift.std(o10)
    spread = steps.square().mean(0).sqrt()
    zero = expected < 1e-9
    assert spread[zero].max() < 1e-6 if zero.any() else True
    torch.testing.assert_close(spread[~zero], expected[~zero], rtol=0.03, atol=1e-9)


def test_drift_keeps_the_axes_of_the_rig(o10: CameraRig) -> None:
    for drift in (RelativeDrift(), PhysicalDrift()):
        rigs = drift.apply(o10, seeded(), 2, 3)
        assert rigs.batch_shape == (2, 3)
        assert drift.apply(rigs, seeded(), 4).batch_shape == (4, 2, 3)
        assert drift.apply(o10, seeded()).batch_shape == ()
        assert drift.std(rigs).shape == (2, 3, 10, 15)


def test_impossible_request_names_the_camera(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    blind = replace(o10, principal_point=o10.principal_point.clone())
    blind.principal_point[6] += 5000
    with pytest.raises(RefusedError, match=f"0 of 5 rigs.*camera {o10.camera_names[6]} .*100 %"):
        synthesize(blind, asymmetric8, 5, seeded(), max_rounds=3)


def test_rig_without_working_distance(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    with pytest.raises(InputError, match="working_distance"):
        synthesize(replace(o10, working_distance=None), asymmetric8, 5, seeded())


def test_bad_drift_is_refused() -> None:
    with pytest.raises(InputError, match="kappa_intrinsics"):
        RelativeDrift(kappa_intrinsics=1.5)
    with pytest.raises(InputError, match="position"):
        PhysicalDrift(position=math.nan)


def test_rigs_at_once_are_those_that_see_everything(o10, asymmetric8):
    """Drift is so large that most rigs miss something; the distribution is that of rejection."""
    kind = {"drift": RelativeDrift(0.3, 0.3)}
    share = share_of_good_rigs(o10, asymmetric8, seeded(), **kind, pose_range=PoseRange())
    assert 0.5 < share < 0.99
    made = synthesize_at_once(o10, asymmetric8, 64, 64 * 20, seeded(), **kind)
    assert made.projection.visible.all() and made.projection.uv.shape == (64, 10, 8, 2)
    assert len(made.rig.focal_length.unique(dim=0)) == 64
    again = synthesize_at_once(o10, asymmetric8, 64, 64 * 20, seeded(), **kind)
    assert torch.equal(made.projection.uv, again.projection.uv)
    many = synthesize_at_once(o10, asymmetric8, 2000, 40_000, seeded(1), **kind).rig.focal_length
    slow = synthesize(o10, asymmetric8, 2000, seeded(2), **kind).rig.focal_length
    scale = slow.std(0) / 2000**0.5
    assert ((many.mean(0) - slow.mean(0)).abs() < 6 * scale).all()


def test_too_few_trials_repeat_the_good_ones(o10, asymmetric8):
    made = synthesize_at_once(o10, asymmetric8, 30, 10, seeded(), drift=RelativeDrift(0.01, 0.01))
    assert made.projection.visible.all() and 1 <= len(made.rig.focal_length.unique(dim=0)) <= 10

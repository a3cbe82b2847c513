"""The compiled loop against the same in tensors."""

import math
from dataclasses import fields, replace

import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions, displace, error_between
from imgcal.geometry import rotation_from_vector
from imgcal.monitoring import MeasurementUpdate, RigBelief, absorb
from imgcal.monitoring.measurement_update_cpu import LARGE
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations
from scripts.results.runtime import ring
from tests.imgcal.monitoring.measurement_update_in_tensors import update_in_tensors

NOISE = 0.1


def scene(loose: bool, radius: bool, count: int = 5):
    """A belief, snapshots, and poses that are a little off."""
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    if loose:
        obj = replace(obj, tolerance=torch.full((8,), 0.3, dtype=torch.float64), scale_tolerance=1e-3)
    if radius:
        obj = replace(obj, radius=torch.full((8,), 8.0, dtype=torch.float64))
    generator = torch.Generator().manual_seed(5)
    truth = simulate_truth(factory, obj, count, generator, PhysicalDrift())
    uv = truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    uv[0, 1, 2] += 30.0  # a wrong label
    seen = torch.rand(uv.shape[:-1], generator=generator) > 0.1
    observations = Observations(uv, torch.full(seen.shape, NOISE, dtype=torch.float64), seen)
    return RigBelief.of_prior(factory, obj), observations, truth.rig_from_object


def same(first: MeasurementUpdate, second: MeasurementUpdate) -> None:
    unit = first.before.unit
    assert float((error_between(first.belief.rig, second.belief.rig) / unit).abs().max()) < 1e-4
    torch.testing.assert_close(first.belief.object_offset, second.belief.object_offset, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(first.belief.information, second.belief.information, rtol=1e-3, atol=1e-2)
    assert torch.equal(first.belief.factor, first.belief.factor.tril())
    torch.testing.assert_close(first.belief.factor @ first.belief.factor.mT, first.belief.information)
    for name in ("chi2", "dof", "evidence"):
        assert getattr(first, name) == pytest.approx(getattr(second, name), rel=1e-3, abs=1e-2)
    torch.testing.assert_close(first.residual, second.residual, rtol=0, atol=1e-3)
    torch.testing.assert_close(first.rig_from_object.rotation, second.rig_from_object.rotation, rtol=0, atol=1e-6)
    torch.testing.assert_close(first.rig_from_object.translation, second.rig_from_object.translation, rtol=0, atol=1e-3)
    brought, other = first.brought, second.brought
    assert float((error_between(brought.rig, other.rig) / unit).abs().max()) < 1e-4
    for entry in fields(brought):
        if entry.name in ("camera", "border", "carried", "pull"):
            found, expected = getattr(brought, entry.name), getattr(other, entry.name)
            scale = float(expected.abs().max()) if expected.numel() else 1.0
            torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * scale)


@pytest.mark.parametrize("loose", [False, True])
@pytest.mark.parametrize("radius", [False, True])
@pytest.mark.parametrize("loss", ["squared", "huber"])
def test_both_find_the_same(loose: bool, radius: bool, loss) -> None:
    belief, observations, poses = scene(loose, radius)
    options = EstimationOptions(loss=loss)
    first, second = (function(belief, observations, poses, options) for function in (absorb, update_in_tensors))
    same(first, second)
    later = tuple(x[:1] for x in (observations.uv, observations.sigma, observations.seen))
    again = (first.belief, Observations(*later), first.rig_from_object[:1], options)
    same(absorb(*again), update_in_tensors(*again))


def test_both_find_the_same_for_a_rig_with_so_many_cameras_that_lapack_factorizes() -> None:
    factory = ring(20)
    obj, generator = imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(4)
    truth = simulate_truth(factory, obj, 2, generator, PhysicalDrift())
    uv = truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    seen = torch.ones(uv.shape[:-1], dtype=torch.bool)
    observations = Observations(uv, torch.full(seen.shape, NOISE, dtype=torch.float64), seen)
    belief = RigBelief.of_prior(factory, obj)
    assert len(belief.factor) >= LARGE
    same(*(function(belief, observations, truth.rig_from_object) for function in (absorb, update_in_tensors)))
    broken = replace(belief, factor=belief.factor * math.nan)
    with pytest.raises(RefusedError, match="these observations"):
        absorb(broken, observations, truth.rig_from_object)


def test_both_refuse_a_snapshot_without_a_pose() -> None:
    belief, observations, poses = scene(False, False, 2)
    few = observations.seen.clone()
    few[1] = False
    for function in (absorb, update_in_tensors):
        with pytest.raises(RefusedError, match="do not determine the object's pose"):
            function(belief, replace(observations, seen=few), poses)


@pytest.mark.parametrize("loose", [False, True])
def test_a_shift_that_all_points_of_a_camera_share_is_weighed_by_its_covariance(loose: bool) -> None:
    belief, observations, poses = scene(loose, radius=True, count=1)
    observations.uv[0, 1, 2] -= 30.0
    shake = torch.tensor([[0.3, 0.0, 0.5, 0.1]], dtype=torch.float64)
    observations = replace(observations, uv=observations.uv + shake[..., None, None], shake=shake)
    result = absorb(belief, observations, poses, EstimationOptions(loss="squared", tolerance=1e-12))
    rig, wide, (seen,) = result.belief.rig, belief.unit.numel(), observations.seen

    def residual(values: torch.Tensor) -> torch.Tensor:
        """Change the rig, the object and its pose."""
        there = displace(rig, values[:wide].view(belief.unit.shape) * belief.unit)
        size = len(belief.object_offset)
        bent = replace(result.belief, object_offset=result.belief.object_offset + values[wide : wide + size])
        turn = rotation_from_vector(values[-6:-3])
        at = result.rig_from_object.rotation[0] @ bent.points_object.mT
        points = (turn @ at).mT + result.rig_from_object.translation[0] + values[-3:]
        image = there.project(points, belief.obj.radius).uv
        return (image - observations.uv[0])[seen].flatten()

    nothing = torch.zeros(wide + len(belief.object_offset) + 6, dtype=torch.float64)
    off, jacobian = residual(nothing), torch.autograd.functional.jacobian(residual, nothing)
    camera = seen.nonzero()[:, 0]
    shared = (camera[:, None] == camera).double() * shake[0, camera].square()
    covariance = torch.kron(shared + NOISE**2 * torch.eye(len(camera)), torch.eye(2)).double()
    weight = torch.linalg.inv(covariance)
    full = jacobian.mT @ weight @ jacobian
    expected = full[:-6, :-6] - full[:-6, -6:] @ torch.linalg.solve(full[-6:, -6:], full[-6:, :-6])
    scale = float(expected.abs().max())
    torch.testing.assert_close(result.brought.information(), expected, rtol=1e-3, atol=1e-5 * scale)
    gradient = jacobian.mT @ weight @ off
    assert float(gradient[-6:].abs().max()) < 1e-3 * float(full[-6:, -6:].diagonal().sqrt().max())
    torch.testing.assert_close(result.brought.pull[0], -gradient[:-6], rtol=1e-2, atol=1e-3 * scale**0.5)
    data = float(off @ weight @ off)
    change = torch.cat(((error_between(rig, belief.rig) / belief.unit).flatten(), result.belief.object_offset))
    known = float((belief.factor.mT @ change).square().sum())
    assert result.chi2 == pytest.approx(data + known, rel=1e-4)
    still = replace(observations, shake=None)
    plain = absorb(belief, still, poses, EstimationOptions(loss="squared"))
    assert torch.equal(result.residual.isfinite(), plain.residual.isfinite())
    weights = observations.seen.sum(-1) * (shake / NOISE).square()
    odds = 0.5 * (plain.chi2 - result.chi2) - float(weights.log1p().sum())
    known = plain.belief.half_log_determinant - result.belief.half_log_determinant
    assert result.evidence - plain.evidence == pytest.approx(odds + known, rel=1e-6)

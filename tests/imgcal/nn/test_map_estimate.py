"""The module against `imgcal.estimate`, its derivatives against differences, and under every transform."""

from dataclasses import replace

import pytest
import torch

from imgcal.estimation import EstimationOptions, estimate
from imgcal.nn import MapEstimate, ProjectRig
from imgcal.types import CameraRig, Observations
from tests.imgcal.lensed import KINDS, lensed

PRECISE = EstimationOptions(loss="squared", tolerance=1e-20)
SNAPSHOTS = 2


@pytest.fixture
def observe(rig, obj, poses, drifted):
    """Draw (*B, S) observations of drifted rigs, with noise, one in five not seen."""

    def draw(*batch: int, rig: CameraRig = rig) -> Observations:
        random = torch.Generator().manual_seed(3)
        truth = drifted(*batch, rig=rig).map_tensors(
            lambda x, axes: x.unsqueeze(-axes - 1).expand(*batch, SNAPSHOTS, *x.shape[-axes:])
        )
        uv = ProjectRig(obj)(truth, poses(*batch, SNAPSHOTS)).uv
        uv = uv + 0.1 * torch.randn(uv.shape, generator=random, dtype=uv.dtype)
        seen = torch.rand(uv.shape[:-1], generator=random) > 0.2
        return Observations(uv, torch.full(seen.shape, 0.1, dtype=uv.dtype), seen)

    return draw


def test_is_the_estimate(rig, obj, observe, batch, device, dtype):
    observations = observe(*batch)
    found = MapEstimate(rig, obj).to(device)(observations.to(dtype, device))
    expected = estimate(observations, rig, obj)
    assert found.rig.focal_length.shape == (*batch, 4, 2)
    assert found.rig_from_object.rotation.shape == (*batch, SNAPSHOTS, 3, 3)
    assert found.rig.focal_length.dtype == dtype
    assert found.converged.shape == found.chi2.shape == found.dof.shape == batch
    assert found.converged.all()
    loose = {"rtol": 1e-7, "atol": 1e-6} if dtype == torch.float64 else {"rtol": 1e-2, "atol": 0.3}
    for one, other in (
        (found.rig.focal_length, expected.rig.focal_length),
        (found.rig_from_object.translation, expected.rig_from_object.translation),
        (found.points_object, expected.points_object),
        (found.chi2, expected.chi2),
        (found.dof, expected.dof),
    ):
        torch.testing.assert_close(one.cpu().double(), other.double().expand_as(one), **loose)


def test_one_empty_snapshot_does_not_take_the_batch_down(rig, obj, observe):
    observations = observe(3)
    observations.seen[1, 0] = False
    found = MapEstimate(rig, obj)(observations)
    assert found.converged.tolist() == [True, False, True]
    assert found.rig.focal_length.isfinite().all()


def test_a_batch_may_be_empty(rig, obj, observe):
    found = MapEstimate(rig, obj)(observe(2).of_snapshots([]))
    assert found.rig.batch_shape == found.converged.shape == (0,)
    assert found.rig_from_object.translation.shape == (0, SNAPSHOTS, 3)


@pytest.mark.parametrize("lens", KINDS)
def test_takes_every_lens(rig, obj, observe, lens):
    factory = lensed(rig, lens)
    observations = observe(2, rig=factory)
    found, expected = MapEstimate(factory, obj)(observations), estimate(observations, factory, obj)
    assert found.converged.all() and found.rig.lens_models == factory.lens_models
    torch.testing.assert_close(found.rig.distortion, expected.rig.distortion, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.rig.focal_length, expected.rig.focal_length, rtol=1e-7, atol=1e-6)


def test_starts_where_it_is_told_and_takes_another_factory(rig, obj, observe, poses, drifted):
    observations, module = observe(3), MapEstimate(rig, obj, options=PRECISE)
    plain = module(observations)
    started = module(observations, rig_from_object=poses(3, SNAPSHOTS), initial_rig=drifted(3))
    torch.testing.assert_close(started.rig.focal_length, plain.rig.focal_length, rtol=0, atol=1e-4)
    other = drifted(seed=5)
    found = module(observations, factory=other, prior_std=module.prior_std / 2)
    expected = estimate(observations, other, obj, prior_std=module.prior_std / 2, options=PRECISE)
    torch.testing.assert_close(found.rig.focal_length, expected.rig.focal_length, rtol=0, atol=1e-4)


def test_the_object_is_estimated_where_it_has_tolerances(rig, obj, observe):
    loose = replace(obj, tolerance=torch.full((8,), 0.5, dtype=torch.float64), scale_tolerance=0.01)
    observations = observe(3)
    found, expected = MapEstimate(rig, loose)(observations), estimate(observations, rig, loose)
    assert (expected.points_object - obj.points).abs().max() > 1e-3
    torch.testing.assert_close(found.points_object, expected.points_object, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.chi2, expected.chi2)


def summary(solution) -> tuple[torch.Tensor, ...]:
    return solution.rig.focal_length, solution.rig.positions, solution.rig_from_object.translation, solution.chi2


def test_gradcheck(rig, obj, observe, batch):
    observations, module = observe(*batch), MapEstimate(rig, obj, options=PRECISE)
    scale = [x.abs().mean() for x in summary(module(observations))]

    def solve(shift, noise, zoom, width):
        """In pixels, and in shares of sigma, of the factory's focal length and of the prior_std."""
        given = Observations(observations.uv + shift, observations.sigma * (1 + noise), observations.seen)
        factory = replace(rig, focal_length=rig.focal_length * (1 + zoom))
        solution = module(given, factory, module.prior_std * (1 + width))
        return tuple(x / typical for x, typical in zip(summary(solution), scale, strict=True))

    nothing = [torch.zeros_like(x) for x in (observations.uv, observations.sigma, rig.focal_length, module.prior_std)]
    # The solver stops where pixels are rounded: smaller steps would see that.
    assert torch.autograd.gradcheck(
        solve,
        [x.requires_grad_() for x in nothing],
        fast_mode=True,
        check_forward_ad=True,
        eps=1e-3,
        atol=1e-5,
        rtol=1e-2,
    )


def test_graphs(rig, obj, observe, same_in_graphs):
    same_in_graphs(MapEstimate(rig, obj), observe(2))


def test_the_compiled_gradient_is_the_eager_one(rig, obj, observe):
    observations, module = observe(2), MapEstimate(rig, obj)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    leaf = observations.uv.requires_grad_()
    found, expected = (
        torch.autograd.grad(f(replace(observations, uv=leaf)).rig.focal_length.sum(), leaf)[0]
        for f in (compiled, module)
    )
    assert expected.abs().max() > 0
    torch.testing.assert_close(found, expected)


def test_vmap_and_jacobians(rig, obj, observe):
    observations, module = observe(3), MapEstimate(rig, obj)
    found, expected = torch.func.vmap(module)(observations), module(observations)
    for one, other in zip(summary(found), summary(expected), strict=True):
        torch.testing.assert_close(one, other)

    single = observe()

    def focal_length(prior_std):
        return module(single, prior_std=prior_std).rig.focal_length

    prior_std = module.prior_std
    forward, backward = (f(focal_length)(prior_std) for f in (torch.func.jacfwd, torch.func.jacrev))
    torch.testing.assert_close(forward, backward, rtol=1e-6, atol=1e-6)


def test_gradients_of_each_sample_by_a_rig(rig, obj, observe):
    module, observations = MapEstimate(rig, obj), observe(3)

    def loss(factory: CameraRig, observations: Observations) -> torch.Tensor:
        return module(observations, factory=factory).chi2

    found = torch.func.vmap(torch.func.grad(loss), (None, 0))(rig, observations).focal_length
    for i in range(3):
        leaf = rig.focal_length.clone().requires_grad_()
        given = Observations(observations.uv[i], observations.sigma[i], observations.seen[i])
        expected = torch.autograd.grad(loss(replace(rig, focal_length=leaf), given), leaf)[0]
        torch.testing.assert_close(found[i], expected, rtol=1e-6, atol=1e-9)

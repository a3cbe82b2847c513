import math
from dataclasses import replace

import pytest
import torch

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import read_rig
from imgcal.nn import project_fiducials, rms_per_axis
from imgcal.synthesis import RelativeDrift, synthesize
from imgcal.training.losses import (
    ExtraLoss,
    LossConfig,
    PaperLoss,
    RobustLoss,
    compound,
    distortion_size,
    focal_ratio,
    geodesic,
    inverse_focal,
    l1_norm,
    least_spread,
    log_cosh,
    offsets_error,
    parameter_rmse,
    principal_point_shift,
    reprojection_rmse,
)
from imgcal.types import PARAMETERS, Prediction, pack21
from tests.imgcal.lensed import KINDS, lensed

B, C, N = 3, 10, 8
DRIFT = RelativeDrift(0.02, 0.03)


@pytest.fixture(scope="module")
def truth(o10, asymmetric8) -> Prediction:
    made = synthesize(o10, asymmetric8, B, torch.Generator().manual_seed(1), drift=DRIFT)
    return Prediction(made.rig, made.rig_from_object)


@pytest.fixture(scope="module")
def prior_std(o10):
    return DRIFT.std(o10)


def off_by(truth: Prediction, step: torch.Tensor) -> Prediction:
    return replace(truth, rig=truth.rig.retract(step))


def steps(prior_std, seed=2):
    return torch.randn(B, C, PARAMETERS, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * prior_std


KINDS_OF_LOSS = [LossConfig(), LossConfig(kind="paper", paper=PaperLoss(reprojection_from=0))]


@pytest.mark.parametrize("config", KINDS_OF_LOSS, ids=["robust", "paper"])
def test_the_truth_costs_nothing_and_has_a_finite_gradient(truth, prior_std, asymmetric8, config):
    step = torch.zeros(B, C, PARAMETERS, dtype=torch.float64, requires_grad=True)
    loss = compound([off_by(truth, step)], truth, asymmetric8, config, 0, prior_std)
    loss.total.backward()
    assert loss.total < 1e-5
    assert loss.passes.shape == (1,) and loss.passes[0] < 1e-6
    assert step.grad.isfinite().all()


@pytest.mark.parametrize("config", KINDS_OF_LOSS, ids=["robust", "paper"])
def test_the_loss_compiles_into_one_graph_and_has_a_forward_derivative(truth, prior_std, asymmetric8, config):
    def loss(step):
        return compound([off_by(truth, step), truth], truth, asymmetric8, config, 0, prior_std).total

    step = steps(prior_std).requires_grad_()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(step)
    torch.testing.assert_close(compiled, loss(step))
    (expected,) = torch.autograd.grad(loss(step), step)
    torch.testing.assert_close(torch.autograd.grad(compiled, step)[0], expected)
    direction = steps(prior_std, seed=3)
    _, along = torch.func.jvp(loss, (step.detach(),), (direction,))
    torch.testing.assert_close(along, (expected * direction).sum())


def test_the_reprojection_gradient_reaches_every_parameter(truth, prior_std, asymmetric8):
    step = steps(prior_std).requires_grad_()
    difference = project_fiducials(off_by(truth, step).cameras_from_object, asymmetric8) - project_fiducials(
        truth.cameras_from_object, asymmetric8
    )
    reprojection_rmse(difference).backward()
    assert step.grad.isfinite().all()
    # Every camera, and each of rotation (3), position (3), focal length (2), principal point (2), distortion (5).
    assert (step.grad != 0).all()


def test_the_reprojection_gradient_reaches_the_object_pose(truth, asymmetric8):
    vector = torch.full((B, 3), 1e-2, dtype=torch.float64, requires_grad=True)
    shift = torch.ones(B, 3, dtype=torch.float64, requires_grad=True)
    pose = RigidTransform(rotation_from_vector(vector), shift) @ truth.rig_from_object
    cameras = truth.rig.from_object(pose)
    difference = project_fiducials(cameras, asymmetric8) - project_fiducials(truth.cameras_from_object, asymmetric8)
    rms_per_axis(difference).sum().backward()
    for grad in (vector.grad, shift.grad):
        assert grad.isfinite().all() and (grad != 0).all()


def test_projected_fiducials_are_those_of_the_rig(truth, asymmetric8):
    expected = truth.rig.project(truth.rig_from_object.apply(asymmetric8.points)).uv
    torch.testing.assert_close(project_fiducials(truth.cameras_from_object, asymmetric8), expected)


def test_projected_spheres_are_their_apparent_centres(truth, asymmetric8):
    spheres = replace(asymmetric8, radius=torch.linspace(2, 30, N, dtype=torch.float64))
    expected = truth.rig.project(truth.rig_from_object.apply(spheres.points), spheres.radius).uv
    torch.testing.assert_close(project_fiducials(truth.cameras_from_object, spheres), expected)


def test_re_is_the_mean_over_axes_cameras_and_fiducials():
    difference = torch.zeros(2, C, N, 2)
    difference[0, ..., 0] = 3.0  # every u off by 3: RE = 3 / sqrt(2)
    difference[1, 0, 0, 1] = 4.0
    expected = torch.tensor([3 / math.sqrt(2), 4 / math.sqrt(2 * C * N)])
    torch.testing.assert_close(rms_per_axis(difference), expected)
    torch.testing.assert_close(reprojection_rmse(difference), expected.square().mean().sqrt())


@pytest.mark.parametrize("lens", KINDS)
@pytest.mark.parametrize("config", KINDS_OF_LOSS, ids=["robust", "paper"])
def test_the_gradient_reaches_the_coefficients_that_each_lens_has(asymmetric8, lens, config):
    factory = lensed(read_rig("T4"), lens)
    made = synthesize(factory, asymmetric8, B, torch.Generator().manual_seed(1), drift=DRIFT)
    rigs, spread = Prediction(made.rig, made.rig_from_object), DRIFT.std(factory)
    seen = made.rig.project(made.rig_from_object.apply(asymmetric8.points)).uv
    torch.testing.assert_close(project_fiducials(rigs.cameras_from_object, asymmetric8), seen)  # kornia's and ours
    random = torch.Generator().manual_seed(2)
    step = (torch.randn(B, *spread.shape, generator=random, dtype=torch.float64) * spread).requires_grad_()
    loss = compound([off_by(rigs, step)], rigs, asymmetric8, config, 0, spread)
    loss.total.backward()
    assert torch.equal((step.grad[..., 10:] != 0).all(0), factory.has_coefficient)
    assert compound([rigs], rigs, asymmetric8, config, 0, spread).total < 1e-5


def test_gradcheck(truth, prior_std, asymmetric8):
    part = replace(truth, rig=truth.rig[:2], rig_from_object=truth.rig_from_object[:2])

    def total(step, config):
        return compound([off_by(part, step), off_by(part, 0.5 * step)], part, asymmetric8, config, 0, prior_std).total

    step = steps(prior_std)[:2].requires_grad_()
    for config in KINDS_OF_LOSS:
        assert torch.autograd.gradcheck(lambda s, c=config: total(s, c), step, eps=1e-7, atol=1e-3, rtol=1e-4)


def test_parameter_rmse_scales_rotation_and_distortion(truth):
    cameras = truth.cameras_from_object
    focal = replace(cameras, focal_length=cameras.focal_length + 2.0)
    lens = replace(cameras, distortion=cameras.distortion + 0.1)
    assert parameter_rmse(focal, cameras).item() == pytest.approx(2 * math.sqrt(2 / 21))
    assert parameter_rmse(lens, cameras).item() == pytest.approx(100 * math.sqrt(5 / 21))
    assert parameter_rmse(lens, cameras, lambda_scale=1.0).item() == pytest.approx(0.1 * math.sqrt(5 / 21))
    turned = replace(
        cameras,
        cam_from_rig=RigidTransform(
            rotation_from_vector(torch.tensor([0.0, 0.0, 1e-3], dtype=torch.float64)) @ cameras.cam_from_rig.rotation,
            cameras.cam_from_rig.translation,
        ),
    )
    # |R' - R|_F = 2 sqrt(2) sin(angle / 2)
    assert parameter_rmse(turned, cameras).item() == pytest.approx(math.sqrt(2 / 21), rel=1e-6)
    torch.testing.assert_close(geodesic(turned, cameras), torch.full((B, C), 1e-3, dtype=torch.float64))


def test_log_cosh_is_that(truth):
    cameras = truth.cameras_from_object
    other = replace(cameras, focal_length=cameras.focal_length + 3.0, distortion=cameras.distortion * 1.05)
    difference = (pack21(other) - pack21(cameras)).double()
    difference[..., 16:] *= 10
    expected = difference.cosh().log().mean()
    torch.testing.assert_close(log_cosh(other, cameras, lambda_scale=10.0), expected)
    far = replace(cameras, focal_length=cameras.focal_length + 1e6)
    assert log_cosh(far, cameras).isfinite()


def test_offsets_are_in_units_of_the_spread(truth, prior_std):
    free = prior_std > least_spread(prior_std)
    assert not free.all() and free.any()  # the ring's cameras have positions of about zero along z: no drift there
    step = (2.0 * prior_std * free).expand(B, -1, -1)
    torch.testing.assert_close(
        offsets_error(truth.rig.retract(step), truth.rig, prior_std, limit=10.0), torch.full((B,), 4.0).double()
    )
    assert offsets_error(truth.rig.retract(50 * step), truth.rig, prior_std, limit=3.0).max() <= 9.0
    fixed = (~free).double().expand(B, -1, -1)
    assert offsets_error(truth.rig.retract(fixed), truth.rig, prior_std, limit=10.0).max() < 1e-12
    assert (offsets_error(truth.rig, truth.rig, torch.zeros_like(prior_std), limit=10.0) == 0).all()


def test_regularizers(truth):
    rig = truth.rig
    plain = replace(rig, distortion=torch.full_like(rig.distortion, -0.1), focal_length=rig.focal_length * 0 + 500.0)
    assert distortion_size(plain).item() == pytest.approx(0.5)
    assert inverse_focal(plain).item() == pytest.approx(1e-3)
    assert focal_ratio(plain).item() == 0
    stretched = replace(plain, focal_length=plain.focal_length + torch.tensor([0.0, 3.0], dtype=torch.float64))
    assert focal_ratio(stretched).item() == pytest.approx(9.0)
    centred = replace(rig, principal_point=((rig.image_size - 1) / 2.0).double().expand(B, -1, -1))
    assert principal_point_shift(centred).item() == 0
    shifted = replace(centred, principal_point=centred.principal_point + 2.0)
    assert principal_point_shift(shifted).item() == pytest.approx(8.0)
    assert l1_norm([torch.tensor([1.0, -2.0]), torch.tensor([[3.0]])]).item() == 6.0


def test_every_extra_term_counts(truth, prior_std, asymmetric8):
    prediction, weights = off_by(truth, steps(prior_std)), [torch.ones(4, requires_grad=True)]

    def total(**extra):
        config = LossConfig(extra=ExtraLoss(**extra))
        return compound([prediction], truth, asymmetric8, config, 0, prior_std, weights).total.item()

    plain = total()
    for name in ExtraLoss.model_fields:
        assert total(**{name: 1.0}) > plain


def test_the_paper_begins_without_pixels_and_adds_their_rmse_in_its_second_stage(truth, prior_std, asymmetric8):
    """Principal points that are 3 and 4 px off move every fiducial by that, wherever it is."""
    shift = torch.tensor([3.0, 4.0], dtype=torch.float64)
    prediction = replace(truth, rig=replace(truth.rig, principal_point=truth.rig.principal_point + shift))
    other = replace(asymmetric8, points=0.5 * asymmetric8.points.flip(0))

    def total(step, obj=asymmetric8, weight=0.01):
        paper = PaperLoss(reprojection_from=100, lambda2=weight)
        return compound([prediction], truth, obj, LossConfig(kind="paper", paper=paper), step, prior_std).total.item()

    first = total(0)
    assert first > 0
    assert total(99) == total(99, weight=7.0) == total(99, other) == first
    assert total(100) == total(10**6)
    for weight in (0.01, 2.0):
        assert total(100, weight=weight) - first == pytest.approx(weight * math.sqrt((3**2 + 4**2) / 2))


def test_later_passes_weigh_more(truth, prior_std, asymmetric8):
    bad, good = off_by(truth, steps(prior_std)), off_by(truth, 0.01 * steps(prior_std))
    config = LossConfig(robust=RobustLoss(gamma=0.5))

    def total(*passes):
        return compound(passes, truth, asymmetric8, config, 0, prior_std)

    one, other = total(bad).total, total(good).total
    torch.testing.assert_close(total(bad, good).total, 0.5 * one + other)
    assert total(bad, good).passes[0] == total(bad).passes[0]


@pytest.mark.parametrize("config", KINDS_OF_LOSS, ids=["robust", "paper"])
def test_wild_predictions_keep_loss_and_gradient_finite_in_float32(truth, prior_std, asymmetric8, config):
    single = Prediction(truth.rig.to(torch.float32), truth.rig_from_object.to(torch.float32))
    for scale in (1e2, 1e5):
        step = (scale * steps(prior_std)).float().requires_grad_()
        loss = compound([off_by(single, step)], single, asymmetric8, config, 0, prior_std.float())
        loss.total.backward()
        assert loss.total.isfinite()
        assert step.grad.isfinite().all()


def test_geometry_stays_in_float32_under_autocast(truth, prior_std, asymmetric8):
    single = Prediction(truth.rig.to(torch.float32), truth.rig_from_object.to(torch.float32))
    prediction = off_by(single, 1e-3 * steps(prior_std).float())
    expected = compound([prediction], single, asymmetric8, LossConfig(), 0, prior_std.float())
    with torch.autocast("cpu", torch.bfloat16):
        found = compound([prediction], single, asymmetric8, LossConfig(), 0, prior_std.float())
    assert found.passes.dtype == torch.float32
    torch.testing.assert_close(found.passes, expected.passes)

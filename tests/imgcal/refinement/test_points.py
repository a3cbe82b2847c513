from dataclasses import replace

import pytest
import torch

from imgcal.estimation import EstimationOptions
from imgcal.refinement import refine_points
from imgcal.types import Prediction, Views


def found(estimate):
    return Prediction(estimate.rig, estimate.rig_from_object[:, 0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_exact_points_leave_hardly_any_error(o10_scene, dtype):
    scene = o10_scene
    guess = scene.guess(5.0).to(dtype)
    refined = refine_points(guess, Views(scene.truth.projection.uv), scene.factory, scene.obj, scene.prior_std, 0.01)
    assert bool(refined.converged.all()) and refined.rig.focal_length.dtype == torch.float64
    assert float(scene.error(found(refined)).max()) < 0.002


def test_swapped_labels_do_little_harm(o10_scene):
    scene = o10_scene
    uv = scene.truth.projection.uv + 0.1 * torch.randn(3, 10, 8, 2, generator=torch.Generator().manual_seed(2))
    swapped, right = uv.clone(), torch.ones(3, 10, 8, dtype=torch.bool)
    for camera, first, second in ((1, 0, 3), (4, 2, 7), (7, 1, 5), (9, 6, 4)):
        swapped[:, camera, [first, second]] = uv[:, camera, [second, first]]
        right[:, camera, [first, second]] = False
    given = scene.factory, scene.obj, scene.prior_std, 0.1
    best = refine_points(scene.guess(5.0), Views(uv, right), *given)
    robust = refine_points(scene.guess(5.0), Views(swapped), *given)
    assert float(scene.error(found(robust)).mean()) < 1.3 * float(scene.error(found(best)).mean())


def test_weights_and_what_is_not_seen(o6_scene):
    scene = o6_scene
    uv, sigma = scene.truth.projection.uv.clone(), torch.full((5, 6, 8), 0.05)
    uv[:, 2, 3], sigma[:, 2, 3] = 0.0, 1e6
    uv[:, 1, 5] = -7.0
    seen = torch.ones(5, 6, 8, dtype=torch.bool)
    seen[:, 1, 5] = False
    options = EstimationOptions(loss="squared")
    refined = refine_points(
        scene.guess(5.0), Views(uv, seen), scene.factory, scene.obj, scene.prior_std, sigma, options
    )
    assert float(scene.error(found(refined)).max()) < 0.05


@pytest.mark.parametrize("loss", ["squared", "cauchy"])
def test_gradient_by_points_and_weights_equals_finite_differences(o6_scene, loss):
    scene = o6_scene
    random = torch.Generator().manual_seed(4)
    guess = Prediction(scene.guess(3.0).rig[:2], scene.guess(3.0).rig_from_object[:2])
    noise = 0.3 * torch.randn(2, 6, 8, 2, generator=random, dtype=torch.float64)
    uv = (scene.truth.projection.uv[:2] + noise).requires_grad_()
    sigma = (0.2 + 0.2 * torch.rand(2, 6, 8, generator=random, dtype=torch.float64)).requires_grad_()
    options = EstimationOptions(loss=loss, tolerance=1e-14)
    truth = scene.truth.projection.uv[:2]

    def error(uv, sigma):
        refined = found(refine_points(guess, Views(uv), scene.factory, scene.obj, scene.prior_std, sigma, options))
        projected = refined.rig.project(refined.rig_from_object.apply(scene.obj.points)).uv
        return (projected - truth).square().sum()

    by_uv, by_sigma = torch.autograd.grad(error(uv, sigma), (uv, sigma))
    for value, gradient in ((uv, by_uv), (sigma, by_sigma)):
        along = torch.randn(value.shape, generator=random, dtype=torch.float64)
        with torch.no_grad():
            ends = [error(*(x + s * 1e-3 * along if x is value else x for x in (uv, sigma))) for s in (1, -1)]
        assert float((gradient * along).sum()) == pytest.approx(float((ends[0] - ends[1]) / 2e-3), rel=1e-4)


def test_gradient_leaves_the_prediction_alone(o6_scene):
    scene = o6_scene
    guess = scene.guess(3.0)
    focal = guess.rig.focal_length.clone().requires_grad_()
    guess = Prediction(replace(guess.rig, focal_length=focal), guess.rig_from_object)
    uv = scene.truth.projection.uv.clone().requires_grad_()
    refined = refine_points(guess, Views(uv), scene.factory, scene.obj, scene.prior_std, 0.1)
    refined.rig.focal_length.sum().backward()
    assert focal.grad is None and bool((uv.grad != 0).any())


def test_views_without_points_are_refused(o6_scene):
    scene = o6_scene
    with pytest.raises(ValueError, match="points"):
        refine_points(
            scene.guess(3.0), Views(images=torch.zeros(5, 6, 3, 8, 8)), scene.factory, scene.obj, scene.prior_std, 0.1
        )

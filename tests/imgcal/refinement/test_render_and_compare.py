from dataclasses import replace

import pytest
import torch

from imgcal.errors import InputError
from imgcal.estimation import camera_std, estimate
from imgcal.refinement import ImageRefinementOptions, refine_images
from imgcal.synthesis import ImageOptions, render_views
from imgcal.types import Prediction


def found(refined):
    return Prediction(refined.rig, refined.rig_from_object[:, 0])


def refine(scene, guess, images, options=ImageRefinementOptions()):
    return refine_images(guess, images, scene.factory, scene.obj, scene.prior_std, options)


@pytest.mark.parametrize("start", [10.0, 40.0])
@pytest.mark.parametrize("scene_name", ["o10_scene", "o6_scene"])
def test_8_bit_images_alone_give_a_twentieth_of_a_pixel(scene_name, start, request):
    scene = request.getfixturevalue(scene_name)
    guess = scene.guess(start)
    assert float(scene.error(guess).min()) > 0.8 * start
    refined, observations = refine(scene, guess.to(torch.float32), scene.images())
    assert bool(refined.converged.all()) and bool(observations.seen.all())
    assert refined.rig.focal_length.dtype == torch.float64
    assert float(scene.error(found(refined)).max()) < 0.05
    error = (observations.uv[:, 0] - scene.truth.projection.uv) / observations.sigma[:, 0, ..., None]
    assert 0.5 < float(error.square().mean().sqrt()) < 2
    assert 0.5 < float(refined.chi2_per_dof.mean()) < 2


def test_dots_that_are_missing_are_not_seen(o10_scene):
    scene = o10_scene
    drawn = torch.rand(3, 10, 8, generator=torch.Generator().manual_seed(8)) > 0.2
    refined, observations = refine(scene, scene.guess(10.0), scene.images(drawn))
    assert torch.equal(observations.seen[:, 0], drawn)
    assert bool(refined.converged.all())
    assert float(scene.error(found(refined)).median()) < 0.1


def test_what_images_do_not_confirm_has_not_converged(o6_scene):
    scene = o6_scene
    images = scene.images()
    images[0] = 0
    images[1] = torch.rand(images[1].shape, generator=torch.Generator().manual_seed(0))
    images[2, 1] = images[2, 4]
    guess = scene.guess(10.0)
    rotten = guess.rig.focal_length.clone()
    rotten[3] = torch.nan
    guess = Prediction(replace(guess.rig, focal_length=rotten), guess.rig_from_object)
    refined, _ = refine(scene, guess, images)
    assert refined.converged.tolist() == [False, False, False, False, True]
    assert float(scene.error(found(refined))[4]) < 0.05


def test_noise_of_positions_must_be_said(o6_scene):
    scene = o6_scene
    truth = scene.truth.projection.uv
    moved = truth + 0.2 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    images = scene.images(uv=moved)
    unsaid, _ = refine(scene, scene.guess(10.0), images)
    said, _ = refine(scene, scene.guess(10.0), images, ImageRefinementOptions(position_noise=0.2))
    assert not bool(unsaid.converged.any()) and float(unsaid.chi2_per_dof.min()) > 10
    assert bool(said.converged.all()) and 0.5 < float(said.chi2_per_dof.mean()) < 2


def test_rigs_and_cameras_do_not_depend_on_each_other(o6_scene):
    scene = o6_scene
    images, guess = scene.images(), scene.guess(20.0)
    together, _ = refine(scene, guess, images)
    alone, _ = refine(scene, Prediction(guess.rig[3:4], guess.rig_from_object[3:4]), images[3:4])
    torch.testing.assert_close(alone.rig.focal_length[0], together.rig.focal_length[3], rtol=1e-6, atol=0)
    order = [2, 0, 5, 3, 1, 4]
    permuted, _ = refine_images(
        Prediction(guess.rig.select(order), guess.rig_from_object),
        images[:, order],
        scene.factory.select(order),
        scene.obj,
        scene.prior_std[order],
    )
    torch.testing.assert_close(permuted.rig.focal_length, together.rig.focal_length[:, order], rtol=1e-6, atol=0)


def test_on_square_sensors_it_is_the_estimate_from_the_dots(o6_scene):
    scene = o6_scene
    square = torch.tensor([900, 900])
    factory = replace(scene.factory.resized(square), image_size=square.expand(6, 2))
    guess = scene.guess(10.0)
    guess = Prediction(guess.rig.resized(square), guess.rig_from_object)
    truth = scene.truth.rig.resized(square).project(scene.truth.rig_from_object.apply(scene.obj.points))
    options = ImageRefinementOptions(image=ImageOptions(size=160, dot=1.3))
    images = render_views(truth.uv.float(), truth.visible, factory.image_size, scene.obj, options.image, quantise=True)
    refined, observations = refine_images(guess, images, factory, scene.obj, scene.prior_std, options)
    direct = estimate(observations, factory, scene.obj, refined.rig_from_object, prior_std=scene.prior_std)
    torch.testing.assert_close(refined.rig.principal_point, direct.rig.principal_point, atol=1e-3, rtol=0)
    torch.testing.assert_close(camera_std(refined), camera_std(direct), rtol=1e-3, atol=1e-12)
    torch.testing.assert_close(refined.residual, direct.residual, atol=1e-4, rtol=0)
    torch.testing.assert_close(refined.rms, direct.rms, rtol=1e-2, atol=0)


@pytest.mark.parametrize("shape", [(5, 6, 3, 224, 160), (5, 4, 3, 224, 224), (6, 3, 224, 224)])
def test_images_of_another_shape_are_refused(shape, o6_scene):
    with pytest.raises(InputError, match="images: found shape"):
        refine(o6_scene, o6_scene.guess(5.0), torch.zeros(shape))


def test_pooling_must_divide_the_size(o6_scene):
    with pytest.raises(InputError, match="multiple"):
        options = ImageRefinementOptions(image=ImageOptions(size=90))
        refine(o6_scene, o6_scene.guess(5.0), torch.zeros(5, 6, 3, 90, 90), options)

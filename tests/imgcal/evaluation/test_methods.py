from dataclasses import replace

import pytest
import torch

from imgcal.evaluation import BASELINES, QUICK_BASELINES, errors, network_method, refine_by_positions
from imgcal.evaluation.methods import factory_from_pnp, keep_factory_rig, map_from_pnp, pnp, steps_from_factory
from imgcal.networks import Positions
from imgcal.synthesis import ImageOptions
from imgcal.types import Prediction
from tests.imgcal.evaluation.conftest import Fake, disturbed


def re(prediction, some):
    return errors(prediction, some.truth, some.conditions.obj).re


@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_finds_a_rig_that_has_not_drifted(sample, name):
    some = sample(3, kappa=0.0)
    assert (re(BASELINES[name].predict(some.given()), some) < 1e-2).all()


@pytest.mark.parametrize("name", ["scipy bundle adjustment", "MAP from PnP", "PnP + robust bundle adjustment"])
def test_estimates_of_the_whole_rig_reach_the_reference(sample, name):
    some = sample(4, noise=0.1)
    reference = some.reference().rig
    found = BASELINES[name].predict(some.given())
    assert torch.allclose(found.rig.focal_length, reference.focal_length, atol=0.3)
    assert torch.allclose(found.rig.positions, reference.positions, atol=0.3)


@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_survives_views_with_hardly_any_points(sample, name):
    some = sample(2, noise=0.1, rig="O10")
    some.corrupted.views.seen[0, 1, 2:] = False
    some.corrupted.views.seen[1, 3, :] = False
    found = BASELINES[name].predict(some.given())
    assert torch.isfinite(re(found, some)).all()


def test_steps_from_the_factory_begin_at_pnp_and_end_at_map(sample):
    some = sample(5, kappa=0.05, noise=0.1)
    given = some.given()
    ends = [errors(predict(given), some.truth, some.conditions.obj) for predict in (factory_from_pnp, map_from_pnp)]
    steps = [errors(steps_from_factory(n)(given), some.truth, some.conditions.obj) for n in (0, 1, 2, 5)]
    assert torch.allclose(steps[0].re, ends[0].re)
    assert torch.allclose(steps[-1].re, ends[1].re, atol=1e-3)
    assert (steps[1].re < 0.2 * steps[0].re).all()
    assert (steps[2].re < 2 * ends[1].re).all()
    assert torch.equal(factory_from_pnp(given).rig.focal_length[0], some.conditions.rig.focal_length)


def test_every_table_has_four_numbers_of_steps():
    names = [name for name in QUICK_BASELINES if "LM" in name]
    assert names == [f"{n} LM step{'' if n == 1 else 's'} from the factory" for n in (1, 2, 3, 5)]
    assert set(QUICK_BASELINES) < set(BASELINES)


def test_the_factory_rig_stays_as_it_is(sample):
    some = sample(3)
    found = keep_factory_rig(some.given())
    assert torch.equal(found.rig.distortion, some.conditions.rig.distortion.expand(3, 4, 5))
    # Fitting the pose is never worse than knowing it, as far as the image goes.
    true_pose = Prediction(some.conditions.rig.expand(3), some.truth.rig_from_object)
    assert (re(found, some) <= re(true_pose, some) + 1e-6).all()


def test_pnp_moves_each_camera_on_its_own(sample):
    some = sample(3)
    found = pnp(some.given()).cameras_from_object
    assert torch.allclose(found.focal_length, some.conditions.rig.focal_length.expand(3, 4, 2))
    assert (re(pnp(some.given()), some) < re(keep_factory_rig(some.given()), some)).all()


def test_opencv_with_eight_points_explains_them_all(sample):
    some = sample(3)
    found = BASELINES["OpenCV calibrateCamera per camera"].predict(some.given())
    assert (re(found, some) < 0.05).all()
    assert not torch.allclose(found.rig.focal_length, some.conditions.rig.focal_length.expand(3, 4, 2))


def test_unseen_points_do_not_matter(sample):
    some = sample(3, missing=0.2)
    given = some.given()
    elsewhere = replace(given.views, uv=torch.where(given.seen[..., None], given.uv, 77.0))
    for method in (map_from_pnp, pnp):
        first, second = method(given), method(replace(given, views=elsewhere))
        assert torch.equal(first.rig.focal_length, second.rig.focal_length)


def test_a_network_gets_single_precision_and_its_refinement_double(sample):
    some = sample(4)
    network = Fake(some.conditions)
    method = network_method(network)
    prediction = method.predict(some.given())
    assert network.calls == [torch.float32]
    assert prediction.rig.focal_length.dtype == torch.float64
    refined = method.refine(disturbed(some.truth, some.given().prior_std), some.given())
    assert refined.found.all()
    assert (re(refined.prediction, some) < 0.02).all()


def test_an_image_network_gets_images_that_are_drawn_once(sample):
    some, seen = sample(3, swapped=0.2), []

    class Looks(Fake):
        image_options = ImageOptions(size=32, dot=1.0)

        def forward(self, views):
            seen.append(views.images)
            return super().forward(replace(views, uv=views.images))

    method, given = network_method(Looks(some.conditions)), some.given()
    method.predict(given)
    method.predict(given)
    assert seen[0].shape == (3, 4, 3, 32, 32)
    assert seen[0] is seen[1]
    assert method.images == ImageOptions(size=32, dot=1.0)


def test_images_are_refined_by_render_and_compare(sample):
    some = sample(2)

    class Looks(Fake):
        image_options = ImageOptions()

    method = network_method(Looks(some.conditions))
    guess = disturbed(some.truth, some.given().prior_std, 0.05)
    assert (re(method.refine(guess, some.given()).prediction, some) < 0.2).all()
    assert (re(guess, some) > 0.2).all()


def test_sightings_are_refined_with_their_own_sigma(sample):
    """A wrong position counts little where a network says that it is unsure, and is outvoted where it says nothing."""
    some = sample(4)
    given = some.given()
    uv, sigma = given.uv.clone(), torch.full_like(given.uv[..., 0], 0.05)
    uv[:, 1, 3] += 40.0  # a stray
    uv[:, 2, 5] += 3.0
    sigma[:, 2, 5] = 5.0
    sightings = Positions(uv, sigma, given.seen.double())
    start = disturbed(some.truth, given.prior_std)
    found = refine_by_positions(start, sightings, given.factory, given.obj, given.prior_std)
    assert (re(found, some) < 0.1).all()


def test_a_refinement_that_fails_says_so(sample):
    some = sample(3)
    given = some.given()
    nowhere = 1000 * torch.rand(given.uv.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    contradicted = torch.cat((given.uv[:2], nowhere[2:]))
    guess = disturbed(some.truth, given.prior_std)
    points = network_method(Fake(some.conditions))
    assert points.refine(guess, replace(given, views=replace(given.views, uv=contradicted))).found.tolist() == [
        True, True, False,
    ]  # fmt: skip

    class Looks(Fake):
        image_options = ImageOptions(size=32, dot=1.0)

    given.drawn[Looks.image_options] = torch.zeros(3, 4, 3, 32, 32)  # nothing to be seen
    assert not network_method(Looks(some.conditions)).refine(guess, given).found.any()


def test_where_images_confirm_no_rig_positions_of_the_network_decide(sample, monkeypatch):
    some = sample(3)
    given = some.given()

    class Sees(Fake):
        image_options = ImageOptions(size=32, dot=1.0)

        def sight(self, images):
            return Positions(given.uv[: len(images)], torch.full_like(given.uv[..., 0], 0.05), given.seen.double())

    monkeypatch.setattr("imgcal.evaluation.methods.ImageNetwork", Sees)
    given.drawn[ImageOptions(size=32, dot=1.0)] = torch.zeros(3, 4, 3, 32, 32)  # nothing to be seen
    refined = network_method(Sees(some.conditions)).refine(disturbed(some.truth, given.prior_std), given)
    assert refined.found.all()
    assert (re(refined.prediction, some) < 0.05).all()

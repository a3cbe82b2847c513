from dataclasses import replace

import pytest
import torch

from imgcal.evaluation import errors
from imgcal.refinement import make_prediction, refine_robustly, robust_pose
from imgcal.refinement.graduated_non_convexity import Target, undo_label_swaps
from tests.imgcal.evaluation.conftest import disturbed


def refined(some, scale=0.05, rows=slice(None)):
    given = some.given(rows)
    guess = disturbed(some.truth, given.prior_std, scale)[rows]
    return refine_robustly(guess, given.views, given.factory, given.obj, given.prior_std, sigma=given.sigma)


def re(prediction, some):
    return errors(prediction, some.truth, some.conditions.obj).re


def test_without_outliers_it_is_the_map_estimate(sample):
    some = sample(6, noise=0.1)
    reference = make_prediction(some.reference())
    found = refined(some)
    assert torch.allclose(found.rig.focal_length, reference.rig.focal_length, atol=0.02)
    assert torch.allclose(re(found, some), re(reference, some), atol=1e-3)


def test_exact_points_give_an_exact_rig(sample):
    assert (re(refined(sample(6)), sample(6)) < 0.02).all()


def test_outliers_cost_nothing_because_swapped_labels_are_mended(sample):
    some = sample(60, rig="O10", noise=0.1, missing=0.2, swapped=0.1)
    reference = re(make_prediction(some.reference()), some)
    assert float(re(refined(some), some).median()) < 1.0 * float(reference.median())


def test_false_blobs_are_left_out(sample):
    some = sample(60, rig="O10", noise=0.1, false=0.1)
    reference = re(make_prediction(some.reference()), some)
    assert float(re(refined(some), some).median()) < 1.1 * float(reference.median())


def test_a_rig_does_not_depend_on_the_others_of_its_batch(sample):
    some = sample(7, rig="O10", noise=0.1, missing=0.2, swapped=0.1)
    together, alone = refined(some), refined(some, rows=slice(3, 4))
    assert torch.allclose(together.rig.focal_length[3], alone.rig.focal_length[0], atol=1e-6)


def test_mending_undoes_swaps_where_the_prediction_is_good(sample):
    exact, swapped = sample(20), sample(20, swapped=0.5)
    given = swapped.given()
    target = Target(given.uv, given.seen, given.factory, given.obj, given.prior_std, given.sigma)
    points = undo_label_swaps(swapped.truth, target, 10.0)
    assert not torch.equal(given.uv, exact.given().uv)
    assert torch.equal(points.uv, exact.given().uv)
    assert points.fits.all()
    assert points.seen.all()


def test_mending_gives_no_point_away_twice(sample):
    some = sample(20, noise=0.1, missing=0.3, swapped=0.5, false=0.2)
    given = some.given()
    target = Target(given.uv, given.seen, given.factory, given.obj, given.prior_std, given.sigma)
    for gate in (8.0, 1e3):
        points = undo_label_swaps(some.truth, target, gate)
        assert not (points.fits & ~points.seen).any()
        for before, seen, after, left in zip(
            *(value.flatten(0, 1) for value in (given.uv, given.seen, points.uv, points.seen)), strict=True
        ):
            source = (after[left][:, None] == before[seen][None]).all(-1)
            assert (source.sum(1) == 1).all()
            assert (source.sum(0) <= 1).all()


def test_a_pose_in_spite_of_outliers(sample):
    some = sample(40, rig="O10", noise=0.1, missing=0.2, swapped=0.1)
    given = some.given()
    found = robust_pose(given.views, given.factory, given.obj, given.sigma)
    assert torch.equal(found.rig.focal_length, given.factory.focal_length.expand_as(found.rig.focal_length))
    clean = sample(40, rig="O10").given()
    best = robust_pose(clean.views, clean.factory, clean.obj, 0.1)
    assert float(re(found, some).median()) < 1.1 * float(re(best, some).median())


@pytest.mark.parametrize("seen", [0, 2])
def test_a_blind_camera_keeps_what_the_prior_says(sample, seen):
    some = sample(4, noise=0.1, rig="O10")
    some.corrupted.views.seen[:, 2, seen:] = False
    some.corrupted.inlier[:, 2, seen:] = False
    found = refined(some)
    assert torch.isfinite(found.rig.focal_length).all()
    others = [camera for camera in range(10) if camera != 2]
    reference = make_prediction(some.reference())
    assert torch.allclose(found.rig.focal_length[:, others], reference.rig.focal_length[:, others], atol=0.1)


def test_points_that_a_network_does_not_trust_count_little(sample):
    exact = sample(4)
    views = exact.corrupted.views
    uv, log_sigma = views.uv.clone(), torch.zeros_like(views.uv[..., 0])
    uv[:, 1, 3] += 0.05
    log_sigma[:, 1, 3] = 5.0
    given = exact.given()
    errors_px = []
    for trust in (None, log_sigma):
        guess = replace(disturbed(exact.truth, given.prior_std, 0.05), log_sigma=trust)
        known = (replace(views, uv=uv), given.factory, given.obj, given.prior_std)
        errors_px.append(re(refine_robustly(guess, *known, sigma=0.02), exact))
    assert (errors_px[1] < 0.5 * errors_px[0]).all()

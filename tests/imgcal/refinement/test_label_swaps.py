import pytest
import torch

from imgcal.refinement import refine_images
from imgcal.refinement.render_and_compare import colours_at, find_swapped_labels
from imgcal.types import Prediction
from renderers import palette, splat


@pytest.mark.parametrize("apart", [12.0, 2.5])
def test_colours_of_places_are_found_even_of_dots_that_overlap(apart):
    colours = torch.tensor([[0.9, 0.1, 0.0], [0.0, 0.4, 0.3], [0.2, 0.2, 0.9]])
    uv = torch.tensor([[[20.2, 17.7], [20.2 + apart, 18.1], [9.0, 30.4]], [[11.0, 12.5], [25.0, 12.0], [18.3, 31.0]]])
    found = colours_at(splat(uv, colours, 1.5, (44, 44)).double(), uv, 1.5)
    torch.testing.assert_close(found, colours.expand(2, 3, 3), atol=0.07, rtol=0)
    nothing = torch.cat((uv, torch.tensor([[[38.0, 5.0]], [[5.0, 38.0]]])), 1)
    assert float(colours_at(splat(uv, colours, 1.5, (44, 44)), nothing, 1.5)[:, 3].abs().max()) < 0.01


def test_each_colour_is_named_once_and_never_that_of_a_place_that_fits():
    colours = palette(5)
    found = colours[[0, 2, 1, 0, 4]] + 0.05
    found[4] = 0.02
    fits = torch.tensor([True, False, False, False, False])
    assert find_swapped_labels(found, colours, fits).tolist() == [0, 2, 1, -1, -1]
    twice = colours[[1, 1, 2, 3, 4]]
    twice[0] += 0.1
    assert find_swapped_labels(twice, colours, torch.zeros(5, dtype=torch.bool)).tolist() == [-1, 1, 2, 3, 4]


def test_exchanged_dots_count_as_what_they_are(o10_scene):
    scene = o10_scene
    uv, seen = scene.truth.projection.uv.clone(), scene.truth.projection.visible.clone()
    seen[:, 2, 5] = False
    pairs = ((1, 0, 3), (4, 1, 2), (4, 6, 7), (9, 2, 4))
    for camera, first, second in pairs:
        uv[:, camera, [first, second]] = uv[:, camera, [second, first]]
    refined, observations = refine_images(
        scene.guess(4.0), scene.images(seen, uv), scene.factory, scene.obj, scene.prior_std
    )
    truth = scene.truth.projection.uv
    assert bool(refined.converged.all())
    assert torch.equal(observations.seen[:, 0], seen)  # the exchanged ones, too
    assert float((observations.uv[:, 0] - truth)[seen].abs().max()) < 0.1
    assert float(scene.error(Prediction(refined.rig, refined.rig_from_object[:, 0])).max()) < 0.1

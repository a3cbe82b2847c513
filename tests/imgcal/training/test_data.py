from dataclasses import replace

import pytest
import torch

from imgcal.synthesis import LEVELS, Corruption, ImageOptions
from imgcal.training.data import Source, draw_levels, object_to
from imgcal.types import Views


@pytest.fixture
def source(experiment):
    setup = experiment()
    return Source(
        setup.load_rig().to(torch.float32),
        object_to(setup.load_object(), "cpu"),
        setup.drift,
        setup.poses,
    )


def batch(source, count=3, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return source.show(source.sample(count, generator), generator)


def test_views_are_the_truth_seen_by_its_cameras(source):
    made = batch(source)
    assert made.views.uv.shape == (3, 4, 8, 2) and made.views.images is None
    assert made.views.seen.all()
    points = made.truth.rig_from_object.apply(source.obj.points)
    torch.testing.assert_close(made.views.uv, made.truth.rig.project(points).uv)
    assert {tensor.dtype for tensor in made.tensors().values()} == {torch.float32, torch.bool}


def test_the_generator_decides(source):
    one, same, other = batch(source), batch(source), batch(source, seed=2)
    assert torch.equal(one.views.uv, same.views.uv)
    assert not torch.equal(one.views.uv, other.views.uv)


@pytest.mark.parametrize("count", [1, 3, 6])
def test_levels_have_equal_shares_where_a_batch_has_fewer_rigs(source, monkeypatch, count):
    drawn = []
    for level in range(4):
        draw = LEVELS[level].draw
        monkeypatch.setitem(
            vars(LEVELS[level]),
            "draw",
            lambda *given, level=level, draw=draw: drawn.append((level, len(given[0].uv))) or draw(*given),
        )
    made, generator = batch(source, count), torch.Generator().manual_seed(5)
    views, size = made.views, source.factory.image_size
    for _ in range(80):
        draw_levels(views, size, source.obj, ImageOptions(size=16), (0, 1, 2, 3), generator)
    shares = [sum(n for level, n in drawn if level == wanted) for wanted in range(4)]
    assert sum(shares) == 80 * count and min(shares) > 10 * count


def test_an_even_batch_is_shared_out_as_ever(source):
    """What trainings have drawn before stays what they draw."""
    views, size, seed = batch(source, 4).views, source.factory.image_size, torch.Generator().manual_seed
    images, _ = draw_levels(views, size, source.obj, ImageOptions(size=16), (0, 3), one := seed(5))
    two = seed(5)
    parts = [
        LEVELS[level].draw(Views(uv, seen), size, source.obj, ImageOptions(size=16), two)[0]
        for level, uv, seen in zip((0, 3), views.uv.split(2), views.seen.split(2), strict=True)
    ]
    assert torch.equal(images, torch.cat(parts)) and torch.equal(one.get_state(), two.get_state())


def test_views_are_corrupted_and_the_truth_is_not(source):
    worse = replace(source, corruption=Corruption(noise=0.5, missing=0.3))
    clean, made = batch(source, count=40), batch(worse, count=40)
    assert torch.equal(made.truth.rig.focal_length, clean.truth.rig.focal_length)
    assert 0.65 < made.views.seen.float().mean() < 0.75
    error = (made.views.uv - clean.views.uv)[made.views.seen]
    assert 0.45 < error.std() < 0.55


def test_image_networks_get_images_only(experiment, source):
    drawing = replace(source, images=ImageOptions(size=32, dot=1.0), canvas={})
    made = batch(drawing)
    assert made.views.uv is None
    assert made.views.images.shape == (3, 4, 3, 32, 32)
    assert 0.2 < made.views.images.amax() <= 1
    assert "images" in made.tensors()
    # The brightest pixel of each camera lies on a fiducial.
    uv = drawing.images.from_sensor(batch(source).views.uv, source.factory.image_size)  # (3, 4, 8, 2)
    brightest = made.views.images.sum(2).flatten(-2).argmax(-1)  # (3, 4)
    at = torch.stack((brightest % 32, brightest // 32), -1)
    assert ((uv - at[:, :, None]).norm(dim=-1).amin(-1) < 1.0).all()

"""The module against the function, its derivatives against differences, and under every transform."""

from dataclasses import replace

import pytest
import torch

from imgcal.nn import ProjectRig, RenderAndCompare, SplatRenderer
from imgcal.refinement import ImageRefinementOptions, refine_images
from imgcal.synthesis import ImageOptions
from imgcal.types import Prediction
from tests.imgcal.lensed import KINDS, lensed

SIZE = 96
OPTIONS = ImageRefinementOptions(image=ImageOptions(SIZE, 1.5), attempts=())


@pytest.fixture
def scene(rig, obj, poses, drifted):
    """Draw (*B) predictions a little off, and images of the truth."""

    def draw(*batch, rig=rig):
        truth = Prediction(drifted(*batch, rig=rig), poses(*batch))
        seen = ProjectRig(obj)(truth.rig.resized(torch.tensor([SIZE, SIZE])), truth.rig_from_object)
        images = SplatRenderer(obj.colours, (SIZE, SIZE))(seen).clamp(0, 1)
        shift = truth.rig_from_object.translation + 2.0
        return Prediction(truth.rig, replace(truth.rig_from_object, translation=shift)), images

    return draw


def test_is_the_refinement(rig, obj, scene, batch, device, dtype):
    prediction, images = scene(*batch)
    module = RenderAndCompare(rig, obj, options=OPTIONS).to(device)
    found = module(prediction.to(dtype, device), images.to(device, torch.float32))
    flat = Prediction(prediction.rig.reshape(-1), prediction.rig_from_object.reshape(-1))
    pixels = images.reshape(-1, *images.shape[-4:]).float()
    expected, _ = refine_images(flat, pixels, rig, obj, module.prior_std.cpu(), OPTIONS)
    assert found.converged.shape == batch
    assert found.converged.all()
    assert found.rig.focal_length.dtype == dtype
    assert found.rig.camera_names == rig.camera_names
    focal_length = expected.rig.focal_length.reshape(found.rig.focal_length.shape)
    tolerance = 1e-6 if device.type == "cpu" and dtype == torch.float64 else 0.5
    torch.testing.assert_close(found.rig.focal_length.cpu().double(), focal_length, rtol=0, atol=tolerance)


@pytest.mark.parametrize("lens", KINDS)
def test_takes_every_lens(rig, obj, scene, lens):
    factory = lensed(rig, lens)
    prediction, images = scene(2, rig=factory)
    found = RenderAndCompare(factory, obj, options=OPTIONS)(prediction, images)
    assert found.converged.all()
    assert found.rig.lens_models == factory.lens_models
    uv = found.rig.project(found.rig_from_object.apply(obj.points)).uv
    shift = prediction.rig_from_object.translation - 2.0
    truth = prediction.rig.project(replace(prediction.rig_from_object, translation=shift).apply(obj.points)).uv
    assert (uv - truth).abs().max() < 0.05 * rig.image_size.max() / SIZE  # of a pixel of the images


def test_gradients_against_differences(rig, obj, scene):
    prediction, images = scene(1)
    module = RenderAndCompare(rig, obj, options=OPTIONS)
    random = torch.Generator().manual_seed(0)
    direction = torch.randn(rig.focal_length.shape, generator=random, dtype=torch.float64)
    texture = torch.randn(images.shape, generator=random, dtype=torch.float64) * (images > 0.02)

    def focal_length(zoom, light):
        factory = replace(rig, focal_length=rig.focal_length + zoom * direction)
        return module(prediction, images + light * texture, factory=factory).rig.focal_length

    zero = torch.zeros((), dtype=torch.float64)
    for argument, step in ((0, 1.0), (1, 1e-3)):
        moved = [zero, zero]
        moved[argument] = zero + step
        numeric = (focal_length(*moved) - focal_length(*(-x for x in moved))) / (2 * step)
        forward = torch.func.jacfwd(focal_length, argnums=argument)(zero, zero)
        backward = torch.func.jacrev(focal_length, argnums=argument)(zero, zero)
        torch.testing.assert_close(forward, backward, rtol=1e-5, atol=1e-6)
        assert (numeric - backward).norm() < 0.05 * numeric.norm()


def test_graphs(rig, obj, scene, same_in_graphs):
    same_in_graphs(RenderAndCompare(rig, obj, options=OPTIONS), *scene(2), tolerance=1e-6)


def test_vmap(rig, obj, scene):
    module, given = RenderAndCompare(rig, obj, options=OPTIONS), scene(3)
    found, expected = torch.func.vmap(module)(*given), module(*given)
    torch.testing.assert_close(found.rig.focal_length, expected.rig.focal_length)
    assert torch.equal(found.converged, expected.converged)

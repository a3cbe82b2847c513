"""Image variants: the encoder carries the load, and the gradient goes the whole way."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, read_rig
from imgcal.networks import NetworkConfig, Positions, build
from imgcal.nn import MapEstimate, project_fiducials
from imgcal.synthesis import ImageOptions, render_views
from imgcal.types import Observations, Views
from tests.imgcal.networks.making import DRIFT, make, snapshots, views

TINY = {
    "cnn": {"options": {"dims": [4, 4, 8, 8], "depths": [1, 1, 1, 1]}, "width": 8},
    "vit": {"options": {"embed_dim": 16, "depth": 1, "num_heads": 2}, "width": 8},
}
TRUNK = {"width": 16, "heads": 2, "depth": 1, "later_depth": 1}


def spoken(preset, size=64):
    """A small network whose heads say something."""
    factory, thing = read_rig("T4").to(torch.float32), load_object("asymmetric8")
    config = NetworkConfig(preset=preset, change=TINY.get(preset, {}) | {"trunk": TRUNK})
    weights = torch.Generator().manual_seed(0)
    network = build(config, factory, thing, DRIFT.std(factory), weights, ImageOptions(size=size))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=weights)
    return network


def test_images_are_drawn_as_is_asked_for():
    factory, thing = read_rig("T4").to(torch.float32), load_object("asymmetric8")
    given = (factory, thing, DRIFT.std(factory), torch.Generator(), ImageOptions(size=64, dot=2.0))
    assert build(NetworkConfig(preset="vit"), *given).image_options == ImageOptions(size=64, dot=2.0)
    with pytest.raises(InputError, match="the network points takes points"):
        build(NetworkConfig(preset="points"), *given)


def test_images_are_what_is_asked_of_the_views():
    network = make("vit")
    made = snapshots(network)
    with pytest.raises(ValueError, match=r"needs views\.images, found points only"):
        network(Views(uv=made.projection.uv, seen=made.projection.visible))


def first_layer(network, preset):
    return network.encoder.stem.weight if preset == "cnn" else network.encoder.patches.weight


def drawn(network):
    """Images of two rigs, and the positions that they are drawn at, as a leaf."""
    made = snapshots(network, 2)
    uv = made.projection.uv.clone().requires_grad_()
    images = render_views(uv, made.projection.visible, network.factory.image_size, network.obj, network.image_options)
    return made, uv, images


@pytest.mark.parametrize("preset", ["vit", "cnn"])
def test_the_gradient_goes_from_the_rig_to_the_renderer(preset):
    """Renderer -> encoder -> trunk -> kornia's projection -> loss."""
    network = spoken(preset)
    made, uv, images = drawn(network)
    found, truth = network(Views(images=images))[-1].cameras_from_object, made.rig.from_object(made.rig_from_object)
    apart = project_fiducials(found, network.obj) - project_fiducials(truth, network.obj)
    apart.square().mean().backward()
    for gradient in (first_layer(network, preset).grad, uv.grad):
        assert gradient is not None and torch.isfinite(gradient).all() and gradient.abs().max() > 0


@pytest.mark.parametrize("preset", ["vit", "cnn"])
def test_the_gradient_goes_through_the_map_estimate(preset):
    """The most probable rig of what the encoder sees, weighed by how sure it is; near the truth, so that it exists."""
    network = spoken(preset)
    made, uv, images = drawn(network)
    sighted = network.sight(images)
    near = (uv.detach() + 1e-3 * (sighted.uv - uv.detach())).double()[:, None]
    sigma = (0.1 * (1 + 1e-3 * sighted.sigma)).double()[:, None]
    factory = network.factory.to(torch.float64)
    solution = MapEstimate(factory, network.obj, DRIFT.std(factory))(
        Observations(near, sigma, made.projection.visible[:, None]),
        rig_from_object=made.rig_from_object[:, None].to(torch.float64),
    )
    solution.rig.focal_length.sub(made.rig.focal_length).square().mean().backward()
    gradient = first_layer(network, preset).grad
    assert gradient is not None and torch.isfinite(gradient).all() and gradient.abs().max() > 0


def test_later_passes_look_at_positions_with_their_gradient():
    network = spoken("cnn")
    network.trunk.zero_grad()
    uv = snapshots(network, 2).projection.uv.clone().requires_grad_()
    passes = network.trunk(uv, torch.ones_like(uv[..., 0]))
    # The state is detached between passes: what is left is the way by the positions.
    (gradient,) = torch.autograd.grad(passes[-1].rig.focal_length.sum(), uv)
    assert gradient.abs().max() > 0


def test_another_encoders_output_is_another_rig():
    network = spoken("cnn").eval()
    given = views(network, snapshots(network))
    with torch.no_grad():
        before = network.sight(given.images)
        hook = network.encoder.register_forward_hook(lambda module, inputs, output: output.roll(4, 0))
        after = network.sight(given.images)
        hook.remove()
    assert not torch.allclose(before.uv, after.uv, atol=1.0)


def test_positions_by_hue_need_no_encoder():
    network = make("hue-centroids")
    made = snapshots(network)
    assert network.encoder is None
    found = network.sight(views(network, made).images)
    seen = made.projection.visible
    apart = torch.where(seen[..., None], found.uv - made.projection.uv, 0.0).norm(dim=-1)
    assert apart.median() < 0.3 and found.confidence[seen].median() > 0.9
    assert torch.equal(found.views.seen, found.confidence > 0.5)


def test_a_position_counts_whole_or_next_to_nothing():
    """As positions do where the trunk learns: a weight of 0.99 would move a point by a hundredth of the image."""
    uv, sigma = torch.zeros(1, 1, 4, 2), torch.tensor([[[0.3, 2.9, 3.1, 0.1]]])
    confidence = torch.tensor([[[0.8, 0.6, 0.9, 0.4]]])
    weight = Positions(uv, sigma, confidence).weight[0, 0]
    assert weight[:2].tolist() == [1.0, 1.0] and ((weight[2:] > 0) & (weight[2:] < 1e-3)).all()


def test_the_gradient_passes_through_how_much_a_position_counts():
    uv, sigma = torch.zeros(1, 1, 2, 2), torch.tensor([[[0.3, 3.1]]], requires_grad=True)
    confidence = torch.tensor([[[0.8, 0.6]]], requires_grad=True)
    Positions(uv, sigma, confidence).weight.sum().backward()
    assert (confidence.grad > 0).all() and (sigma.grad < 0).all()


def test_groups_that_may_be_frozen_are_all_parameters():
    network = make("cnn")
    groups = {name: list(members) for name, members in network.parameter_groups().items()}
    assert list(groups) == ["encoder", "heads", "trunk"]
    assert sum(map(len, groups.values())) == len(list(network.parameters()))

"""Passes from the factory rig on."""

from dataclasses import replace

import pytest
import torch

from imgcal.networks import NetworkConfig, build
from tests.imgcal.lensed import KINDS
from tests.imgcal.networks.making import SMALL, make, snapshots, views


@pytest.mark.parametrize("preset", SMALL)
def test_an_untrained_network_returns_the_factory_calibration(preset):
    network = make(preset)
    predictions = network(views(network, snapshots(network)))
    assert len(predictions) == network.trunk.passes
    for prediction in predictions:
        assert torch.equal(prediction.rig.focal_length, network.factory.focal_length.expand(3, -1, -1))
        assert prediction.rig.local(network.factory).abs().max() < 1e-3


@pytest.mark.parametrize("lens", KINDS)
@pytest.mark.parametrize("preset", ["points", "hue-centroids", "vit"])
def test_rigs_of_other_lenses_start_at_the_factory_too_and_learn_what_their_lenses_have(preset, lens):
    network = make(preset, lens=lens)
    factory = network.factory
    seen = views(network, snapshots(network))
    for prediction in network(seen):
        assert prediction.rig.lens_model == factory.lens_model
        assert torch.equal(prediction.rig.distortion, factory.distortion.expand(3, -1, -1))
    with torch.no_grad():
        for parameter in network.trunk.parameters():
            parameter += 0.01 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
        last = network(seen)[-1].rig.distortion
    moved = (last != factory.distortion).any(0)
    assert torch.equal(moved, factory.has_coefficient)


@pytest.mark.parametrize("lens", KINDS)
def test_a_later_pass_sees_what_is_left_over_by_the_rigs_own_lenses(lens):
    network = make("points", lens=lens)
    made = snapshots(network, drift=None)
    state = network.parameterization.start(
        torch.zeros(3, 4, network.parameterization.num_parameters), torch.zeros(3, 9)
    )
    truth = replace(network.parameterization.prediction(state), rig_from_object=made.rig_from_object)
    inputs = network.trunk._differences(state, truth, made.projection.uv, torch.ones(3, 4, 8))
    fiducials = 2 * network.parameterization.centred.shape[0]
    assert inputs.shape[-1] == network.trunk.later.embed[0].in_features
    assert inputs[..., : 3 * fiducials].abs().max() < 1e-3  # residuals in three scales


def test_weights_for_lenses_of_another_width_are_taken_over_where_they_fit():
    """What knows the coefficients has another shape and stays as it is; the rest is not rescaled for them."""
    usual, rational = make("points"), make("points", lens="rational")
    before = {name: value.clone() for name, value in rational.state_dict().items()}
    rational.trunk.rescale(2 * usual.parameterization.prior_std)
    assert all(torch.equal(value, before[name]) for name, value in rational.state_dict().items())


def test_rescaled_weights_say_the_same_of_another_drift():
    config = NetworkConfig(preset="points", change={"trunk": {"trust": True}})
    narrow = make("points", trunk={"trust": True})
    factory, obj = narrow.factory, narrow.obj
    with torch.no_grad():
        for parameter in narrow.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    wide = build(config, factory, obj, 3 * narrow.parameterization.prior_std, torch.Generator()).eval()
    wide.load_state_dict(narrow.state_dict())
    wide.trunk.rescale(narrow.parameterization.prior_std)
    made = snapshots(narrow)
    with torch.no_grad():
        one, other = (network(views(narrow, made))[-1] for network in (narrow, wide))
    assert torch.allclose(one.rig.focal_length, other.rig.focal_length, rtol=1e-6)
    assert torch.allclose(one.rig.distortion, other.rig.distortion, atol=1e-6)
    assert one.log_sigma.abs().max() > 0.01
    assert torch.allclose(one.log_sigma, other.log_sigma, atol=1e-4)

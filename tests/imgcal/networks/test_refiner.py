"""Passes from the factory rig on."""

import pytest
import torch

from imgcal.networks import NetworkConfig, build
from tests.imgcal.networks.making import SMALL, make, snapshots, views


@pytest.mark.parametrize("preset", SMALL)
def test_an_untrained_network_returns_the_factory_calibration(preset):
    network = make(preset)
    predictions = network(views(network, snapshots(network)))
    assert len(predictions) == network.trunk.passes
    for prediction in predictions:
        assert torch.equal(prediction.rig.focal_length, network.factory.focal_length.expand(3, -1, -1))
        assert prediction.rig.local(network.factory).abs().max() < 1e-3


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

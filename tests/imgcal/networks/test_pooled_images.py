"""Image variants that know one pooled feature an image."""

import torch

from tests.imgcal.networks.making import make, snapshots, views


def test_a_pooled_feature_is_all_that_the_trunk_is_told():
    """With a silent bottleneck all images are one; with one that speaks they are not."""
    network = make("cnn-pooled")
    with torch.no_grad():
        for parameter in network.trunk.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
        given = views(network, snapshots(network))
        spoken = network(given)[0].rig.focal_length
        for parameter in network.bottleneck.parameters():
            parameter.zero_()
        silent = network(given)[0].rig.focal_length
    assert torch.equal(silent[0], silent[1]) and not torch.equal(spoken[0], spoken[1])


def test_the_papers_network_says_one_prediction_from_one_feature():
    small = {"depths": [1, 1, 1, 1], "dims": [8, 8, 16, 16]}
    network = make("paper-cnn2d", backbone="convnext_atto", options=small, bottleneck=16)
    assert set(network.parameter_groups()) >= {"encoder", "bottleneck", "rotation", "distortion"}
    assert len(network(views(network, snapshots(network, 1)))) == 1

"""Point networks: their inputs and precision."""

import pytest
import torch

from imgcal.networks.points import CameraIdentity, stack_points
from imgcal.types import Views
from tests.imgcal.networks.making import make, snapshots, views


@pytest.mark.parametrize("preset", ["paper-points", "paper-cnn1d"])
def test_paper_networks_return_cameras_of_their_own(preset):
    network = make(preset, width=32, head_widths=(16,))
    (prediction,) = network(views(network, snapshots(network)))
    assert prediction.cameras_from_object.focal_length.shape == (3, 4, 2)
    rotation = prediction.cameras_from_object.cam_from_rig.rotation
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3), atol=1e-5)


def test_what_is_not_seen_does_not_matter():
    network = make("points")
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    made = snapshots(network)
    seen = made.projection.visible.clone()
    seen[:, 1, 3] = False
    moved = made.projection.uv.clone()
    moved[:, 1, 3] += 500
    with torch.no_grad():
        first, second = (network(Views(uv=uv, seen=seen))[-1] for uv in (made.projection.uv, moved))
    assert torch.equal(first.rig.focal_length, second.rig.focal_length)


def test_positions_reach_the_paper_network_in_float32_under_autocast():
    network = make("paper-points", width=32, head_widths=(16,))
    seen = []
    network.embed.register_forward_hook(lambda module, given, out: seen.append(out.dtype))
    with torch.autocast("cpu", torch.bfloat16):
        network(views(network, snapshots(network)))
    assert seen == [torch.float32]


def test_autocast_leaves_geometry_alone():
    network = make("points")
    with torch.autocast("cpu", torch.bfloat16):
        prediction = network(views(network, snapshots(network)))[-1]
    assert prediction.rig.focal_length.dtype == torch.float32
    assert torch.equal(prediction.rig.focal_length, network.factory.focal_length.expand(3, -1, -1))


def test_identities_of_cameras_stay_distinct_where_there_are_more_than_dimensions():
    identity = CameraIdentity(40, 16)
    encoding = identity(torch.zeros(1, 40, 16))[0]
    apart = torch.cdist(encoding, encoding) + 9 * torch.eye(40)
    assert apart.min() > 1e-3
    assert torch.equal(encoding, CameraIdentity(40, 16)(torch.zeros(1, 40, 16))[0])  # fixed: no state is saved
    assert not identity.state_dict()


def test_points_that_all_are_seen_need_no_mask():
    network = make("points")
    made = snapshots(network)
    uv, seen = stack_points(Views(uv=made.projection.uv))
    assert seen.all() and seen.shape == uv.shape[:-1]
    with pytest.raises(ValueError, match=r"needs views\.uv, found images only"):
        stack_points(Views(images=torch.zeros(1, 4, 3, 8, 8)))

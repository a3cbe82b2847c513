"""Every network: all parameters train, batches do not mix, and the network moves between devices as a whole."""

import pytest
import torch

from imgcal.training.losses import project_fiducials
from imgcal.types import Views
from tests.imgcal.networks.making import SMALL, make, snapshots, views


@pytest.mark.parametrize("preset", ["points", "points-cnn1d", "paper-points", "vit"])
def test_reprojection_error_trains_every_parameter(preset):
    network = make(preset)
    made = snapshots(network)
    with torch.no_grad():  # away from the start, whose zero heads pass nothing on to what lies before them
        for parameter in network.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    given = views(network, made)
    errors = [project_fiducials(p.cameras_from_object, network.obj) - made.projection.uv for p in network(given)]
    torch.stack(errors).square().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


@pytest.mark.parametrize("preset", ["points", "vit"])
def test_batches_do_not_mix(preset):
    network = make(preset)
    made = snapshots(network)
    given = views(network, made)
    one = Views(*(None if x is None else x[1:2] for x in (given.uv, given.seen, given.images)))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
        whole, alone = network(given)[-1], network(one)[-1]
    assert torch.allclose(whole.rig.focal_length[1:2], alone.rig.focal_length, rtol=1e-5)
    assert torch.allclose(whole.rig_from_object.rotation[1:2], alone.rig_from_object.rotation, atol=1e-5)


@pytest.mark.parametrize("preset", ["paper-points", *SMALL])
def test_every_parameter_is_in_one_group(preset):
    network = make(preset)
    grouped = [parameter for group in network.parameter_groups().values() for parameter in group]
    assert sorted(map(id, grouped)) == sorted(map(id, network.parameters()))
    if preset == "paper-points":
        assert {"rotation", "translation", "focal_length", "principal_point", "distortion"} < set(
            network.parameter_groups()
        )


def tensors_of(record):
    """Every tensor that a rig or an object holds."""
    inner = [vars(value) if hasattr(value, "__dict__") else {} for value in vars(record).values()]
    values = [*vars(record).values(), *(value for one in inner for value in one.values())]
    return [value for value in values if isinstance(value, torch.Tensor)]


@pytest.mark.parametrize("preset", ["points", "paper-points", "vit"])
def test_a_network_moves_as_a_whole(preset):
    change = {"width": 32, "depth": 1} if preset == "paper-points" else {}
    moved = make(preset, **change).to("meta")
    held = [*moved.parameters(), *moved.buffers(), *tensors_of(moved.factory), *tensors_of(moved.obj)]
    assert {tensor.device.type for tensor in held} == {"meta"}

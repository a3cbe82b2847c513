"""The check must tell a network that lives on its encoder from one that merely carries it along."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from imgcal.errors import InputError
from imgcal.evaluation import Conditions, EncoderCheck, check_encoder
from imgcal.geometry import resized_pixels
from imgcal.io import data_path
from imgcal.networks import (
    Network,
    PaperPointNetwork,
    PaperPoints,
    PooledImageNetwork,
    PooledImages,
    find_soft_positions,
    load_checkpoint,
)
from imgcal.synthesis import ImageOptions
from imgcal.types import Views


@pytest.fixture(scope="module")
def trained():
    """The shipped network on points, with which toys make rigs of positions."""
    return load_checkpoint(data_path("models", "points-O10-cube8.safetensors"))


@pytest.fixture(scope="module")
def known(trained) -> Conditions:
    return Conditions(trained.rig, trained.obj, trained.experiment.poses, trained.experiment.drift)


class Hues(nn.Module):
    """An encoder without weights: images to positions and confidence, rigs and cameras in one axis."""

    def __init__(self, colours: torch.Tensor, dot: float) -> None:
        super().__init__()
        self.colours, self.dot = colours, dot

    def forward(self, images: torch.Tensor) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        return {"positions": find_soft_positions(images.float(), self.colours, self.dot)}


class Toy(Network):
    """Positions by an encoder, then the network on points; with `bypass` the positions come by another way."""

    def __init__(self, trained, bypass: bool) -> None:
        super().__init__(trained.parameterization, ImageOptions())
        self.hues, self.points, self.bypass = Hues(self.parameterization.colours, ImageOptions().dot), trained, bypass

    @property
    def encoder(self) -> nn.Module:
        return self.hues

    def forward(self, views):
        flat = views.images.flatten(0, 1)
        answer = self.hues(flat)
        in_image, confidence = (self.hues.forward(flat) if self.bypass else answer)["positions"]
        uv = in_image.unflatten(0, views.images.shape[:2])
        scale = self.parameterization.image_size.to(uv) / flat.shape[-1]
        seen = confidence.unflatten(0, views.images.shape[:2]) > 0.1
        return self.points(Views(uv=resized_pixels(uv, scale[:, None]), seen=seen))

    def parameter_groups(self):
        return {}


def test_an_encoder_that_the_network_lives_on_passes(trained, known):
    found = check_encoder(Toy(trained.network, bypass=False), known, count=6)
    assert found is not None and found.untouched < 3 and found.used
    assert min(found.shuffled, found.zeroed, found.noise) > 50


def test_an_encoder_that_is_carried_along_is_found_out(trained, known):
    found = check_encoder(Toy(trained.network, bypass=True), known, count=6)
    assert found is not None and found.untouched < 3 and not found.used
    assert found.untouched == found.shuffled == found.zeroed == found.noise and found.rise == 1


def test_every_way_to_spoil_counts():
    assert EncoderCheck(1.0, 3.0, 30.0, 30.0).used
    assert not EncoderCheck(1.0, 2.9, 30.0, 30.0).used  # a constant output: zeroing hurts, shuffling does not
    assert not EncoderCheck(1.0, 30.0, 2.9, 30.0).used
    assert not EncoderCheck(1.0, 30.0, 30.0, 2.9).used


def test_the_network_is_left_as_it_was(trained, known):
    toy = Toy(trained.network, bypass=False)
    first = check_encoder(toy, known, count=3)
    assert not toy.hues._forward_hooks
    assert check_encoder(toy, known, count=3) == first  # the same rigs, the same noise


def test_networks_say_which_part_is_their_encoder(trained, known):
    size = {"img_size": 32, "embed_dim": 16, "depth": 1, "num_heads": 1}
    images = PooledImageNetwork(
        PooledImages(backbone="vit_tiny_patch16_224", options=size), trained.network.parameterization
    )
    assert isinstance(images.encoder, nn.Module)
    found = check_encoder(images, known, count=2)  # hands over nothing, untrained: the factory rig, whatever it sees
    assert found is not None and not found.used
    paper = PaperPointNetwork(PaperPoints(width=16, depth=1, head_widths=(8,)), trained.network.parameterization)
    assert paper.encoder is not None and check_encoder(paper.eval(), known, count=2) is not None
    assert trained.network.encoder is None and check_encoder(trained.network, known) is None


def test_one_rig_cannot_be_shuffled(trained, known):
    with pytest.raises(InputError, match="encoder check: found 1 rig,"):
        check_encoder(Toy(trained.network, bypass=False), replace(known), count=1)


@pytest.mark.parametrize("kind", ["vit", "cnn"])
@pytest.mark.parametrize("thing", ["cube8", "asymmetric8"])
def test_image_networks_that_ship_live_on_their_encoder(kind, thing):
    shipped = load_checkpoint(data_path("models", f"{kind}-O10-{thing}.safetensors"))
    conditions = Conditions(shipped.rig, shipped.obj, shipped.experiment.poses, shipped.experiment.drift)
    check = check_encoder(shipped.network, conditions, count=3)
    assert check is not None and check.rise > 10

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from imgcal.networks import InfraredConfig, InfraredNetwork
from imgcal.networks.infrared_encoders import ENCODERS, STRIDE, CropVit, EncoderName
from imgcal.training.optimization import layer_scales


@pytest.mark.parametrize(
    "pair", [("cnn-small", "vit-small"), ("cnn", "vit"), ("cnn-large", "vit-large"), ("cnn", "vit-stem")]
)
def test_same_stride_parameters_and_operations(pair: tuple[EncoderName, EncoderName]) -> None:
    sizes, operations = [], []
    for encoder in (ENCODERS[name](16, 96) for name in pair):
        with FlopCounterMode(display=False) as counter:
            assert encoder(torch.zeros(2, 1, 96, 96)).shape == (2, 16, 96 // STRIDE, 96 // STRIDE)
        sizes.append(sum(p.numel() for p in encoder.parameters()))
        operations.append(counter.get_total_flops())
    assert max(sizes) < 1.2 * min(sizes)
    assert max(operations) < 1.2 * min(operations)


def test_vit_cells_lie_where_their_pixels_are() -> None:
    # A bright patch changes the cells of its own token most: pixel_shuffle has put them in the right order.
    torch.manual_seed(0)
    encoder = CropVit(4, 48, width=16, depth=1, heads=2)
    crop = torch.zeros(1, 1, 48, 48)
    dark = encoder(crop)
    crop[..., 30:36, 6:12] = 5.0
    change = (encoder(crop) - dark).abs().sum(1)[0]
    row, column = divmod(int(change.argmax()), 24)
    assert 15 <= row < 18
    assert 3 <= column < 6


@pytest.mark.parametrize(("encoder", "layers"), [("cnn", 3), ("vit", 4), ("vit-stem", 4)])
def test_layers_near_the_crops_learn_more_slowly(encoder: EncoderName, layers: int) -> None:
    network = InfraredNetwork(InfraredConfig(encoder=encoder))
    scales = layer_scales(network, 0.5)
    assert scales.keys() == set(network.encoder.parameters())
    assert set(scales.values()) == {0.5**n for n in range(layers)}
    first = network.encoder.stem.weight if encoder == "cnn" else network.encoder.position
    assert scales[first] == 0.5 ** (layers - 1) and scales[network.encoder.out.weight] == 1

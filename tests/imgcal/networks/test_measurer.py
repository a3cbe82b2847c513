import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from imgcal.networks import Measurer, MeasurerConfig
from imgcal.types import PATCH_SIZE


@pytest.mark.parametrize("encoder", ["cnn", "vit"])
def test_patches_are_measured_one_by_one(encoder: str) -> None:
    torch.manual_seed(0)
    measurer = Measurer(MeasurerConfig(encoder=encoder))
    patches, radius = torch.randn(3, PATCH_SIZE, PATCH_SIZE), torch.tensor([2.0, 3.0, 4.0])
    together, alone = measurer(patches, radius), measurer(patches[1:2], radius[1:2])
    assert together.offset.shape == (3, 2)
    torch.testing.assert_close(together.offset[1:2], alone.offset, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(together.valid[1:2], alone.valid, atol=1e-5, rtol=1e-4)
    odds = together.kind.softmax(-1)[:, 3]
    torch.testing.assert_close(together.valid.sigmoid(), 1 - odds, atol=1e-5, rtol=1e-4)


def test_families_are_alike_in_size() -> None:
    sizes = {}
    for encoder in ("cnn", "vit"):
        measurer = Measurer(MeasurerConfig(encoder=encoder))
        with FlopCounterMode(display=False) as counter:
            measurer.encoder(torch.zeros(1, 1, PATCH_SIZE, PATCH_SIZE))
        sizes[encoder] = sum(p.numel() for p in measurer.encoder.parameters()), counter.get_total_flops()
    for cnn, vit in zip(sizes["cnn"], sizes["vit"], strict=True):
        assert max(cnn, vit) < 1.2 * min(cnn, vit)

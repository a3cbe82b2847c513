import pytest
import torch
from torch.nn import functional

from imgcal.networks import InfraredConfig, InfraredNetwork, Queries, normalize_crops
from imgcal.networks.infrared import SetBlock, aligned_windows

SMALL = {"crop": 48, "channels": 4, "window": 6, "blocks": 2}


def queries(crops: int = 2, fiducials: int = 3, seed: int = 0) -> Queries:
    draw = torch.Generator().manual_seed(seed)
    place = 10 + 28 * torch.rand(crops, fiducials, 2, generator=draw)
    asked = torch.ones(crops, fiducials, dtype=torch.bool)
    return Queries(place, torch.full((crops, fiducials), 1.5), torch.zeros(crops, fiducials), asked)


def picked(q: Queries, order: list[int]) -> Queries:
    return Queries(q.place[:, order], q.radius[:, order], q.depth[:, order], q.asked[:, order])


@pytest.mark.parametrize("encoder", ["cnn", "vit"])
def test_fiducials_are_a_set(encoder: str) -> None:
    torch.manual_seed(0)
    network = InfraredNetwork(InfraredConfig(encoder=encoder, **SMALL))
    crops, asked, order = torch.randn(2, 48, 48), queries(), [2, 0, 1]
    plain, other = network(crops, asked), network(crops, picked(asked, order))
    torch.testing.assert_close(other.logits, plain.logits[:, order])
    torch.testing.assert_close(other.present, plain.present[:, order])
    assert plain.offset.shape == (2, 3, 6, 6, 2)


def test_what_is_not_asked_for_says_nothing_to_the_others() -> None:
    torch.manual_seed(0)
    network, crops, all_of_them = InfraredNetwork(InfraredConfig(**SMALL)), torch.randn(2, 48, 48), queries()
    asked = all_of_them.asked.clone()
    asked[:, 2] = False
    two = network(crops, Queries(all_of_them.place, all_of_them.radius, all_of_them.depth, asked))
    alone = network(crops, picked(all_of_them, [0, 1]))
    torch.testing.assert_close(two.logits[:, :2], alone.logits)


def test_a_set_block_is_the_plain_one() -> None:
    torch.manual_seed(0)
    block, windows, geometry = SetBlock(4, 3), torch.randn(2, 5, 4, 7, 7), torch.randn(2, 5, 6)
    asked = torch.tensor([[True] * 5, [True, False, True, True, False]])
    expected = []
    for one, how, counts in zip(windows, geometry, asked, strict=True):
        seen = functional.gelu(block.spatial(one) + block.geometry(how)[..., None, None])
        share = counts / counts.sum()
        mean = (share[:, None, None, None] * seen).sum(0)
        relation = block.query(how) @ (block.key(how) * share[:, None]).T
        related = torch.einsum("mn,ndij->mdij", relation, seen)
        mixed = block.mix(torch.cat((seen, mean.expand_as(seen), related), dim=1))
        expected.append(one + block.out(functional.gelu(mixed)))
    assert torch.allclose(block(windows, geometry, asked), torch.stack(expected), atol=1e-5)


def test_windows_are_centred_and_bilinear() -> None:
    # A map that holds its own coordinates: a window's features are then its cells' places.
    rows, columns = torch.meshgrid(torch.arange(24.0), torch.arange(24.0), indexing="ij")
    middles = 2 * torch.stack((columns, rows)) + 0.5  # of the cells, in crop pixels
    place = torch.tensor([[[20.3, 25.1], [17.0, 30.0]]])
    windows, cells = aligned_windows(middles[None], place, 6)
    torch.testing.assert_close(windows.movedim(2, -1), cells)
    torch.testing.assert_close(cells.mean((2, 3)), place)
    torch.testing.assert_close(cells[0, 0, 0, 1] - cells[0, 0, 0, 0], torch.tensor([2.0, 0.0]))


def test_a_common_shift_of_crop_and_queries_changes_nothing() -> None:
    torch.manual_seed(0)
    network, asked = InfraredNetwork(InfraredConfig(**SMALL)), queries(1)
    scene = torch.zeros(1, 64, 64)
    scene[:, 24:40, 24:40] = torch.randn(1, 16, 16)
    one = network(scene[:, 8:56, 8:56], Queries(asked.place / 3 + 15, asked.radius, asked.depth, asked.asked))
    other = network(scene[:, :48, :48], Queries(asked.place / 3 + 23, asked.radius, asked.depth, asked.asked))
    torch.testing.assert_close(one.logits, other.logits, atol=1e-4, rtol=1e-4)


def test_normalized_crops_do_not_know_gain_and_level() -> None:
    crops = torch.randn(2, 48, 48, generator=torch.Generator().manual_seed(0)) + 5
    crops[0, :, :10] = torch.nan
    plain = normalize_crops(crops)
    torch.testing.assert_close(normalize_crops(crops * 40 + 7), plain, atol=1e-5, rtol=1e-5)
    assert bool(plain.isfinite().all())
    assert not plain[0, :, :10].any()
    assert not normalize_crops(torch.full((1, 8, 8), torch.nan)).any()


def test_groups_hold_all_parameters() -> None:
    network = InfraredNetwork(InfraredConfig(**SMALL))
    grouped = [p for group in network.parameter_groups().values() for p in group]
    assert {id(p) for p in grouped} == {id(p) for p in network.parameters()}
    assert len(grouped) == len(set(grouped))

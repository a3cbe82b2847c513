from dataclasses import fields, replace

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import write_tensors
from imgcal.training import HELD_OUT, TRAIN, FrameDataset, load_splits
from imgcal.training.frame_dataset import expect_elsewhere, thin, turn

CROPS, FIDUCIALS, SIZE = 4, 3, 96


@pytest.fixture
def crops() -> FrameDataset:
    """Crops in which the pixel at each marker's place is bright."""
    generator = torch.Generator().manual_seed(0)
    place = torch.randint(20, 76, (CROPS, FIDUCIALS, 2), generator=generator).float()
    light = torch.zeros(CROPS, SIZE, SIZE)
    rows = torch.arange(CROPS)[:, None]
    light[rows, place[..., 1].long(), place[..., 0].long()] = 1.0
    one, yes = torch.ones(CROPS, FIDUCIALS), torch.ones(CROPS, FIDUCIALS, dtype=torch.bool)
    number = torch.arange(CROPS)
    return FrameDataset(light.half(), place, 0.1 * one, 2 * one, 0 * one, yes, yes.clone(), number % 2, number)


def test_what_was_saved_is_read(crops, tmp_path) -> None:
    for name in (TRAIN, HELD_OUT):
        crops.save(tmp_path / name, {"capture": "somewhere"})
    train, held_out = load_splits(tmp_path)
    for field in fields(FrameDataset):
        assert torch.equal(getattr(train, field.name), getattr(crops, field.name))
    assert len(held_out) == len(held_out.select(torch.arange(CROPS))) == CROPS


def test_tensors_that_do_not_belong_together_are_refused(crops, tmp_path) -> None:
    with pytest.raises(InputError, match=r"no such folder, expected a dataset of `imgcal harvest`"):
        load_splits(tmp_path / "nowhere")
    replace(crops, place=crops.place[:2]).save(tmp_path / "a.safetensors", {})
    with pytest.raises(InputError, match=r"a.safetensors: place: found shape \(2, 3, 2\), expected \(4, 3, 2\)"):
        FrameDataset.load(tmp_path / "a.safetensors")
    crops.select(torch.arange(0)).save(tmp_path / "b.safetensors", {})
    with pytest.raises(InputError, match="found no crops"):
        FrameDataset.load(tmp_path / "b.safetensors")
    write_tensors(tmp_path / "c.safetensors", {"crops": crops.crops}, FrameDataset.FORMAT, {})
    with pytest.raises(InputError, match="found tensors crops, expected crops, place"):
        FrameDataset.load(tmp_path / "c.safetensors")


def test_markers_stay_under_their_places_when_crops_are_turned(crops) -> None:
    turned = set()
    for seed in range(64):
        found = turn(crops, torch.Generator().manual_seed(seed))
        rows = torch.arange(CROPS)[:, None]
        assert (found.crops[rows, found.place[..., 1].long(), found.place[..., 0].long()] == 1).all()
        turned.add(tuple(found.place[0, 0].tolist()))
    assert len(turned) == 8


def test_a_fitted_rig_expects_markers_nearer_than_one_that_drifted(crops) -> None:
    far, near = (
        torch.cat([
            (expect_elsewhere(crops, torch.Generator().manual_seed(seed), close).place - crops.place).norm(dim=-1)
            for seed in range(20)
        ])
        for close in (False, True)
    )  # fmt: skip
    assert near.median() < 2 < 4 < far.median() < 25


def test_what_is_expected_outside_the_crop_is_not_asked_for(crops) -> None:
    edge = replace(crops, place=crops.place * 0 + 0.0)
    queries = expect_elsewhere(edge, torch.Generator().manual_seed(1), near=False)
    outside = (queries.place < -0.5).any(-1)
    assert outside.any() and not queries.asked[outside].any()


def test_a_thinned_crop_keeps_neighbours_with_all_that_is_known_of_them(crops) -> None:
    sigma = torch.arange(CROPS * FIDUCIALS).view(CROPS, FIDUCIALS).float()
    crops = replace(crops, sigma=sigma, asked=torch.tensor([[True, True, False]] * CROPS))
    kept = thin(crops, 2, torch.Generator().manual_seed(0))
    assert kept.place.shape == (CROPS, 2, 2) and kept.asked.all()
    for row in range(CROPS):
        for place, number in zip(kept.place[row], kept.sigma[row].long() % FIDUCIALS, strict=True):
            assert torch.equal(place, crops.place[row, number])
    assert thin(crops, FIDUCIALS, torch.Generator()) is crops

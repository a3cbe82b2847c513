import math

import pytest
import torch

from imgcal.errors import InputError
from imgcal.networks import Measured, load_measurer
from imgcal.training import (
    HELD_OUT_PATCHES,
    TRAIN_PATCHES,
    MeasurerExperiment,
    MeasurerTask,
    PatchDataset,
    load_experiment,
)
from imgcal.training.measurer_task import PatchBatch
from imgcal.types import BlobKind


def task() -> MeasurerTask:
    experiment = load_experiment("measurer-cnn", ["training.validation_rigs=130", "pool=130"], kind=MeasurerExperiment)
    return experiment.make_task(torch.device("cpu"), 20, torch.Generator().manual_seed(0), True)


def knows(batch: PatchBatch, sigma: float) -> Measured:
    kinds = 20.0 * torch.nn.functional.one_hot(batch.kind, 4).float()
    return Measured(batch.offset, torch.full_like(batch.radius, math.log(sigma)), kinds)


def test_loss_is_least_for_the_truth() -> None:
    made, generator = task(), torch.Generator().manual_seed(1)
    batch = made.batch(16, generator)
    truth = made.loss(knows(batch, 0.05), batch, 0)
    off = made.loss(Measured(batch.offset + 0.3, torch.full_like(batch.radius, -3.0), knows(batch, 1).kind), batch, 0)
    wrong = made.loss(Measured(batch.offset, torch.full_like(batch.radius, -3.0), -knows(batch, 1).kind), batch, 0)
    assert float(truth.total) < min(float(off.total), float(wrong.total))
    assert float(truth.means["error_px"]) == 0


def test_validation_counts_errors_in_sigmas() -> None:
    made = task()
    said = made.validate(
        lambda batch: Measured(batch.offset + 0.2, torch.full_like(batch.radius, math.log(0.1)), knows(batch, 1).kind)
    )
    assert abs(said["validation_error_px"] - 0.2) < 1e-5
    assert abs(said["validation_nees"] - 4) < 1e-3
    assert said["validation_wrong_verdicts"] == 0


def test_it_learns_and_its_file_is_read(tmp_path) -> None:
    made, generator = task(), torch.Generator().manual_seed(2)
    batch = made.batch(12, generator)
    optimizer = torch.optim.AdamW(made.network.parameters(), lr=3e-3)
    losses = []
    for step in range(25):
        loss = made.loss(made.predict(made.network, batch), batch, step)
        optimizer.zero_grad()
        loss.total.backward()
        optimizer.step()
        losses.append(float(loss.total.detach()))
    assert losses[-1] < losses[0] - 0.1
    made.result(made.network, {}).save(tmp_path / "model.safetensors")
    read = load_measurer(tmp_path / "model.safetensors").network.eval()
    again = read(batch.patches, batch.radius)
    torch.testing.assert_close(
        again.offset.detach(), made.network(batch.patches, batch.radius).offset.detach(), atol=0.05, rtol=0.05
    )


def test_patches_of_real_frames_are_mixed_with_rendered_ones_and_held_out_ones_judge(tmp_path) -> None:
    place = torch.linspace(-3, 3, 40)
    offset, number = torch.stack((place, -place), 1), torch.arange(40)
    steps = torch.arange(24.0) - 11.5
    u, v = steps[None, None] - offset[:, :1, None], steps[None, :, None] - offset[:, 1:, None]
    rings = ((u.square() + v.square()).sqrt() - 5).abs() < 0.8
    patches = PatchDataset(rings.half(), torch.full((40,), 3.0), offset, 0 * number, number)
    for name, part in ((TRAIN_PATCHES, patches), (HELD_OUT_PATCHES, patches.select(number[::2]))):
        part.save(tmp_path / name, {})
    changes = ["training.validation_rigs=20", "pool=130", f"frames={tmp_path}", "frames_share=0.5"]
    made = load_experiment("measurer-cnn", changes, kind=MeasurerExperiment).make_task(
        torch.device("cpu"), 20, torch.Generator().manual_seed(0), True
    )
    generator = torch.Generator().manual_seed(1)
    own = [bool((made.batch(20, generator).kind == BlobKind.WHOLE).all()) for _ in range(40)]
    assert 8 < sum(own) < 32
    said = made.validate(
        lambda batch: Measured(batch.offset + 0.2, torch.full_like(batch.radius, math.log(0.1)), knows(batch, 1).kind)
    )
    assert abs(said["validation_error_px"] - 0.2) < 1e-5 and said["validation_wrong_verdicts"] == 0
    with pytest.raises(InputError, match=r"nowhere.train_patches\.safetensors"):
        load_experiment("measurer-cnn", [*changes[:2], f"frames={tmp_path / 'nowhere'}"]).make_task(
            torch.device("cpu"), 20, torch.Generator(), True
        )

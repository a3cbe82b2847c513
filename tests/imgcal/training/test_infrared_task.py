from dataclasses import replace
from pathlib import Path

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import model_file, read_tensors
from imgcal.networks import Evidence, load_infrared
from imgcal.training import (
    HELD_OUT,
    TRAIN,
    Callbacks,
    FrameDataset,
    InfraredExperiment,
    Result,
    Run,
    TrainingState,
    load_experiment,
    train,
)
from imgcal.training.infrared_task import CropBatch

TINY = (
    "network={crop: 96, channels: 4, window: 12, blocks: 1}",
    "training={steps: 3, batch_size: 4, validation_rigs: 6, log_every: 1, validate_every: 3, save_every: 3}",
)


class Kept(Callbacks):
    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self.result: Result | None = None

    def on_metrics(self, run: Run, row: dict[str, float], due: bool) -> None:
        self.rows.append(row)

    def on_checkpoint(self, run: Run, state: TrainingState, result: Result) -> None:
        self.result = result


def test_shipped_experiments_say_the_same_but_for_the_encoder() -> None:
    cnn, vit = (load_experiment(f"ir-{kind}", kind=InfraredExperiment) for kind in ("cnn", "vit"))
    assert cnn.network.encoder == "cnn"
    same = {"name": "", "description": "", "network": cnn.network}
    assert cnn.model_copy(update=same) == vit.model_copy(update=same)


def test_it_trains_and_its_file_is_read(tmp_path: Path) -> None:
    kept = Kept()
    run = train(load_experiment("ir-cnn", TINY), kept)
    assert run.step == 3
    assert {"loss", "cell", "right", "wrong"} <= kept.rows[0].keys()
    validation = kept.rows[-1]
    assert 0 <= validation["validation_right"] <= 1
    assert validation["validation_missed"] >= 0
    assert kept.result is not None
    kept.result.save(tmp_path / "model.safetensors")
    read = load_infrared(tmp_path / "model.safetensors").network
    for start in (tmp_path / "model.safetensors", tmp_path):  # a file, or the folder of a run
        again = load_experiment("ir-cnn", (*TINY, f"training.init_from={start}"))
        task = again.make_task(torch.device("cpu"), 4, torch.Generator(), True)
        assert task.untrained == ()
        for name, tensor in task.network.state_dict().items():
            assert torch.equal(tensor, read.state_dict()[name])


@pytest.mark.parametrize("kind", ["ir", "measurer"])
def test_a_warm_start_takes_what_fits_of_a_shipped_network_and_says_what_does_not(kind: str) -> None:
    small = "training={steps: 3, batch_size: 4, validation_rigs: 2, init_from: " + kind + "-cnn}"
    pool = ("pool=2",) if kind == "measurer" else ()
    task = load_experiment(f"{kind}-vit", (small, *pool)).make_task(torch.device("cpu"), 4, torch.Generator(), True)
    named = dict(task.network.named_parameters())
    assert task.untrained and all(name.startswith("encoder.") for name in task.untrained)
    tensors, _ = read_tensors(model_file(f"{kind}-cnn"), {"ir": "imgcal-infrared/1"}.get(kind, "imgcal-measurer/1"))
    taken = [name for name in named if name not in task.untrained]
    assert taken and all(torch.equal(named[name], tensors[name].float()) for name in taken)


def test_a_rig_has_as_many_crops_as_cameras() -> None:
    with pytest.raises(InputError, match="batch_size: found 3 crops at once, expected a multiple of the 2 cameras"):
        load_experiment("ir-cnn", TINY).make_task(torch.device("cpu"), 3, torch.Generator(), True)


def test_every_crop_of_a_validation_counts_once_however_it_is_split() -> None:
    """Of five crops in batches of four and two, the two count half as much as the four."""
    task = load_experiment("ir-cnn", TINY).make_task(torch.device("cpu"), 4, torch.Generator(), True)
    assert task.sizes == [4, 2]
    told: list[tuple[float, float]] = []

    def predict(batch: CropBatch) -> Evidence:
        answer = task.predict(task.network, batch)
        right = (torch.arange(len(batch.crops)) < (4 if len(batch.crops) == 4 else 0))[:, None]
        # Sure of the right cell, exactly there, in the first batch; nothing is claimed in the second.
        apart = batch.place[:, :, None, None] - answer.cells
        nearest = apart.square().sum(-1) == apart.square().sum(-1).flatten(2).amin(-1)[..., None, None]
        told.append((float((batch.queries.asked & batch.seen).sum()), float(right.all())))
        logits = torch.where(nearest, 1e3, -1e3)
        return replace(answer, logits=logits, offset=apart, present=torch.where(right, 1e3, -1e3).expand_as(batch.seen))

    with torch.no_grad():
        found = task.validate(predict)
    visible = sum(count for count, _ in told)
    assert found["validation_right"] == pytest.approx(sum(count * right for count, right in told) / visible, rel=1e-6)
    assert 0 < found["validation_right"] < 1


def test_a_validation_is_of_whole_rigs() -> None:
    odd = (*TINY, "training.validation_rigs=7")
    with pytest.raises(InputError, match="validation_rigs: found 7 crops, expected a multiple of the 2 cameras"):
        load_experiment("ir-cnn", odd).make_task(torch.device("cpu"), 4, torch.Generator(), True)


def test_a_batch_depends_on_the_generator_alone() -> None:
    experiment = load_experiment("ir-vit", TINY)
    task = experiment.make_task(torch.device("cpu"), 4, torch.Generator(), True)
    generator = torch.Generator().manual_seed(5)
    before = generator.get_state()
    first, other = task.batch(4, generator).tensors(), task.batch(4, generator).tensors()
    generator.set_state(before)
    for name, tensor in task.batch(4, generator).tensors().items():
        assert torch.equal(tensor, first[name])
    assert not torch.equal(first["crops"], other["crops"])


def test_frames_of_ones_own_are_mixed_with_rendered_ones_and_held_out_ones_judge(tmp_path: Path) -> None:
    place = torch.rand(6, 5, 2, generator=torch.Generator().manual_seed(0)) * 60 + 18
    one, yes = torch.ones(6, 5), torch.ones(6, 5, dtype=torch.bool)
    number = torch.arange(6)
    crops = FrameDataset(torch.zeros(6, 96, 96).half(), place, 0.1 * one, 2 * one, 0 * one, yes, yes, number, number)
    for name in (TRAIN, HELD_OUT):
        crops.save(tmp_path / name, {})
    own = load_experiment("ir-cnn", (*TINY, f"frames={tmp_path}", "frames_share=0.5"))
    task = own.make_task(torch.device("cpu"), 4, torch.Generator(), False)
    generator = torch.Generator().manual_seed(1)
    shapes = [task.batch(4, generator).place.shape for _ in range(40)]
    assert 8 < sum(shape[1] == 5 and shape[0] == 4 for shape in shapes) < 35
    kept = Kept()
    train(own, kept)
    assert kept.rows[-1]["validation_missed"] >= 0
    plain = load_experiment("ir-cnn", TINY).make_task(torch.device("cpu"), 4, torch.Generator(), False)
    assert plain.own is None
    replace(crops, crops=torch.zeros(6, 48, 48).half()).save(tmp_path / TRAIN, {})
    replace(crops, crops=torch.zeros(6, 48, 48).half()).save(tmp_path / HELD_OUT, {})
    with pytest.raises(InputError, match="found crops of 48 pixels, expected 96"):
        own.make_task(torch.device("cpu"), 4, torch.Generator(), False)


def test_crops_of_another_size_than_the_rendered_ones_are_refused() -> None:
    with pytest.raises(InputError, match=r"found network\.crop 48, expected 96"):
        load_experiment("ir-cnn", (*TINY, "network.crop=48"))

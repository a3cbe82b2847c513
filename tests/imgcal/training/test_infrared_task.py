from pathlib import Path

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import model_file, read_tensors
from imgcal.networks import load_infrared
from imgcal.training import Callbacks, InfraredExperiment, Result, Run, TrainingState, load_experiment, train

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

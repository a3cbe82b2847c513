"""The state of a run: all of it comes back, and that of another experiment is no state to go on from."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import write_tensors
from imgcal.training import TrainingState, load_state, save_state
from imgcal.training.state import FORMAT, first_difference, random_states, restore_random_states


def state_of(experiment) -> TrainingState:
    tensors = {
        "network": {"head.weight": torch.randn(3, 4, generator=torch.Generator().manual_seed(0))},
        "random": {"data": torch.Generator().manual_seed(5).get_state()},
        "optimizer": {"0.exp_avg": torch.zeros(2), "0.step": torch.tensor(7.0)},
    }
    return TrainingState(tensors, {"step": 7, "elapsed": 1.5, "schedule": {"best": None}}, experiment)


def test_a_state_comes_back(experiment, tmp_path) -> None:
    saved = state_of(experiment())
    save_state(tmp_path / "state", saved)
    found = load_state(tmp_path / "state", experiment("training.steps=99", "training.log_every=3"))
    assert found.values == saved.values and found.experiment.training.steps == 99
    assert found.tensors.keys() == saved.tensors.keys()
    for part, named in saved.tensors.items():
        assert found.tensors[part].keys() == named.keys()
        assert all(torch.equal(found.tensors[part][name], tensor) for name, tensor in named.items())


def test_another_experiment_is_told_what_differs(experiment, tmp_path) -> None:
    save_state(tmp_path / "state", state_of(experiment()))
    for change, message in (
        ("optimizer.lr=0.1", r"optimizer\.lr: found 0\.1, expected 0\.003"),
        ("training.batch_size=13", r"training\.batch_size: found 13, expected 12"),
        ("rig=O6", "rig: found O6, expected T4"),
    ):
        with pytest.raises(InputError, match=message):
            load_state(tmp_path / "state", experiment(change))


@pytest.mark.parametrize("texts", [{}, {"values": "[]", "experiment": "{}"}, {"values": "{", "experiment": "{}"}])
def test_a_damaged_state_is_told(texts, experiment, tmp_path) -> None:
    write_tensors(tmp_path / "state", {"network/a": torch.zeros(1)}, FORMAT, texts)
    with pytest.raises(InputError, match="the file is damaged"):
        load_state(tmp_path / "state", experiment())


def test_the_state_of_another_kind_of_experiment_is_told(experiment, tmp_path) -> None:
    texts = {"values": "{}", "experiment": '{"name": "ir-cnn", "crops": 12}'}
    write_tensors(tmp_path / "state", {"network/a": torch.zeros(1)}, FORMAT, texts)
    with pytest.raises(InputError, match=r"found the state of another kind of experiment \(ir-cnn\), expected one of "):
        load_state(tmp_path / "state", experiment())


def test_the_first_difference_that_matters() -> None:
    saved = {"name": "a", "loss": {"kind": "robust", "weights": [1, 2]}, "training": {"steps": 5, "seed": 1}}
    assert first_difference(saved, saved) is None
    free = {**saved, "name": "b", "training": {"steps": 9, "seed": 1}}
    assert first_difference(saved, free) is None
    assert first_difference(saved, {**free, "training": {"steps": 9, "seed": 2}}) == ("training.seed", 1, 2)
    assert first_difference(saved, {**saved, "loss": {"kind": "robust", "weights": [1, 3]}})[0] == "loss.weights"
    assert first_difference(saved, {**saved, "more": 1}) == ("more", None, 1)
    assert first_difference({**saved, "more": 1}, saved) == ("more", 1, None)


def test_generators_go_on_where_they_were() -> None:
    data, dropout = torch.Generator().manual_seed(1), torch.Generator().manual_seed(2)
    torch.rand(5, generator=data), torch.rand(3, generator=dropout)
    states = {name: tensor.clone() for name, tensor in random_states(data, [dropout]).items()}
    expected = torch.rand(4, generator=data), torch.rand(4, generator=dropout)
    other, another = torch.Generator().manual_seed(8), torch.Generator().manual_seed(9)
    restore_random_states(other, [another], states)
    assert torch.equal(torch.rand(4, generator=other), expected[0])
    assert torch.equal(torch.rand(4, generator=another), expected[1])

"""Networks from files, as they are evaluated."""

import shutil
from dataclasses import replace

import pytest

from imgcal.errors import InputError
from imgcal.evaluation import load_models
from imgcal.evaluation.models import _names
from imgcal.io import data_path, load_object, read_rig
from imgcal.networks import load_checkpoint
from imgcal.pipeline import load_initializer

POINTS = data_path("models", "points-O10-asymmetric8.safetensors")


def test_a_shipped_network_knows_what_it_is_for() -> None:
    [model] = load_models([POINTS])
    assert model.name == POINTS.stem and model.size == POINTS.stat().st_size and model.history == ()
    assert model.facts.parameters == model.parameters > 10**5
    assert model.conditions.rig.camera_names == read_rig("O10").camera_names
    assert model.conditions.obj.num_fiducials == 8 and model.conditions.corruption.noise == 0


def test_a_folder_of_a_run_has_its_name_and_its_history(tmp_path) -> None:
    folder = tmp_path / "my-run"
    folder.mkdir()
    shutil.copy(POINTS, folder / "model.safetensors")
    (folder / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.0}\n{"st')
    models = load_models([folder, POINTS])
    assert [model.name for model in models] == ["my-run", POINTS.stem]
    assert [row["step"] for row in models[0].history] == [1, 2]


def test_a_training_of_positions_says_no_rig(tmp_path) -> None:
    trained = load_checkpoint(POINTS)
    file = tmp_path / "positions.safetensors"
    replace(trained, experiment=trained.experiment.model_copy(update={"task": "positions"})).save(file)
    with pytest.raises(InputError, match=r"found a training of positions, whose trunk is untrained"):
        load_models([file])
    with pytest.raises(InputError, match=r"positions\.safetensors: found a training of positions"):
        load_initializer(str(file), read_rig("O10"), load_object("asymmetric8"))


def test_networks_must_be_for_the_same_rig_and_object() -> None:
    cube = data_path("models", "points-O10-cube8.safetensors")
    with pytest.raises(InputError, match="another object"):
        load_models([POINTS, cube])
    with pytest.raises(InputError, match="another rig than T4"):
        load_models([POINTS], read_rig("T4"))
    assert load_models([]) == []
    assert len(load_models([POINTS], read_rig("O10"), load_object("asymmetric8"))) == 1


def test_names_are_as_short_as_they_can_be(tmp_path) -> None:
    runs = [tmp_path / "a" / "x" / "model.safetensors", tmp_path / "b" / "x" / "model.safetensors"]
    assert _names(runs) == ["a/x", "b/x"]
    assert _names([runs[0], tmp_path / "y.safetensors"]) == ["x", "y"]
    with pytest.raises(InputError, match="expected each one once"):
        _names([runs[0], runs[0]])

"""The engine is independent of rigs: another task is trained, stopped and resumed."""

import pytest
import torch

from imgcal.cli.training_folder import RESULT, train_in
from imgcal.errors import InputError
from imgcal.io import read_metrics, read_tensors
from imgcal.training import experiment_file
from tests.imgcal.training.line import EXPERIMENT


def test_another_task_is_trained_and_continued(line, tmp_path, capsys):
    train_in(tmp_path / "whole", line())
    asked = iter(range(1, 100))
    train_in(tmp_path / "parts", line(), should_stop=lambda: next(asked) == 13)
    run = train_in(tmp_path / "parts", line(), resume=True)
    whole, parts = (read_tensors(tmp_path / name / RESULT, "line/1")[0] for name in ("whole", "parts"))
    assert all(torch.equal(whole[name], parts[name]) for name in ("weight", "bias"))
    rows = read_metrics(tmp_path / "whole" / "metrics.jsonl")
    assert set(rows[0]) == {"step", "loss", "error", "lr", "points_per_s", "seconds"}
    assert rows[-1]["validation_slope"] < 0.9 * rows[2]["validation_slope"]
    assert "points/s" in capsys.readouterr().err
    assert run.task.slope == 3.0


def test_a_kind_of_experiment_has_its_own_keys(line, tmp_path):
    assert line("slope=2.0").slope == 2.0
    with pytest.raises(InputError, match="unknown key `slop`, nearest: slope"):
        line("slop=2.0")
    with pytest.raises(InputError, match="task: found line, expected rig"):
        experiment_file.load_experiment(tmp_path / "line.yaml", kind=experiment_file.RigExperiment)
    experiment_file.save_experiment(line(), tmp_path / "resolved.yaml")
    assert experiment_file.load_experiment(tmp_path / "resolved.yaml") == line()
    (tmp_path / "lime.yaml").write_text(EXPERIMENT.replace("task: line", "task: lime"))
    with pytest.raises(InputError, match=r"lime\.yaml: task: found 'lime', nearest: line"):
        experiment_file.load_experiment(tmp_path / "lime.yaml")

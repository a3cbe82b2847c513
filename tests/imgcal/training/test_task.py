"""The engine knows nothing of rigs: a task of its own, a line through points, is trained, stopped and continued."""

from dataclasses import dataclass
from typing import Literal

import pytest
import torch
from torch import nn

from imgcal.cli.training_folder import RESULT, train_in
from imgcal.errors import InputError
from imgcal.io import read_metrics, read_tensors, write_tensors
from imgcal.training import Loss, Task, experiment_file
from imgcal.training.experiment import Experiment

EXPERIMENT = """
format: imgcal-experiment/1
name: line
task: line
slope: 3.0
optimizer: {lr: 0.1, ema: 0.9}
training: {steps: 40, batch_size: 6, log_every: 10, validate_every: 20, save_every: 20, device: cpu}
"""


class LineExperiment(Experiment):
    """Where a line is."""

    task: Literal["line"]
    slope: float

    def make_task(self, device, batch_size, weights, fresh):
        return LineTask(self)


@dataclass
class Points:
    x: torch.Tensor
    y: torch.Tensor

    def tensors(self):
        return vars(self)


class LineTask(Task):
    unit, judged, headline = "points", "validation_slope", {"error": "error {:.2g}"}

    def __init__(self, experiment):
        self.slope, self.network = experiment.slope, nn.Linear(1, 1)
        nn.init.zeros_(self.network.weight)
        nn.init.zeros_(self.network.bias)

    def batch(self, count, generator):
        x = torch.randn(count, 1, generator=generator)
        return Points(x, self.slope * x + 1)

    def predict(self, network, batch):
        return network(batch.x)

    def loss(self, answer, batch, step):
        error = (answer - batch.y).abs().mean()
        return Loss(error, {"error": error.detach()})

    def validate(self, predict):
        x = torch.tensor([[0.0], [1.0]])
        y = predict(Points(x, x))
        return {"validation_slope": abs(float(y[1] - y[0]) - self.slope)}

    def result(self, network, metrics):
        return Line(network, metrics)


@dataclass
class Line:
    network: nn.Module
    metrics: dict

    def save(self, path):
        write_tensors(path, self.network.state_dict(), "line/1", {})


@pytest.fixture
def line(tmp_path, monkeypatch):
    monkeypatch.setitem(experiment_file.KINDS, "line", LineExperiment)
    (tmp_path / "line.yaml").write_text(EXPERIMENT)
    return lambda *changes: experiment_file.load_experiment(tmp_path / "line.yaml", changes)


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

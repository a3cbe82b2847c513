"""A task that has nothing to do with rigs: a line through points."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from imgcal.io import write_tensors
from imgcal.training import Experiment, Loss, Task

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

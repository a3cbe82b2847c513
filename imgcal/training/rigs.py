"""The task of rigs: from the views of all cameras to the whole rig."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Literal

import torch
from pydantic import ConfigDict, Field
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.formats import load_rig
from imgcal.io import load_object, object_text, rig_text, validate
from imgcal.networks import Checkpoint, Network, NetworkSpec, build_network, drop_pretrained, warm_start
from imgcal.nn import project_fiducials, rms_per_axis
from imgcal.synthesis import Corruption, share_of_good_rigs
from imgcal.training.data import Levels, RigBatch, Source, object_to
from imgcal.training.end_to_end import end_to_end_loss
from imgcal.training.experiment import Experiment
from imgcal.training.losses import LossConfig, compound
from imgcal.training.random_streams import FIXED, make_stream
from imgcal.training.task import Loss, Task
from imgcal.types import CalibrationObject, CameraRig, Prediction

LEAST_GOOD = 0.01  # smallest share of random rigs that see everything

Passes = tuple[Prediction, ...]


class RigExperiment(Experiment, NetworkSpec):
    """A network that predicts a whole rig from its cameras' views of the object."""

    model_config = ConfigDict(extra="forbid")

    task: Literal["rig"] = "rig"  # what the network predicts
    rig: str  # factory rig: shipped name or path
    object: str  # calibration object: shipped name or path
    corruption: Corruption = Corruption()  # defects of the views during training
    levels: Levels = Field(default=[])  # of image variants: difficulties in equal shares, instead of `corruption`
    loss: LossConfig = LossConfig()

    def load_rig(self) -> CameraRig:
        """Read the factory rig: float64, without batch axes."""
        return load_rig(self.rig)

    def load_object(self) -> CalibrationObject:
        """Read the calibration object: float64."""
        return load_object(self.object)

    def make_task(self, device: torch.device, batch_size: int, weights: torch.Generator, fresh: bool) -> RigTask:
        """Build the network and its source of rigs; see `Experiment.make_task`."""
        return RigTask(self, device, batch_size, weights, fresh)


def checkpoint_experiment(spec: NetworkSpec) -> RigExperiment:
    """Convert `Checkpoint.experiment` to the complete experiment of a network.

    Raises:
        InputError: it is not an experiment of this version.
    """
    if isinstance(spec, RigExperiment):
        return spec
    return validate(spec.model_dump(mode="json"), RigExperiment, "experiment of a network")


class RigTask(Task[RigBatch, Passes]):
    """Random rigs, and a loss for every pass of a network."""

    unit = "rigs"
    judged = "validation_re_px"
    headline: ClassVar = {"re_px": "RE {:.3g} px", "validation_re_px": "validation RE {:.3g} px"}
    network: Network

    def __init__(
        self, experiment: RigExperiment, device: torch.device, batch_size: int, weights: torch.Generator, fresh: bool
    ) -> None:
        """Build the task; see `Experiment.make_task`."""
        self.experiment = experiment
        self.factory, self.obj = experiment.load_rig(), experiment.load_object()  # float64
        spec = experiment if fresh else drop_pretrained(experiment)
        network, starts = build_network(spec, self.factory, self.obj, weights), experiment.training.starts
        self.untrained = warm_start(starts, network) if fresh and starts else ()
        self.files = {"rig": rig_text(self.factory, experiment.rig), "object": object_text(self.obj, experiment.object)}
        self.network = network.to(device)
        _check_difficulty(experiment, network)
        self.source = Source(
            self.factory.to(torch.float32, device),
            object_to(self.obj, device),
            experiment.drift,
            experiment.poses,
            experiment.corruption,
            network.image_options,
            tuple(experiment.levels),
        )
        if device.type != "cpu":  # avoids waiting for the device; a CPU need not draw more than it uses
            self.source = replace(self.source, good=self._share_of_good(device))
        self.prior_std = experiment.drift.std(self.factory).to(device, torch.float32)  # (C, K)
        fixed = make_stream("validation rigs", FIXED, device=device)
        sizes = experiment.training.validation_sizes(batch_size)
        self.validation = [self.source.sample(size, fixed) for size in sizes]

    def _share_of_good(self, device: torch.device) -> float:
        fixed = make_stream("share of good rigs", FIXED, device=device)
        rig, obj, drift, poses = self.source.factory, self.source.obj, self.source.drift, self.source.pose_range
        found = share_of_good_rigs(rig, obj, fixed, drift=drift, pose_range=poses)
        if found < LEAST_GOOD:
            self.source.sample(1, fixed)  # its error names the camera that misses the object
        return max(found, LEAST_GOOD)

    def batch(self, count: int, generator: torch.Generator) -> RigBatch:
        """Make random rigs and their views."""
        return self.source.show(self.source.sample(count, generator), generator)

    def predict(self, network: nn.Module, batch: RigBatch) -> Passes:
        """Predict the rigs, pass by pass."""
        return network(batch.views)

    def loss(self, answer: Passes, batch: RigBatch, step: int) -> Loss:
        """Compare every pass with the truth."""
        config = self.experiment.loss
        parameters = self.network.parameters()
        terms = compound(answer, batch.truth, self.source.obj, config, step, self.prior_std, parameters)
        refined = end_to_end_loss(answer[-1], batch, self.source, self.prior_std, config.refined)
        passes = terms.passes.unbind()
        earlier = {f"re_pass{t + 1}_px": re for t, re in enumerate(passes[:-1])}
        return Loss(terms.total + refined, {"re_px": passes[-1], **earlier})

    def validate(self, predict: Callable[[RigBatch], Passes]) -> dict[str, float]:
        """RE in pixels of the last pass, on fixed rigs."""
        if not self.validation:
            return {}
        generator = make_stream("validation views", FIXED, device=self.prior_std.device)
        batches = (self.source.show(made, generator) for made in self.validation)
        errors = torch.cat([self.errors(predict(batch)[-1], batch) for batch in batches])
        return {"validation_re_px": float(errors.mean()), "validation_re_median_px": float(errors.median())}

    def errors(self, predicted: Prediction, batch: RigBatch) -> Tensor:
        """RE of each rig of a batch: (B,) pixels."""
        found, true = (project_fiducials(one.cameras_from_object, self.source.obj) for one in (predicted, batch.truth))
        return rms_per_axis(found - true)

    def result(self, network: nn.Module, metrics: Mapping[str, Any]) -> Checkpoint:
        """Return weights with their rig, object and experiment."""
        assert isinstance(network, Network)  # `self.network`, or its running mean
        return Checkpoint(network, self.factory, self.obj, self.experiment, metrics)


def _check_difficulty(experiment: RigExperiment, network: Network) -> None:
    """Refuse settings without effect.

    Raises:
        InputError: levels of images for a network that takes points, or together with `corruption`.
    """
    if experiment.levels and network.image_options is None:
        raise InputError(f"levels: found {experiment.levels}, but the network {experiment.network.preset} takes points")
    if experiment.levels and not experiment.corruption.nothing:
        raise InputError("levels: found together with `corruption`, expected one of them: levels corrupt points, too")

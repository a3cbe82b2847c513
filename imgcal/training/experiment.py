"""Experiment files: YAML, `format: imgcal-experiment/1`. One file says everything about a training run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from imgcal.errors import InputError
from imgcal.io import (
    Flow,
    StrictModel,
    StrictRecord,
    find_file,
    load_object,
    load_rig,
    parse_yaml,
    read_yaml,
    validated,
    write_text,
    yaml_text,
)
from imgcal.messages import quoted
from imgcal.networks import NetworkSpec
from imgcal.synthesis import Corruption
from imgcal.training.losses import LossConfig
from imgcal.types import CalibrationObject, CameraRig

FORMAT = "imgcal-experiment/1"

# Keys as people write them: first what it is about.
ORDER = ("format", "name", "description", "paper", "rig", "object", "poses", "drift", "network", "images")

Spread = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=10**9)]


class PaperRow(StrictModel):
    """Where the paper reports this experiment, and its result."""

    table: str
    row: Count
    re_px: Positive | None = None


class OptimizerConfig(StrictModel):
    """Adam or AdamW with a learning rate for each group of parameters."""

    kind: Literal["adam", "adamw"] = "adamw"
    lr: Positive = 1e-3
    learning_rates: dict[str, Positive] = Field(
        default={}, max_length=64
    )  # by group of the network (encoder, trunk, heads), instead of `lr`
    betas: Annotated[list[Annotated[float, Field(ge=0, lt=1)]], Field(min_length=2, max_length=2)] = Field(
        default=[0.9, 0.99]
    )
    weight_decay: Spread = 0.0  # of matrices only
    clip: Positive | None = 1.0  # largest norm of the gradient
    ema: Annotated[float, Field(gt=0, lt=1)] | None = 0.999  # decay of the running mean of weights that is the result


class ScheduleConfig(StrictModel):
    """How learning rates go: warmup and cosine to zero over the whole run, a plateau, or constant."""

    kind: Literal["cosine", "plateau", "constant"] = "cosine"
    warmup: Fraction = 0.02  # cosine: part of the run
    final: Fraction = 0.0  # cosine: part of the learning rate that is left at the end
    every: Count = 100  # plateau: steps over which the loss is averaged before it is judged
    patience: Annotated[int, Field(ge=0, le=10**9)] = 10  # plateau: judgements without improvement
    factor: Annotated[float, Field(gt=0, lt=1)] = 0.5  # plateau
    threshold: Fraction = 1e-3  # plateau: relative improvement that counts


class TrainingConfig(StrictModel):
    """Length, batch, precision and bookkeeping of a run."""

    steps: Count | None = None  # the run ends after this many steps ...
    minutes: Positive | None = None  # ... or minutes of training, whichever comes first
    batch_size: Annotated[int, Field(ge=1, le=2**16)] = 64  # rigs a step, over all processes
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    precision: Literal["float32", "bf16"] = "float32"  # of the encoder and trunk; geometry is always float32
    device: Literal["auto", "cpu"] = "auto"
    threads: Annotated[int, Field(ge=1, le=256)] | None = None  # of the CPU; None = as the environment says
    init_from: str | None = None  # a checkpoint to start the weights from
    log_every: Count = 50  # steps
    validate_every: Count = 500  # steps
    validation_rigs: Annotated[int, Field(ge=0, le=10**6)] = 512  # 0 = no validation
    save_every: Count = 500  # steps

    @model_validator(mode="after")
    def _ends(self) -> TrainingConfig:
        if self.steps is None and self.minutes is None:
            raise ValueError("found neither `steps` nor `minutes`, expected one of them")
        return self


class Experiment(NetworkSpec):
    """What an experiment file holds: the blocks of `NetworkSpec` and all others."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["imgcal-experiment/1"]
    name: Annotated[str, Field(min_length=1, max_length=200)]
    description: Annotated[str, Field(max_length=10_000)] = ""
    paper: PaperRow | None = None
    rig: str  # shipped name or path
    object: str  # shipped name or path
    corruption: Corruption = Corruption()  # what goes wrong in the views during training
    loss: LossConfig = LossConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    training: TrainingConfig

    def load_rig(self) -> CameraRig:
        """Read the factory rig: float64, without batch axes."""
        return load_rig(self.rig)

    def load_object(self) -> CalibrationObject:
        """Read the calibration object: float64."""
        return load_object(self.object)


def load_experiment(path: str | Path, changes: Iterable[str] = ()) -> Experiment:
    """Read an experiment.

    Args:
        path: a YAML file, or the bare name of a shipped experiment when there is no such file.
        changes: `key.key=value`, values in YAML; the last one wins.

    Raises:
        InputError: one line with the file or the change, what was found and what was expected.

    Examples:
        >>> experiment = load_experiment("table1-row13", ["training.batch_size=8"])
        >>> experiment.network.preset, experiment.training.batch_size
        ('vit', 8)
    """
    path = find_file(path, "experiments", ".yaml")
    return changed(read_yaml(path, Experiment, FORMAT), *changes)


def experiment_of(spec: NetworkSpec) -> Experiment:
    """Read all of what a network was trained by: `Checkpoint.experiment`.

    Raises:
        InputError: it is no experiment of this version.
    """
    if isinstance(spec, Experiment):
        return spec
    return validated(spec.model_dump(mode="json"), Experiment, "experiment of a network")


def changed(experiment: Experiment, *changes: str) -> Experiment:
    """Set values of an experiment: `training.steps=100`, `drift={rotation_deg: 0.5}`; validated when all are set."""
    if not changes:
        return experiment
    content = as_written(experiment)
    for change in changes:
        _apply(content, change)
    return validated(content, Experiment, f"--set {quoted(' '.join(changes))}")


def as_written(experiment: Experiment) -> dict[str, Any]:
    """The plain values of the blocks that were given, without defaults where a block knows what it was given."""
    return experiment.model_dump(exclude_unset=True)


def resolved_text(experiment: Experiment) -> str:
    """All values, defaults included, as YAML."""
    values = _resolved(experiment)
    return yaml_text({name: values[name] for name in dict.fromkeys((*ORDER, *values)) if name in values})


def save_experiment(experiment: Experiment, path: str | Path) -> None:
    """Write an experiment with all its values, so that it stays the same when a default changes."""
    write_text(path, resolved_text(experiment))


def _resolved(model: StrictModel) -> dict[str, Any]:
    """All values but those that are None because nothing was given: a None that switches something off stays."""
    fields = type(model).model_fields
    values = {name: value for name, value in model if value is not None or fields[name].default is not None}
    return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, StrictModel):
        return _resolved(value)
    if isinstance(value, StrictRecord):
        return {name: _plain(field) for name, field in vars(value).items()}
    return Flow(value) if isinstance(value, list | tuple) else value


def _apply(content: dict[str, Any], change: str) -> None:
    where = f"--set {quoted(change)}"
    key, equals, text = change.partition("=")
    steps = key.strip().split(".")
    if not equals or not all(steps):
        raise InputError(f"{where}: found no key and value, expected something like training.steps=100")
    record: Any = content
    for step in steps[:-1]:
        if record.get(step) is None:
            record[step] = {}
        record = record[step]
        if not isinstance(record, dict):
            raise InputError(
                f"{where}: found the value {quoted(repr(record))} at `{quoted(step)}`, expected a group of keys"
            )
    record[steps[-1]] = parse_yaml(text, where)

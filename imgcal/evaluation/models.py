"""Trained networks as they are evaluated: from checkpoints."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from imgcal.errors import InputError
from imgcal.evaluation.methods import Method, network_method
from imgcal.evaluation.protocol import Conditions
from imgcal.evaluation.tables import Facts
from imgcal.io import MODEL, model_file, read_metrics
from imgcal.networks import Checkpoint, check_says_rigs, load_checkpoint
from imgcal.types import CalibrationObject, CameraRig

METRICS = "metrics.jsonl"


@dataclass(frozen=True)
class Model:
    """A network from a file."""

    name: str
    path: Path
    checkpoint: Checkpoint
    method: Method
    history: tuple[dict[str, Any], ...]  # what its training logged, if that lies beside it

    @property
    def parameters(self) -> int:
        """Number of trained values."""
        return sum(parameter.numel() for parameter in self.checkpoint.network.parameters())

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self.path.stat().st_size

    @property
    def facts(self) -> Facts:
        """What reports show about it."""
        spec = self.checkpoint.experiment.model_dump()  # with what networks do not know of it
        seed = (spec.get("training") or {}).get("seed", 0)
        return Facts(self.parameters, self.size, self.history, spec.get("name"), int(seed))

    @property
    def conditions(self) -> Conditions:
        """What it was trained for, without corruption."""
        experiment = self.checkpoint.experiment
        return Conditions(self.checkpoint.rig, self.checkpoint.obj, experiment.poses, experiment.drift)


def load_models(
    paths: Sequence[Path],
    rig: CameraRig | None = None,
    obj: CalibrationObject | None = None,
    device: torch.device | str = "cpu",
    trusted: Collection[str] = (),
) -> list[Model]:
    """Read networks that are to be evaluated on the same rigs.

    Args:
        paths: checkpoints, or folders of training runs.
        rig: what they must be for; None = what the first one is for.
        obj: likewise.
        device: where they run.
        trusted: encoders of yours whose code may run; see `load_checkpoint`.

    Raises:
        InputError: a file that cannot be used, a training of positions, or a network for another rig or object.
    """
    models: list[Model] = []
    if not paths:
        return []
    files = [model_file(path) for path in paths]
    for path, name in zip(files, _names(files), strict=True):
        checkpoint = load_checkpoint(path, rig, obj, trusted=trusted)
        check_says_rigs(path, checkpoint.experiment)
        rig, obj = rig or checkpoint.rig, obj or checkpoint.obj
        network = checkpoint.network.to(device)
        models.append(
            Model(name, path, checkpoint, network_method(network), tuple(read_metrics(path.parent / METRICS)))
        )
    return models


def _names(paths: Sequence[Path]) -> list[str]:
    """Short names that differ: of the file, or of the folder where a training run has put it; and folders above."""
    parts = [(path.parent if path.name == MODEL else path.with_suffix("")).resolve().parts for path in paths]
    for depth in range(1, max(map(len, parts), default=0) + 1):
        names = ["/".join(some[-depth:]) for some in parts]
        if len(set(names)) == len(names):
            return names
    raise InputError(f"models: found {', '.join(map(str, paths))}, expected each one once")

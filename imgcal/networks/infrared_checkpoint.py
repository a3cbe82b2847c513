"""Query networks in files: weights and configuration alone, since they belong to no rig and no object."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from imgcal.errors import InputError
from imgcal.io import read_json, read_tensors, validated, write_tensors
from imgcal.networks.infrared import InfraredConfig, InfraredNetwork
from imgcal.networks.randomness import drawing_from

FORMAT = "imgcal-infrared/1"


@dataclass(frozen=True)
class InfraredCheckpoint:
    """A query network, and what it was found to be worth."""

    network: InfraredNetwork
    metrics: Mapping[str, Any]  # plain values

    def save(self, path: str | Path) -> None:
        """Write it in one step, in bfloat16: its weights need no more.

        Raises:
            InputError: the file cannot be written.
        """
        weights = {name: tensor.to(torch.bfloat16) for name, tensor in self.network.state_dict().items()}
        config = json.dumps(self.network.config.model_dump(mode="json"))
        write_tensors(path, weights, FORMAT, {"config": config, "metrics": json.dumps(dict(self.metrics))})


def load_infrared(path: str | Path) -> InfraredCheckpoint:
    """Read a query network: float32, on the CPU, in evaluation mode.

    Raises:
        InputError: no such file, or something else in it.
    """
    tensors, texts = read_tensors(path, FORMAT)
    try:
        content, metrics = read_json(texts["config"]), read_json(texts["metrics"])
        if not isinstance(content, dict) or not isinstance(metrics, dict):
            raise ValueError("no mapping")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no readable configuration in it, expected one: the file is damaged") from error
    with drawing_from(torch.Generator()):
        network = InfraredNetwork(validated(content, InfraredConfig, f"{path}: config"))
    own = network.state_dict()
    if own.keys() != tensors.keys() or any(own[name].shape != tensors[name].shape for name in own):
        raise InputError(f"{path}: found other weights than its network has: another version of imgcal")
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise InputError(f"{path}: found weights that are not finite, expected a trained network")
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    return InfraredCheckpoint(network.eval(), metrics)

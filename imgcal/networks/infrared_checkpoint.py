"""Checkpoints of networks for captured frames: weights and configuration only, because they fit any rig and object."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.io import StrictModel, read_json, read_tensors, validate, write_tensors
from imgcal.networks.infrared import InfraredConfig, InfraredNetwork
from imgcal.networks.measurer import Measurer, MeasurerConfig
from imgcal.networks.randomness import use_generators

INFRARED, MEASURER = "imgcal-infrared/1", "imgcal-measurer/1"

EARLIER = {
    "norm_attention": "attention_norm",
    "to_qkv": "query_key_value",
    "from_heads": "attention_out",
    "norm_mlp": "mlp_norm",
}
"""Names of a transformer block's parts in files of earlier versions, and their current names."""

Config = TypeVar("Config", bound=StrictModel)


@dataclass(frozen=True)
class InfraredCheckpoint:
    """A query network with its measured quality."""

    network: InfraredNetwork
    metrics: Mapping[str, Any]  # plain values

    def save(self, path: str | Path) -> None:
        """Write the checkpoint in one step, in bfloat16, which is accurate enough for its weights.

        Raises:
            InputError: the file cannot be written.
        """
        _write(path, INFRARED, self.network, self.network.config, self.metrics)


@dataclass(frozen=True)
class MeasurerCheckpoint:
    """A measurer with its measured quality."""

    network: Measurer
    metrics: Mapping[str, Any]  # plain values

    def save(self, path: str | Path) -> None:
        """Write the checkpoint in one step, in bfloat16; see `InfraredCheckpoint.save`."""
        _write(path, MEASURER, self.network, self.network.config, self.metrics)


def load_infrared(path: str | Path) -> InfraredCheckpoint:
    """Load a query network: float32, on the CPU, in evaluation mode.

    Raises:
        InputError: no such file, or other content.
    """
    config, tensors, metrics = _read(path, INFRARED, InfraredConfig)
    with use_generators(torch.Generator()):
        network = InfraredNetwork(config)
    _fill(path, network, tensors)
    return InfraredCheckpoint(network.eval(), metrics)


def load_measurer(path: str | Path) -> MeasurerCheckpoint:
    """Load a measurer; see `load_infrared`."""
    config, tensors, metrics = _read(path, MEASURER, MeasurerConfig)
    with use_generators(torch.Generator()):
        network = Measurer(config)
    _fill(path, network, tensors)
    return MeasurerCheckpoint(network.eval(), metrics)


def _write(path: str | Path, tag: str, network: nn.Module, config: StrictModel, metrics: Mapping[str, Any]) -> None:
    weights = {name: tensor.to(torch.bfloat16) for name, tensor in network.state_dict().items()}
    texts = {"config": json.dumps(config.model_dump(mode="json")), "metrics": json.dumps(dict(metrics))}
    write_tensors(path, weights, tag, texts)


def read_weights(path: str | Path, tag: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read tensors by their current names, and texts; see `read_tensors`."""
    tensors, texts = read_tensors(path, tag)
    named = {".".join(EARLIER.get(part, part) for part in name.split(".")): each for name, each in tensors.items()}
    return named, texts


def _read(path: str | Path, tag: str, kind: type[Config]) -> tuple[Config, dict[str, Tensor], dict[str, Any]]:
    tensors, texts = read_weights(path, tag)
    try:
        content, metrics = read_json(texts["config"]), read_json(texts["metrics"])
        if not isinstance(content, dict) or not isinstance(metrics, dict):
            raise ValueError("no mapping")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no readable configuration in it, expected one: the file is damaged") from error
    return validate(content, kind, f"{path}: config"), tensors, metrics


def _fill(path: str | Path, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    own = network.state_dict()
    if own.keys() != tensors.keys() or any(own[name].shape != tensors[name].shape for name in own):
        raise InputError(f"{path}: found other weights than its network has: another version of imgcal")
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise InputError(f"{path}: found weights that are not finite, expected a trained network")
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})

"""Networks in files: weights together with the rig, the object and the experiment that they belong to."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.io import (
    model_file,
    object_from_text,
    object_text,
    read_json,
    read_tensors,
    read_texts,
    rig_from_text,
    rig_text,
    title_of,
    validated,
    write_tensors,
)
from imgcal.messages import shortened
from imgcal.networks.config import NetworkSpec, without_pretrained
from imgcal.networks.factory import build_network
from imgcal.networks.network import Network
from imgcal.networks.refiner import IterativeRefiner
from imgcal.networks.subject import check_object, check_rig
from imgcal.types import CalibrationObject, CameraRig

FORMAT = "imgcal-network/1"


@dataclass(frozen=True)
class Checkpoint:
    """A network and what it was trained for."""

    network: Network
    rig: CameraRig  # factory rig, float64, without batch axes
    obj: CalibrationObject  # float64
    experiment: NetworkSpec  # what it was trained by; `imgcal.training.experiment_of` reads all of it
    metrics: Mapping[str, Any]  # results to keep with it; plain values

    @property
    def drift_std(self) -> Tensor:
        """Spread of the parameters that the network was trained for: (C, 15) float64, the prior of a refinement."""
        return self.experiment.drift.std(self.rig)

    def save(self, path: str | Path) -> None:
        """Write it: `save_checkpoint`, in full precision."""
        save_checkpoint(path, self)


def save_checkpoint(path: str | Path, checkpoint: Checkpoint, dtype: torch.dtype = torch.float32) -> None:
    """Write a network and what it was trained for in one step.

    Args:
        path: the file, named *.safetensors.
        checkpoint: the network may be on any device.
        dtype: of the stored parameters: bfloat16 halves the file. Buffers keep theirs.

    Raises:
        InputError: the file cannot be written.
    """
    network, obj = checkpoint.network, checkpoint.obj
    parameters = {name for name, _ in network.named_parameters(remove_duplicate=False)}
    tensors = {
        name: tensor.to(dtype) if name in parameters and tensor.is_floating_point() else tensor
        for name, tensor in network.state_dict().items()
    }
    texts = {
        "experiment": json.dumps(checkpoint.experiment.model_dump(mode="json")),
        "metrics": json.dumps(dict(checkpoint.metrics)),
        "rig": rig_text(checkpoint.rig, f"{path}: rig"),
        "object": object_text(obj, f"{path}: object"),
        "object_name": obj.name,
    }
    write_tensors(path, tensors, FORMAT, texts)


def load_network(path: str | Path, rig: CameraRig | None = None, obj: CalibrationObject | None = None) -> Network:
    """Read a network: `load_checkpoint` without what stands beside it."""
    return load_checkpoint(path, rig, obj).network


def load_checkpoint(path: str | Path, rig: CameraRig | None = None, obj: CalibrationObject | None = None) -> Checkpoint:
    """Read a network and what it was trained for.

    Args:
        path: a file written by `save_checkpoint`.
        rig: the rig it is to be used with; None = whatever it was trained for.
        obj: the object it is to be used with; None = whatever it was trained for.

    Returns:
        The checkpoint; the network is in evaluation mode, float32, on the CPU.

    Raises:
        InputError: not such a file, damaged, another version, a pickle, or trained for another rig or object.
    """
    texts = read_texts(path, FORMAT)
    spec, metrics = _read_records(path, texts)
    trained_rig, trained_obj = _from_texts(path, texts)
    if rig is not None:
        check_rig(path, trained_rig, rig)
    if obj is not None:
        check_object(path, trained_obj, obj)
    tensors, _ = read_tensors(path, FORMAT)
    network = build_network(without_pretrained(spec), trained_rig, trained_obj, torch.Generator())
    _fill(path, network, tensors)
    return Checkpoint(network.eval(), trained_rig, trained_obj, spec, metrics)


def read_subject(path: str | Path) -> tuple[CameraRig, CalibrationObject]:
    """Read the rig and the object that a network was trained for, and not the network.

    Raises:
        InputError: not such a file, damaged, another version, or a pickle.
    """
    return _from_texts(path, read_texts(path, FORMAT))


def warm_start(path: str | Path, network: nn.Module) -> tuple[str, ...]:
    """Take over the parameters of a checkpoint that fit by name and shape, whatever rig or drift it was trained for.

    Args:
        path: a file, the folder of a training run, or the name of a shipped network.
        network: takes them over.

    Returns:
        Names of the network's parameters that were not in the checkpoint, or had another shape there.

    Raises:
        InputError: the file cannot be used, or nothing in it fits.
    """
    path = model_file(path)
    tensors, texts = read_tensors(path, FORMAT)
    own = dict(network.named_parameters())
    fitting = [name for name in own if name in tensors and tensors[name].shape == own[name].shape]
    if not fitting:
        raise InputError(f"{path}: found no parameter that fits the network by name and shape, expected some")
    with torch.no_grad():
        for name in fitting:
            own[name].copy_(tensors[name])
    trunk = getattr(network, "trunk", None)
    if isinstance(trunk, IterativeRefiner):
        spec, _ = _read_records(path, texts)
        trunk.rescale(spec.drift.std(_from_texts(path, texts)[0]))
    return tuple(name for name in own if name not in fitting)


def _fill(path: str | Path, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    own = network.state_dict()
    wrong = sorted(own.keys() ^ tensors.keys()) or sorted(n for n in own if own[n].shape != tensors[n].shape)
    if wrong:
        more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        raise InputError(
            f"{path}: found other weights than its network has ({wrong[0]}{more}): another version of imgcal"
        )
    weights = {name: tensor.to(own[name].dtype) for name, tensor in tensors.items()}
    broken = next((name for name, tensor in weights.items() if not bool(tensor.isfinite().all())), None)
    if broken is not None:
        raise InputError(f"{path}: found weights that are not finite ({shortened(broken)}), expected a trained network")
    network.load_state_dict(weights)


def _read_records(path: str | Path, texts: dict[str, str]) -> tuple[NetworkSpec, dict[str, Any]]:
    try:
        content, metrics = read_json(texts["experiment"]), read_json(texts["metrics"])
        if not isinstance(content, dict) or not isinstance(metrics, dict):
            raise ValueError("no mapping")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no readable experiment in it, expected one: the file is damaged") from error
    return validated(content, NetworkSpec, f"{path}: experiment"), metrics


def _from_texts(path: str | Path, texts: dict[str, str]) -> tuple[CameraRig, CalibrationObject]:
    """Read rig and object from the text of their files."""
    try:
        name = title_of(Path(texts["object_name"]))
        return rig_from_text(texts["rig"], "rig"), object_from_text(texts["object"], "object", name)
    except (KeyError, InputError) as error:
        raise InputError(f"{path}: found no readable rig and object in it, expected both: {error}") from error

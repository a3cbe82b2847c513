"""Checkpoints: network weights in a file together with their rig, object and experiment."""

from __future__ import annotations

import copy
import json
from collections.abc import Collection, Mapping, Sequence
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
    title_from_name,
    validate,
    write_tensors,
)
from imgcal.messages import quote, shorten
from imgcal.networks.config import NetworkSpec, drop_pretrained, is_import_path
from imgcal.networks.factory import build_network
from imgcal.networks.infrared import InfraredNetwork
from imgcal.networks.infrared_checkpoint import INFRARED, MEASURER, read_weights
from imgcal.networks.measurer import Measurer
from imgcal.networks.network import Network
from imgcal.networks.refiner import IterativeRefiner
from imgcal.types import CalibrationObject, CameraRig, object_difference, rig_difference

FORMAT = "imgcal-network/1"
FORMATS_OF_FRAMES: dict[type[nn.Module], str] = {InfraredNetwork: INFRARED, Measurer: MEASURER}


@dataclass(frozen=True)
class Checkpoint:
    """A network with the rig, object and experiment of its training."""

    network: Network
    rig: CameraRig  # factory rig, float64, without batch axes
    obj: CalibrationObject  # float64
    experiment: NetworkSpec  # of the training; `imgcal.training.checkpoint_experiment` reads all of it
    metrics: Mapping[str, Any]  # results to store with the network; plain values

    @property
    def drift_std(self) -> Tensor:
        """Standard deviations of the drift in training: (C, K) float64, the prior of a refinement."""
        return self.experiment.drift.std(self.rig)

    def save(self, path: str | Path) -> None:
        """Write the checkpoint with `save_checkpoint`, in full precision."""
        save_checkpoint(path, self)


def save_checkpoint(path: str | Path, checkpoint: Checkpoint, dtype: torch.dtype = torch.float32) -> None:
    """Write a network with the rig, object and experiment of its training, in one step.

    Args:
        path: the file, named *.safetensors.
        checkpoint: the network may be on any device.
        dtype: of the stored parameters: bfloat16 halves the file. Buffers keep their dtype.

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


def load_network(
    path: str | Path,
    rig: CameraRig | None = None,
    obj: CalibrationObject | None = None,
    *,
    trusted: Collection[str] = (),
) -> Network:
    """Load only the network of a checkpoint."""
    return load_checkpoint(path, rig, obj, trusted=trusted).network


def load_checkpoint(
    path: str | Path,
    rig: CameraRig | None = None,
    obj: CalibrationObject | None = None,
    *,
    trusted: Collection[str] = (),
) -> Checkpoint:
    """Load a network with the rig, object and experiment of its training.

    Args:
        path: a file written by `save_checkpoint`.
        rig: the rig for which it will be used; None = the rig of its training.
        obj: the object for which it will be used; None = the object of its training.
        trusted: your own classes, `package.module:Class`, that the file may name as its encoder: their modules are
            imported, which runs their code.

    Returns:
        The checkpoint; the network is in evaluation mode, float32, on the CPU.

    Raises:
        InputError: no checkpoint, a damaged file, another version, a pickle, a network for another rig or object, or a
            custom encoder that is not trusted; a trusted name that is no `package.module:Class`.
    """
    if wrong := [name for name in trusted if not is_import_path(name)]:
        raise InputError(f"trusted: found {shorten(wrong[0])!r}, expected a class as package.module:Class")
    texts = read_texts(path, FORMAT)
    spec, metrics = _read_records(path, texts)
    _check_code(path, spec, trusted)
    trained_rig, trained_obj = _parse_texts(path, texts)
    if rig is not None:
        check_rig(path, trained_rig, rig)
    if obj is not None:
        check_object(path, trained_obj, obj)
    tensors, _ = read_tensors(path, FORMAT)
    network = build_network(drop_pretrained(spec), trained_rig, trained_obj, torch.Generator())
    _fill(path, network, tensors)
    return Checkpoint(network.eval(), trained_rig, trained_obj, spec, metrics)


def read_subject(path: str | Path) -> tuple[CameraRig, CalibrationObject]:
    """Read the rig and the object of a checkpoint, without the network.

    Raises:
        InputError: no checkpoint, a damaged file, another version, or a pickle.
    """
    return _parse_texts(path, read_texts(path, FORMAT))


def warm_start(start: str | Path | Sequence[str | Path], network: nn.Module) -> tuple[str, ...]:
    """Copy the weights of checkpoints that match by name and shape, whatever rig or drift they were trained for.

    Args:
        start: a file, the folder of a training run, or the name of a shipped network; or several, where later ones
            override earlier ones.
        network: receives the weights: parameters, and buffers such as the running means of batch normalization.

    Returns:
        Names of the network's weights that no checkpoint has with the same shape.

    Raises:
        InputError: a file cannot be used, or none of its weights match.
    """
    missing = [set(_take_over(path, network)) for path in ([start] if isinstance(start, str | Path) else start)]
    return tuple(name for name in network.state_dict() if all(name in names for names in missing))


def _take_over(path: str | Path, network: nn.Module) -> tuple[str, ...]:
    """Do the work of `warm_start` for one file."""
    path = model_file(path)
    tag = FORMATS_OF_FRAMES.get(type(network))
    tensors, texts = read_tensors(path, FORMAT) if tag is None else read_weights(path, tag)
    own = network.state_dict()
    fitting = [name for name in own if name in tensors and tensors[name].shape == own[name].shape]
    spec = None if tag is not None else _read_records(path, texts)[0]
    if spec is not None and is_position_training(spec):
        fitting = [name for name in fitting if name.startswith("positions.")]  # the rest is untrained
    if not fitting:
        raise InputError(f"{path}: found no weights that match the network by name and shape")
    # A copy of the network converts this file's weights; those from other files stay as they are.
    source = copy.deepcopy(network)
    source.load_state_dict({name: tensors[name] for name in fitting}, strict=False)
    trunk = getattr(source, "trunk", None)
    if spec is not None and isinstance(trunk, IterativeRefiner):
        trunk.rescale(spec.drift.std(_parse_texts(path, texts)[0]))
    converted = source.state_dict()
    network.load_state_dict({name: converted[name] for name in fitting}, strict=False)
    return tuple(name for name in own if name not in fitting)


def _check_code(path: str | Path, spec: NetworkSpec, trusted: Collection[str]) -> None:
    """Refuse a file that would import an untrusted module.

    Raises:
        InputError: its encoder is a custom class that is not among the trusted ones.
    """
    backbone = getattr(spec.network.variant(), "backbone", "")
    if is_import_path(backbone) and backbone not in trusted:
        raise InputError(
            f"{path}: found the encoder {quote(backbone)}, whose code would run; expected one of imgcal or timm. "
            f"If you trust it: --trust {quote(backbone)}, in Python load_checkpoint(..., trusted=(...,))"
        )


def _fill(path: str | Path, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    if "belief.weight" in tensors:
        raise InputError(
            f"{path}: found an image network that reads positions by hue, from an earlier version of imgcal; "
            "expected one whose encoder locates them: train it again"
        )
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
        raise InputError(f"{path}: found weights that are not finite ({shorten(broken)}), expected a trained network")
    network.load_state_dict(weights)


def _read_records(path: str | Path, texts: dict[str, str]) -> tuple[NetworkSpec, dict[str, Any]]:
    try:
        content, metrics = read_json(texts["experiment"]), read_json(texts["metrics"])
        if not isinstance(content, dict) or not isinstance(metrics, dict):
            raise ValueError("no mapping")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no readable experiment in it, expected one: the file is damaged") from error
    return validate(content, NetworkSpec, f"{path}: experiment"), metrics


def _parse_texts(path: str | Path, texts: dict[str, str]) -> tuple[CameraRig, CalibrationObject]:
    """Parse rig and object from the texts of their files."""
    try:
        name = title_from_name(Path(texts["object_name"]))
        return rig_from_text(texts["rig"], "rig"), object_from_text(texts["object"], "object", name)
    except (KeyError, InputError) as error:
        raise InputError(f"{path}: found no readable rig and object in it, expected both: {error}") from error


def check_rig(path: str | Path, trained: CameraRig, rig: CameraRig) -> None:
    """Compare the factory values of two rigs.

    Raises:
        InputError: they differ; names the first camera and value that do.
    """
    difference = rig_difference(rig, trained)
    if difference is not None:
        raise InputError(f"{path}: trained for another rig than {rig.name} ({trained.name}): {difference}")


def is_position_training(experiment: NetworkSpec) -> bool:
    """Check whether a training was one of positions, which leaves the trunk untrained."""
    return getattr(experiment, "task", None) == "positions"


def check_says_rigs(path: str | Path, experiment: NetworkSpec) -> None:
    """Refuse a network that was trained only to find positions, not to predict rigs.

    Raises:
        InputError: the training's task was `positions`.
    """
    if is_position_training(experiment):
        raise InputError(
            f"{path}: found a training of positions, whose trunk is untrained; expected one of rigs, which starts "
            "from it by `training.init_from`"
        )


def check_object(path: str | Path, trained: CalibrationObject, obj: CalibrationObject) -> None:
    """Compare the fiducials of two objects, their radii included.

    Raises:
        InputError: they differ; names the first fiducial that does.
    """
    difference = object_difference(obj, trained)
    if difference is not None:
        raise InputError(f"{path}: trained for another object than {obj.name} ({trained.name}): {difference}")

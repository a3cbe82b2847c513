"""Networks in files: weights together with the rig, the object and the experiment that they belong to."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from imgcal import networks
from imgcal.errors import InputError
from imgcal.io import (
    load_object,
    load_rig,
    read_json,
    read_tensors,
    read_texts,
    save_object,
    save_rig,
    title_of,
    validated,
    write_tensors,
)
from imgcal.messages import shortened
from imgcal.networks import IterativeRefiner
from imgcal.training.experiment import Experiment
from imgcal.types import CalibrationObject, CameraRig

FORMAT = "imgcal-network/1"

# Two factory values that agree to this (relative; mm, pixels and rad alike) are the same: both came through text.
SAME = 1e-6


@dataclass(frozen=True)
class Checkpoint:
    """A network and what it was trained for."""

    network: nn.Module
    rig: CameraRig  # factory rig, float64, without batch axes
    obj: CalibrationObject  # float64
    experiment: Experiment
    metrics: dict[str, Any]

    @property
    def drift_std(self) -> Tensor:
        """Spread of the parameters that the network was trained for: (C, 15) float64, the prior of a refinement."""
        return self.experiment.drift.std(self.rig)


def build_network(experiment: Experiment, rig: CameraRig, obj: CalibrationObject) -> nn.Module:
    """Make the untrained network of an experiment, with float32 factory values.

    Raises:
        InputError: the experiment says how to draw images, and its network takes points.
    """
    single = torch.float32
    prior_std = experiment.drift.std(rig).to(single)
    network: nn.Module = networks.build(experiment.network, rig.to(single), obj, prior_std)
    if experiment.images is not None:
        if network.image_options is None:
            raise InputError(f"images: found this block, but the network {experiment.network.preset} takes points")
        network.image_options = experiment.images  # type: ignore[assignment]
    return network


def without_pretrained(experiment: Experiment) -> Experiment:
    """The same without published weights, which are not to be asked for where others replace them."""
    network = experiment.network
    if "pretrained" not in network.change:
        return experiment
    plain = network.model_copy(update={"change": {**network.change, "pretrained": False}})
    return experiment.model_copy(update={"network": plain})


def save_network(
    path: str | Path,
    network: nn.Module,
    experiment: Experiment,
    metrics: dict[str, Any],
    dtype: torch.dtype = torch.float32,
    rig: CameraRig | None = None,
) -> None:
    """Write a network in one step.

    Args:
        path: the file, named *.safetensors.
        network: made by `build_network`, on any device.
        experiment: what it was trained by.
        metrics: results to keep with it; plain values.
        dtype: of the stored parameters: bfloat16 halves the file. Buffers, such as factory values, keep theirs.
        rig: the factory rig in full precision; None = the float32 one of the network.

    Raises:
        InputError: the file cannot be written.
    """
    parameters = {name for name, _ in network.named_parameters(remove_duplicate=False)}
    tensors = {
        name: tensor.to(dtype) if name in parameters and tensor.is_floating_point() else tensor
        for name, tensor in network.state_dict().items()
    }
    texts = {
        "experiment": json.dumps(experiment.model_dump(mode="json")),
        "metrics": json.dumps(metrics),
        **_texts_of(network.factory if rig is None else rig, network.obj),  # type: ignore[arg-type]
    }
    write_tensors(path, tensors, FORMAT, texts)


def load_network(path: str | Path, rig: CameraRig | None = None, obj: CalibrationObject | None = None) -> nn.Module:
    """Read a network: `load_checkpoint` without what stands beside it."""
    return load_checkpoint(path, rig, obj).network


def load_checkpoint(path: str | Path, rig: CameraRig | None = None, obj: CalibrationObject | None = None) -> Checkpoint:
    """Read a network and what it was trained for.

    Args:
        path: a file written by `save_network`.
        rig: the rig it is to be used with; None = whatever it was trained for.
        obj: the object it is to be used with; None = whatever it was trained for.

    Returns:
        The checkpoint; the network is in evaluation mode, float32, on the CPU.

    Raises:
        InputError: not such a file, damaged, another version, a pickle, or trained for another rig or object.
    """
    texts = read_texts(path, FORMAT)
    experiment, metrics = _read_records(path, texts)
    trained_rig, trained_obj = _from_texts(path, texts)
    if rig is not None:
        check_rig(path, trained_rig, rig)
    if obj is not None:
        check_object(path, trained_obj, obj)
    tensors, _ = read_tensors(path, FORMAT)
    network = build_network(without_pretrained(experiment), trained_rig, trained_obj)
    _fill(path, network, tensors)
    return Checkpoint(network.eval(), trained_rig, trained_obj, experiment, metrics)


def read_subject(path: str | Path) -> tuple[CameraRig, CalibrationObject]:
    """Read the rig and the object that a network was trained for, and not the network.

    Raises:
        InputError: not such a file, damaged, another version, or a pickle.
    """
    return _from_texts(path, read_texts(path, FORMAT))


def warm_start(path: str | Path, network: nn.Module) -> tuple[str, ...]:
    """Take over the parameters of a checkpoint that fit by name and shape, whatever rig or drift it was trained for.

    Returns:
        Names of the network's parameters that were not in the checkpoint, or had another shape there.

    Raises:
        InputError: the file cannot be used, or nothing in it fits.
    """
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
        experiment, _ = _read_records(path, texts)
        trunk.rescale(experiment.drift.std(_from_texts(path, texts)[0]))
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


def _read_records(path: str | Path, texts: dict[str, str]) -> tuple[Experiment, dict[str, Any]]:
    try:
        content, metrics = read_json(texts["experiment"]), read_json(texts["metrics"])
        if not isinstance(content, dict) or not isinstance(metrics, dict):
            raise ValueError("no mapping")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no readable experiment in it, expected one: the file is damaged") from error
    return validated(content, Experiment, f"{path}: experiment"), metrics


def _texts_of(rig: CameraRig, obj: CalibrationObject) -> dict[str, str]:
    """Rig and object as the text of their files."""
    with tempfile.TemporaryDirectory() as folder:
        rig_file, object_file = Path(folder, "rig.yaml"), Path(folder, "object.csv")
        save_rig(rig, rig_file)
        save_object(obj, object_file)
        return {"rig": rig_file.read_text("utf-8"), "object": object_file.read_text("utf-8"), "object_name": obj.name}


def _from_texts(path: str | Path, texts: dict[str, str]) -> tuple[CameraRig, CalibrationObject]:
    with tempfile.TemporaryDirectory() as folder:
        rig_file, object_file = Path(folder, "rig.yaml"), Path(folder, "object.csv")
        try:
            rig_file.write_text(texts["rig"], "utf-8")
            object_file.write_text(texts["object"], "utf-8")
            name = title_of(Path(texts["object_name"]))
            return load_rig(rig_file), replace(load_object(object_file), name=name)
        except (KeyError, InputError) as error:
            raise InputError(f"{path}: found no readable rig and object in it, expected both: {error}") from error


def check_rig(path: str | Path, trained: CameraRig, rig: CameraRig) -> None:
    """Compare the factory values of two rigs.

    Raises:
        InputError: they differ; names the first camera and value that do.
    """

    def refuse(what: str, found: str, expected: str) -> None:
        before = f"{path}: trained for another rig than {rig.name} ({trained.name})"
        raise InputError(f"{before}: {what}: found {found}, expected {expected}")

    if rig.camera_names != trained.camera_names:
        refuse("cameras", ", ".join(rig.camera_names), ", ".join(trained.camera_names))
    values: dict[str, Callable[[CameraRig], Tensor]] = {
        "image size": lambda r: r.image_size,
        "focal length": lambda r: r.focal_length,
        "principal point": lambda r: r.principal_point,
        "distortion": lambda r: r.distortion,
        "position": lambda r: r.positions,
        "rotation": lambda r: r.cam_from_rig.rotation.flatten(-2),
    }
    for what, value in values.items():
        found, expected = value(rig).double().cpu(), value(trained).double().cpu()
        apart = ~torch.isclose(found, expected, rtol=SAME, atol=SAME * float(expected.abs().max().clamp_min(1)))
        for camera in apart.any(-1).nonzero().flatten().tolist():
            place = f"{what} of {rig.camera_names[camera]}"
            refuse(place, _numbers(found[camera]), _numbers(expected[camera]))


def check_object(path: str | Path, trained: CalibrationObject, obj: CalibrationObject) -> None:
    """Compare the fiducials of two objects, their radii included.

    Raises:
        InputError: they differ; names the first fiducial that does.
    """
    before = f"{path}: trained for another object than {obj.name} ({trained.name})"
    if obj.num_fiducials != trained.num_fiducials:
        raise InputError(f"{before}: found {obj.num_fiducials} fiducials, expected {trained.num_fiducials}")
    columns = [
        (o.points.double(), o.points.new_zeros(o.num_fiducials) if o.radius is None else o.radius)
        for o in (obj, trained)
    ]
    found, expected = (torch.cat((points, radius.to(points)[:, None]), 1).cpu() for points, radius in columns)
    apart = (found - expected).abs().amax(1) > SAME * max(trained.size, 1.0)
    if apart.any():
        row = int(apart.nonzero()[0])
        values = f"found x, y, z, radius {_numbers(found[row])}, expected {_numbers(expected[row])}"
        raise InputError(f"{before}: fiducial {row + 1}: {values}")


def _numbers(values: Tensor) -> str:
    return ", ".join(f"{value:.8g}" for value in values.tolist())

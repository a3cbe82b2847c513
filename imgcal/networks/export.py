"""Export of networks to other runtimes: a tensor-only program (`Program`), as ONNX or as a `torch.export` program.

ONNX is made from the graph of `torch.export` by the TorchScript exporter, which needs no library but `onnx`. Operations
that it does not support are rewritten first (`_rewrite`). Shapes are fixed in ONNX.
"""

from __future__ import annotations

import io
import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.io import read_texts, write_bytes
from imgcal.networks.checkpoint import FORMAT, load_checkpoint
from imgcal.networks.infrared import InfraredNetwork, Queries
from imgcal.networks.infrared_checkpoint import INFRARED, MEASURER, load_infrared, load_measurer
from imgcal.networks.measurer import Measurer
from imgcal.networks.network import Network
from imgcal.types import PATCH_SIZE, BlobKind, Views

OPSET = 18
TOLERANCE = 1e-4
"""Largest difference from PyTorch, relative to the largest number of an output."""


@dataclass(frozen=True)
class Program:
    """A network as a function of tensors."""

    kind: str  # measurer, query network, point network
    module: nn.Module  # takes the inputs in order, returns the outputs as a tuple
    inputs: dict[str, str]  # name -> type, shape and meaning; the first axis is the batch
    outputs: dict[str, str]
    example: tuple[Tensor, ...]  # inputs

    def metadata(self) -> dict[str, str]:
        """Metadata for the file."""
        return {"imgcal": self.kind, "inputs": json.dumps(self.inputs), "outputs": json.dumps(self.outputs)}


def _pack(tensor: Tensor) -> Tensor:
    """Copy into rows one after another: a traced program keeps views that no other layout in memory allows."""
    return tensor.clone(memory_format=torch.contiguous_format)


class _Measurer(nn.Module):
    def __init__(self, network: Measurer) -> None:
        super().__init__()
        self.network = network

    def forward(self, patches: Tensor, radius: Tensor) -> tuple[Tensor, ...]:
        found = self.network(_pack(patches), radius)
        return found.offset, found.log_sigma, found.kind


class _Query(nn.Module):
    def __init__(self, network: InfraredNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, crops: Tensor, place: Tensor, radius: Tensor, depth: Tensor, asked: Tensor) -> tuple[Tensor, ...]:
        found = self.network(_pack(crops), Queries(*map(_pack, (place, radius, depth, asked))))
        return found.logits, found.offset, found.log_sigma, found.present, found.cells


class _Points(nn.Module):
    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, uv: Tensor, seen: Tensor) -> tuple[Tensor, ...]:
        found = self.network(Views(uv=_pack(uv), seen=_pack(seen)))[-1]
        rig, pose = found.rig, found.rig_from_object
        lens = (rig.focal_length, rig.principal_point, rig.distortion)
        return *lens, rig.cam_from_rig.rotation, rig.cam_from_rig.translation, pose.rotation, pose.translation


def load_program(path: Path, count: int = 1, fiducials: int = 8) -> Program:
    """Load a trained network as a program.

    Args:
        path: any of our weight files.
        count: patches, crops or snapshots of the example, and of an ONNX file.
        fiducials: of the object, for networks that serve any object.

    Raises:
        InputError: no such file, other content, or a network of images.
    """
    loaders: dict[str, Callable[[], Program]] = {
        MEASURER: lambda: _measurer(load_measurer(path).network, count),
        INFRARED: lambda: _query(load_infrared(path).network, count, fiducials),
        FORMAT: lambda: _points(path, load_checkpoint(path).network, count),
    }
    for tag, load in loaders.items():
        try:
            read_texts(path, tag)
        except InputError:
            if tag == FORMAT:
                raise
            continue
        program = load()
        program.module.eval().requires_grad_(False)
        return program
    raise AssertionError


def _measurer(network: Measurer, count: int) -> Program:
    generator = torch.Generator().manual_seed(0)
    kinds = ", ".join(kind.name.lower() for kind in BlobKind)
    inputs = {
        "patches": f"float32 ({count}, {PATCH_SIZE}, {PATCH_SIZE}): grey, the marker in the middle, normalized",
        "radius": f"float32 ({count}): expected radius, pixels",
    }
    outputs = {
        "offset": f"float32 ({count}, 2): pixels from the middle of the patch to the marker's centre",
        "log_sigma": f"float32 ({count}): log of its standard deviation, pixels",
        "kind": f"float32 ({count}, {len(BlobKind)}): logits of {kinds}",
    }
    patches = torch.randn(count, PATCH_SIZE, PATCH_SIZE, generator=generator)
    return Program(
        "measurer", _Measurer(network), inputs, outputs, (patches, 1 + 3 * torch.rand(count, generator=generator))
    )


def _query(network: InfraredNetwork, count: int, fiducials: int) -> Program:
    generator, size, cells = torch.Generator().manual_seed(0), network.config.crop, network.config.window
    each, window = f"({count}, {fiducials})", f"({count}, {fiducials}, {cells}, {cells}"
    inputs = {
        "crops": f"float32 ({count}, {size}, {size}): grey, normalized",
        "place": f"float32 ({count}, {fiducials}, 2): where the fiducials are expected, crop pixels",
        "radius": f"float32 {each}: of the marker's image, crop pixels",
        "depth": f"float32 {each}: distance from the camera's plane over the mean of all fiducials, minus 1",
        "asked": f"bool {each}: expected in view; false for those that the object does not have",
    }
    outputs = {
        "logits": f"float32 {window}): of the fiducial's cell",
        "offset": f"float32 {window}, 2): crop pixels from the cell's middle to the marker's",
        "log_sigma": f"float32 {window}): log of the standard deviation of the offset, crop pixels",
        "present": f"float32 {each}: logit that the fiducial is seen in its window",
        "cells": f"float32 {window}, 2): the cells' middles, crop pixels",
    }
    example = (
        torch.randn(count, size, size, generator=generator),
        size * (0.25 + 0.5 * torch.rand(count, fiducials, 2, generator=generator)),
        1 + 3 * torch.rand(count, fiducials, generator=generator),
        0.05 * torch.randn(count, fiducials, generator=generator),
        torch.rand(count, fiducials, generator=generator) > 0.1,
    )
    return Program("query network", _Query(network), inputs, outputs, example)


def _points(path: Path, network: Network, count: int) -> Program:
    if network.image_options is not None:
        kind = "found an image network, which locates fiducials with compiled code that cannot be exported"
        raise InputError(f"{path}: {kind}; expected a point network, a query network or a measurer")
    generator, rig, obj = torch.Generator().manual_seed(0), network.factory, network.obj
    cameras, fiducials = rig.num_cameras, obj.num_fiducials
    points = obj.points - obj.points.mean(0) + torch.tensor([0.0, 0.0, rig.working_distance])
    uv = rig.project(points).uv.nan_to_num()
    uv = uv + 3 * torch.randn(count, *uv.shape, generator=generator)
    inputs = {
        "uv": f"float32 ({count}, {cameras}, {fiducials}, 2): pixels, {rig.name}'s cameras, {obj.name}'s fiducials",
        "seen": f"bool ({count}, {cameras}, {fiducials}): where false, uv is ignored",
    }
    lens = rig.distortion.shape[-1]
    outputs = {
        "focal_length": f"float32 ({count}, {cameras}, 2): pixels",
        "principal_point": f"float32 ({count}, {cameras}, 2): pixels",
        "distortion": f"float32 ({count}, {cameras}, {lens})",
        "cam_from_rig_rotation": f"float32 ({count}, {cameras}, 3, 3)",
        "cam_from_rig_translation": f"float32 ({count}, {cameras}, 3): mm",
        "rig_from_object_rotation": f"float32 ({count}, 3, 3)",
        "rig_from_object_translation": f"float32 ({count}, 3): mm",
    }
    seen = torch.rand(count, cameras, fiducials, generator=generator) > 0.1
    return Program("point network", _Points(network), inputs, outputs, (uv, seen))


def save_exported(program: Program, path: Path) -> float:
    """Write a `torch.export` program (.pt2) for any number of patches, crops or snapshots.

    Returns:
        Difference from the network's own output; see `difference`.

    Raises:
        InputError: the file cannot be written.
    """
    exported = _export(program, fixed=False)
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about weights that share one block of memory
        plain = exported.run_decompositions({})  # without it, code that disables autocast cannot be saved
        torch.export.save(plain, buffer, extra_files=program.metadata())
    write_bytes(path, buffer.getvalue())
    buffer.seek(0)
    loaded = torch.export.load(buffer).module()
    twice = tuple(torch.cat((one, one.flip(0), one[:1])) for one in program.example)
    return difference([tensor.numpy() for tensor in loaded(*twice)], program.module(*twice))


def save_onnx(program: Program, path: Path) -> float:
    """Write ONNX, with the shapes of the example, and check it by running it.

    Returns:
        Difference of onnxruntime's output from the network's; see `difference`.

    Raises:
        InputError: the file cannot be written.
    """
    import onnx  # not a core dependency
    import onnxruntime

    buffer = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter's warnings about itself
        torch.onnx.export(
            _Unregistered(_rewrite(_export(program, fixed=True).module())), program.example,
            buffer,  # type: ignore[arg-type]  # its stubs only allow paths
            input_names=list(program.inputs), output_names=list(program.outputs), opset_version=OPSET, dynamo=False,
        )  # fmt: skip
    model = onnx.load_model_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, program.metadata())
    onnx.checker.check_model(model)
    content = model.SerializeToString()
    write_bytes(path, content)
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    given = tuple(one.flip(-1).contiguous() if one.is_floating_point() else one for one in program.example)
    found = session.run(None, {name: one.numpy() for name, one in zip(program.inputs, given, strict=True)})
    return difference(found, program.module(*given))


def difference(found: Sequence[NDArray[Any]], expected: Sequence[Tensor]) -> float:
    """Largest difference of any output, relative to its largest absolute value.

    Examples:
        >>> difference([np.array([1.0, 2.0])], [torch.tensor([1.0, 2.5])])
        0.2
    """
    worst = 0.0
    for one, other in zip(found, expected, strict=True):
        values = other.numpy()
        if one.shape != values.shape or not np.isfinite(one).all():
            return math.inf
        worst = max(worst, float(np.abs(one - values).max() / max(float(np.abs(values).max()), 1e-12)))
    return worst


def _export(program: Program, fixed: bool) -> torch.export.ExportedProgram:
    """Trace the network; its first axes have any length unless they are fixed."""
    example, shapes = program.example, None
    if not fixed:
        if len(example[0]) < 2:  # a length of one would be traced as a constant
            example = tuple(torch.cat((one, one)) for one in example)
        shapes = tuple({0: torch.export.Dim("count", min=1, max=2**16)} for _ in example)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.export.export(program.module, example, dynamic_shapes=shapes)


class _Unregistered(nn.Module):
    """Call a graph without registering it as a submodule: the exporter would call `eval`, which graphs refuse."""

    def __init__(self, graph: Callable[..., tuple[Tensor, ...]]) -> None:
        super().__init__()
        object.__setattr__(self, "graph", graph)

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        found: tuple[Tensor, ...] = self.graph(*given)  # type: ignore[operator]
        return found


def _rewrite(graph: nn.Module) -> nn.Module:
    """Rewrite operations that the exporter does not support (`mT`) or gets wrong (`movedim` from the back)."""
    aten = torch.ops.aten
    parts = [part for part in graph.modules() if isinstance(part, torch.fx.GraphModule)]
    for part in parts:
        for node in part.graph.nodes:
            if node.op != "call_function":
                continue
            if node.target is aten.mT.default:
                node.target, node.args = aten.transpose.int, (node.args[0], -2, -1)
            elif node.target in (aten.movedim.int, aten.movedim.intlist):
                tensor, source, target = node.args
                order = _order(tensor.meta["val"].dim(), source, target)
                node.target, node.args = aten.permute.default, (tensor, order)
        part.recompile()
    return graph


def _order(rank: int, source: int | Sequence[int], target: int | Sequence[int]) -> list[int]:
    """Order of the axes after `movedim`.

    Examples:
        >>> _order(4, (-1, -2), (0, 1))
        [3, 2, 0, 1]
    """
    sources, targets = ([axes] if isinstance(axes, int) else list(axes) for axes in (source, target))
    moved = {place % rank: axis % rank for axis, place in zip(sources, targets, strict=True)}
    others = iter(axis for axis in range(rank) if axis not in moved.values())
    return [moved[place] if place in moved else next(others) for place in range(rank)]

"""Value types as pytrees, whose tensors `torch.func`, `torch.compile` and `torch.export` can access.

Names, numbers and a rig's image sizes are constants of the tree, not leaves, so `torch.func.grad` and `vmap` accept a
rig directly. Two trees have the same structure only if these constants are equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree  # PyTorch has no public name for it

from imgcal.geometry import Projection, RigidTransform
from imgcal.types import (
    CalibrationObject,
    CameraRig,
    ConvexVolume,
    DriftRate,
    Observations,
    Prediction,
    RigPrior,
    Views,
)

Value = TypeVar("Value")


class Constant:
    """An integer tensor that is part of a tree's structure; equal to others with the same values."""

    def __init__(self, tensor: Tensor) -> None:
        """Store a tensor."""
        self.tensor = tensor

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Constant) or self.tensor.device != other.tensor.device:
            return False
        return self.tensor is other.tensor or torch.equal(self.tensor, other.tensor)

    def __hash__(self) -> int:
        return hash(tuple(self.tensor.shape))

    def __repr__(self) -> str:
        return f"Constant({self.tensor.tolist()})"


def register(cls: type[Value], constants: tuple[str, ...] = ()) -> type[Value]:
    """Register a frozen dataclass as a pytree whose leaves are all fields but the constants.

    Fields that are None have no leaves. Unflattening skips the checks of the class, because the leaves are not always
    tensors while PyTorch traces.
    """
    names = tuple(field.name for field in fields(cls) if field.name not in constants)  # type: ignore[arg-type]

    def flatten(value: Value) -> tuple[list[Any], tuple[Any, ...]]:
        given = tuple(name for name in names if getattr(value, name) is not None)
        fixed = (getattr(value, name) for name in constants)
        return [getattr(value, name) for name in given], (given, *map(_wrap_constant, fixed))

    def flatten_with_keys(value: Value) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        children, context = flatten(value)
        return [(pytree.GetAttrKey(name), child) for name, child in zip(context[0], children, strict=True)], context

    def unflatten(children: Any, context: tuple[Any, ...]) -> Value:
        value, (given, *rest) = object.__new__(cls), context
        for name in names:
            object.__setattr__(value, name, None)
        for name, child in zip(given, children, strict=True):
            object.__setattr__(value, name, child)
        for name, fixed in zip(constants, rest, strict=True):
            object.__setattr__(value, name, fixed.tensor if isinstance(fixed, Constant) else fixed)
        return value

    pytree.register_pytree_node(
        cls,
        flatten,
        unflatten,
        serialized_type_name=f"imgcal.{cls.__name__}",
        to_dumpable_context=lambda context: [_dump(fixed) for fixed in context],
        from_dumpable_context=lambda dumped: tuple(map(_load, dumped)),
        flatten_with_keys_fn=flatten_with_keys,
    )
    return cls


def _wrap_constant(value: Any) -> Any:
    return Constant(value) if isinstance(value, Tensor) else value


_LOAD: dict[str, Callable[[Any], Any]] = {
    "Constant": lambda value: Constant(torch.tensor(value["values"], device=value["device"])),
    "RigPrior": lambda value: RigPrior(**value),
    "DriftRate": lambda value: DriftRate(**value),
    "ConvexVolume": lambda value: ConvexVolume(tuple(map(tuple, value["points"]))),
    "tuple": tuple,
}


def _dump(value: Any) -> Any:
    """Convert a constant to a JSON value."""
    if isinstance(value, Constant):
        return ["Constant", {"values": value.tensor.tolist(), "device": str(value.tensor.device)}]
    if isinstance(value, RigPrior | DriftRate | ConvexVolume):
        return [type(value).__name__, asdict(value)]
    return ["tuple", list(value)] if isinstance(value, tuple) else ["", value]


def _load(dumped: Any) -> Any:
    kind, value = dumped
    return _LOAD[kind](value) if kind else value


for _type in (RigidTransform, Projection, Observations, Prediction, Views):
    register(_type)
# Exported programs contain example inputs, and are loaded without unpickling unknown types.
torch.serialization.add_safe_globals(
    [
        RigidTransform,
        Projection,
        Observations,
        Prediction,
        Views,
        CameraRig,
        CalibrationObject,
        RigPrior,
        DriftRate,
        ConvexVolume,
    ]
)
register(
    CameraRig,
    ("image_size", "camera_names", "name", "working_distance", "prior", "drift_rate", "volume", "lens_model"),
)
register(CalibrationObject, ("name", "fiducial_names", "scale_tolerance", "unknown_markers"))

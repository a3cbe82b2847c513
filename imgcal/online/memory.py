"""Values of a running rig as JSON and back, exactly: every bit of every number, and which values are the same object.

Numbers, text and lists stand there as they are; arrays as base64 of their bytes. Of objects only those of the classes
of `MODULES` are made, without running any code of theirs; what a file says about them is checked before it is used.
"""

from __future__ import annotations

import base64
import binascii
import math
import sys
from collections import deque
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch

MODULES = frozenset(
    f"imgcal.{name}"
    for name in (
        "association.options",
        "association.result",
        "association.tracker",
        "monitoring.snapshot_information",
        "monitoring.cusum",
        "monitoring.drift_pace",
        "monitoring.horizon",
        "monitoring.quarantine",
        "estimation.map_estimate",
        "monitoring.noise_correlation",
        "monitoring.object_change",
        "monitoring.pending_change",
        "monitoring.recent_snapshots",
        "monitoring.change_test",
        "monitoring.rig_arrays",
        "monitoring.rig_belief",
        "monitoring.rig_filter",
        "monitoring.rig_monitor",
        "monitoring.shaking",
        "monitoring.explanations",
        "geometry.transforms",
        "online.drift_watch",
        "online.events",
        "online.light_tracks",
        "online.noise_level",
        "online.object_doubts",
        "online.relearning",
        "online.search",
        "online.sightings",
        "types.calibration_object",
        "types.unknown_lights",
        "types.observations",
        "types.rig",
        "types.volume",
    )
)
"""Whose classes may be saved and restored; they have been imported before anything is restored."""
KINDS = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}
TYPES = {name: np.dtype(name) for name in ("float64", "int64", "bool", "uint8")}
MOST_DEPTH = 24
MOST_AXES = 8


class Frozen:
    """Values as they are now, to be written later: what changes in place has been copied."""

    def __init__(self, value: Any) -> None:
        """Copy a value."""
        self._numbers: dict[int, int] = {}
        self._alive: list[Any] = []  # an id must not be given to another object meanwhile
        self.value = self._frozen(value)

    def _frozen(self, value: Any) -> Any:
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"float": repr(value)}
        if isinstance(value, np.generic):
            return self._frozen(value.item())
        if id(value) in self._numbers:
            return {"again": self._numbers[id(value)]}
        if not isinstance(value, list | tuple | set | frozenset):
            self._numbers[id(value)] = len(self._numbers)
            self._alive.append(value)
        if isinstance(value, torch.Tensor):
            return {"tensor": self._bytes(value.detach().numpy())}
        if isinstance(value, np.ndarray):
            return {"array": self._bytes(value)}
        if isinstance(value, deque):
            return {"deque": [self._frozen(item) for item in value], "most": value.maxlen}
        if isinstance(value, dict):
            return {"dict": [[self._frozen(key), self._frozen(item)] for key, item in value.items()]}
        for name, kind in KINDS.items():
            if type(value) is kind:
                items = sorted(value) if name in ("set", "frozenset") else value
                return {name: [self._frozen(item) for item in items]}
        name = f"{type(value).__module__}:{type(value).__qualname__}"
        if type(value).__module__ not in MODULES:
            raise TypeError(f"{name} cannot be saved")
        return {"of": name, "values": {key: self._frozen(item) for key, item in vars(value).items()}}

    @staticmethod
    def _bytes(array: np.ndarray) -> tuple[str, tuple[int, ...], bytes, bool]:
        if array.dtype.name not in TYPES:
            raise TypeError(f"an array of {array.dtype} cannot be saved")
        columns = array.flags.f_contiguous and not array.flags.c_contiguous  # so are sums in the same order again
        return array.dtype.name, array.shape, array.T.tobytes() if columns else array.tobytes(), columns

    def plain(self) -> Any:
        """Values that JSON knows."""
        return _plain(self.value)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, tuple):  # of an array
        kind, shape, content, columns = value
        return [kind, list(shape), base64.b64encode(content).decode("ascii"), columns]
    return value


class Thawed:
    """Values out of what a file says."""

    def __init__(self, plain: Any) -> None:
        """Make the values.

        Raises:
            ValueError: nothing that `Frozen` writes.
        """
        self._made: list[Any] = []
        try:
            self.value = self._value(plain, 0)
        except (KeyError, TypeError, IndexError, AttributeError, OverflowError, binascii.Error) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error

    def _value(self, plain: Any, depth: int) -> Any:
        if plain is None or isinstance(plain, bool | int | float | str):
            return plain
        if not isinstance(plain, dict) or depth > MOST_DEPTH:
            raise ValueError("found no value of a kind that is written here")
        if "again" in plain:
            return self._made[plain["again"]]
        if "float" in plain:
            return {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}[plain["float"]]
        for name, kind in KINDS.items():
            if name in plain:
                return kind(self._value(item, depth + 1) for item in plain[name])
        number = len(self._made)
        self._made.append(None)
        made = self._object(plain, number, depth + 1)
        self._made[number] = made
        return made

    def _object(self, plain: dict[str, Any], number: int, depth: int) -> Any:
        if "tensor" in plain:
            return torch.from_numpy(_array(plain["tensor"]))
        if "array" in plain:
            return _array(plain["array"])
        if "deque" in plain:
            most = plain["most"]
            if not (most is None or (type(most) is int and 0 < most <= 2**16)):
                raise ValueError(f"found a queue of {most!r}")
            return deque((self._value(item, depth) for item in plain["deque"]), maxlen=most)
        if "dict" in plain:
            return {self._value(key, depth): self._value(item, depth) for key, item in plain["dict"]}
        made: Any = object.__new__(_class(plain["of"]))
        self._made[number] = made
        values = {str(key): self._value(item, depth) for key, item in plain["values"].items()}
        if is_dataclass(made) and not {field.name for field in fields(made)} <= values.keys():
            raise ValueError(f"{plain['of']}: found only {', '.join(values)}")
        vars(made).update(values)
        return made


def _class(name: str) -> type:
    """Find a class that may be made."""
    module, _, qualified = name.partition(":")
    found = getattr(sys.modules[module], qualified, None) if module in MODULES and "." not in qualified else None
    if not isinstance(found, type) or found.__module__ != module:
        raise ValueError(f"found an object of {name[:80]!r}, expected one of those that are written here")
    return found


def _array(plain: list[Any]) -> np.ndarray:
    """Make an array of a kind, a shape, and its bytes."""
    kind, shape, text, columns = plain
    content = base64.b64decode(text, validate=True)
    dtype = TYPES[kind]
    if len(shape) > MOST_AXES or not all(type(side) is int and side >= 0 for side in shape):
        raise ValueError("found an array of no shape")
    if math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError(f"found {len(content)} bytes for an array of {shape}")
    made = np.frombuffer(content, dtype=dtype).copy()
    made = made.reshape(shape[::-1]).T if columns else made.reshape(shape)
    if dtype.kind == "b" and (np.frombuffer(content, np.uint8) > 1).any():
        raise ValueError("found truth values that are neither")
    return made


def require_alike(found: Any, fresh: Any, where: str) -> None:
    """Check an object against one that was just made: the same names, the same types, arrays of the same shape.

    Raises:
        ValueError: it is another.
    """
    if type(found) is not type(fresh):
        raise ValueError(f"{where}: found {type(found).__name__}, expected {type(fresh).__name__}")
    names = {name for name in vars(fresh) if is_kept(fresh, name)}
    if {name for name in vars(found) if is_kept(found, name)} != names:
        raise ValueError(f"{where}: found other values than {', '.join(sorted(names))}")
    for name in names:
        mine, theirs = getattr(found, name), getattr(fresh, name)
        if isinstance(theirs, np.ndarray | torch.Tensor) and (
            type(mine) is not type(theirs) or tuple(mine.shape) != tuple(theirs.shape) or mine.dtype != theirs.dtype
        ):
            raise ValueError(f"{where}.{name}: found another array than one of {tuple(theirs.shape)}")
        plain = isinstance(theirs, bool | int | float | str | list | dict | set | deque)
        if plain and type(mine) is not type(theirs):
            raise ValueError(f"{where}.{name}: found {type(mine).__name__}, expected {type(theirs).__name__}")


def is_kept(value: Any, name: str) -> bool:
    """Tell whether an attribute is a value of its own, and not what a property remembers."""
    return not hasattr(getattr(type(value), name, None), "attrname")  # of `functools.cached_property`

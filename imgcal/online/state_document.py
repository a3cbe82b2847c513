"""The state of a running rig as a document of plain values and arrays, and back, bit for bit.

Each class defines its saved values: a dataclass all fields except those with the metadata `NOT_SAVED`; another class
those in its table `STATE`: key in the document -> attribute and type. An attribute can thus be renamed while its key
stays; a renamed field of a dataclass keeps its key by the metadata `{"key": ...}`. A document names no classes. Reading
follows the types in the code, checks kinds and shapes, and runs nothing that a document could choose. Arrays and
beliefs are stored once each and referred to by number, so that shared values are shared again.

A class that must derive something from its state has a method `resume`, which raises `ValueError` if the values are
inconsistent.
"""

from __future__ import annotations

import base64
import binascii
import math
import sys
import typing
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union

import numpy as np
import torch

from imgcal.monitoring import RigBelief
from imgcal.online.state_checks import CHECKS

get_origin: Callable[[Any], Any] = cache(typing.get_origin)
get_args: Callable[[Any], tuple[Any, ...]] = cache(typing.get_args)
"""Of a type; asked of thousands of values."""
SIMPLE = frozenset((NoneType, bool, int, str))
"""Types whose values stand in a document as they are."""
NOT_SAVED: Mapping[str, bool] = {"saved": False}
"""Metadata of a field that the caller gives again on resuming."""
DTYPES = {name: np.dtype(name) for name in ("float64", "float32", "int64", "int32", "bool", "uint8")}
NAMES = {dtype: name for name, dtype in DTYPES.items()}
NUMBERS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
"""Numbers that JSON does not have."""
MOST_AXES = 8
LONGEST_QUEUE = 2**16


class Entry(NamedTuple):
    """One value of a class's state."""

    key: str  # in the document
    attribute: str  # dots separate nested attributes
    kind: Any  # its type


@cache
def state_entries(kind: type) -> tuple[Entry, ...]:
    """The saved values of a class; see the module's docstring."""
    table: Mapping[str, tuple[str, Any]] | None = vars(kind).get("STATE")
    if table is not None:
        return tuple(Entry(key, attribute, of) for key, (attribute, of) in table.items())
    if not is_dataclass(kind):
        raise TypeError(f"{kind.__name__} cannot be saved")
    found = []
    for field in fields(kind):
        if field.metadata.get("saved", True):
            owner = next(one for one in kind.__mro__ if field.name in vars(one).get("__annotations__", {}))
            of = eval(field.type, vars(sys.modules[owner.__module__])) if isinstance(field.type, str) else field.type
            found.append(Entry(field.metadata.get("key", field.name), field.name, of))
    return tuple(found)


def is_array(kind: Any) -> bool:
    """Tell whether a type is an array or tensor."""
    kind = getattr(get_origin(kind) or kind, "__value__", kind)  # since NumPy 2.5, NDArray is a type alias
    return kind is torch.Tensor or kind is np.ndarray or get_origin(kind) is np.ndarray


def is_union(kind: Any) -> bool:
    """Tell whether a type is a union."""
    return get_origin(kind) in (Union, UnionType)


class StateWriter:
    """Converts values into a document; `arrays` are copies, so the originals may change afterwards."""

    def __init__(self) -> None:
        """Start an empty document."""
        self._arrays: list[tuple[np.ndarray, bool]] = []
        self._beliefs: list[dict[str, Any]] = []
        self._numbers: dict[Any, int] = {}
        self._alive: list[Any] = []  # keeps memory addresses unique while writing

    def write(self, kind: Any, value: Any) -> Any:
        """Write a value of a given type.

        Raises:
            TypeError: the value is of another type.
        """
        if type(value) is kind and (kind in SIMPLE or (kind is float and math.isfinite(value))):
            return value
        origin, args = get_origin(kind), get_args(kind)
        if is_union(kind):
            kind = next((one for one in args if _is_of(one, value)), kind)
            origin, args = get_origin(kind), get_args(kind)
        if is_union(kind) or not _is_of(kind, value):
            raise TypeError(f"found {type(value).__name__}, expected {kind}")
        if isinstance(value, np.generic):
            value = value.item()
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"number": repr(value)}
        if isinstance(value, torch.Tensor | np.ndarray):
            return {"array": self._array(value)}
        if isinstance(value, dict):
            return [[self.write(args[0], key), self.write(args[1], item)] for key, item in value.items()]
        if isinstance(value, deque):
            return {"most": value.maxlen, "items": [self.write(args[0], item) for item in value]}
        if origin is tuple and args[1:] != (Ellipsis,):
            return [self.write(one, item) for one, item in zip(args, value, strict=True)]
        if isinstance(value, list | tuple | set | frozenset):
            items = sorted(value) if isinstance(value, set | frozenset) else value
            return [self.write(args[0], item) for item in items]
        return {"belief": self._belief(value)} if kind is RigBelief else self._object(kind, value)

    def _object(self, kind: type, value: Any) -> dict[str, Any]:
        exact: type = type(value)
        if exact is not kind:
            raise TypeError(f"{exact.__name__} cannot be saved as {kind.__name__}")
        return {key: self.write(of, _attribute(value, attribute)) for key, attribute, of in state_entries(exact)}

    def _belief(self, belief: RigBelief) -> int:
        if id(belief) not in self._numbers:
            self._alive.append(belief)
            plain = self._object(RigBelief, belief)
            self._numbers[id(belief)] = len(self._beliefs)
            self._beliefs.append(plain)
        return self._numbers[id(belief)]

    def _array(self, value: torch.Tensor | np.ndarray) -> int:
        """Return the number of an array; views of the same memory with the same layout share one number."""
        array = value.detach().numpy() if isinstance(value, torch.Tensor) else value
        if array.dtype not in NAMES:
            raise TypeError(f"an array of {array.dtype} cannot be saved")
        key = array.__array_interface__["data"][0], array.shape, array.strides, array.dtype
        if key not in self._numbers or not array.size:
            self._numbers[key] = len(self._arrays)
            self._alive.append(array)
            by_columns = array.flags.f_contiguous and not array.flags.c_contiguous  # keeps the order of summation
            self._arrays.append((np.array(array.T if by_columns else array, order="C"), by_columns))
        return self._numbers[key]

    def tables(self) -> dict[str, Any]:
        """The tables that values refer to; for an array: type, shape, base64 of its bytes, whether by columns."""
        arrays = [
            [NAMES[array.dtype], list(array.shape), base64.b64encode(array.tobytes()).decode("ascii"), by_columns]
            for array, by_columns in self._arrays
        ]
        return {"beliefs": self._beliefs, "arrays": arrays}


class StateReader:
    """Converts a document back into values."""

    def __init__(self, tables: Mapping[str, Any]) -> None:
        """Read the tables that values refer to.

        Raises:
            ValueError: `tables` is not what `StateWriter.tables` returns.
        """
        try:
            self._arrays = [_array(*plain) for plain in tables["arrays"]]
            self._beliefs: list[RigBelief] = []
            for number, plain in enumerate(tables["beliefs"]):
                self._beliefs.append(self.read_object(RigBelief, plain, f"beliefs[{number}]"))
        except (KeyError, TypeError, OverflowError, binascii.Error) as error:
            raise ValueError(f"tables: {type(error).__name__}: {error}") from error

    def read(self, kind: Any, plain: Any, where: str, fresh: Any = None) -> Any:
        """Read a value of a given type.

        Args:
            kind: the type.
            plain: the value in the document.
            where: its name, for messages.
            fresh: the value in a new object: filled in if mutable; arrays must have the same shape.

        Raises:
            ValueError: the value is of another type or shape, or values are inconsistent.
            InputError: a rig or an object is invalid.
        """
        origin, args = get_origin(kind), get_args(kind)
        if is_union(kind):
            kind = next((one for one in args if _fits(one, plain)), kind)
            origin, args = get_origin(kind), get_args(kind)
        if is_union(kind) or not _fits(kind, plain):
            raise ValueError(f"{where}: found {_describe(plain)}")
        if kind is float and isinstance(plain, dict):
            return NUMBERS[plain["number"]]
        if plain is None or origin is Literal or kind in (bool, int, float, str):
            return plain
        if is_array(kind):
            array = self._arrays[_number(plain["array"], self._arrays, where)]
            return torch.from_numpy(array) if kind is torch.Tensor else array
        if kind is RigBelief:
            return self._beliefs[_number(plain["belief"], self._beliefs, where)]
        if origin in (dict, Mapping):
            return {self.read(args[0], key, where): self.read(args[1], item, f"{where}[{key}]") for key, item in plain}
        if origin is deque:
            items = [self.read(args[0], item, where) for item in plain["items"]]
            if isinstance(fresh, deque) and fresh.maxlen != plain["most"]:
                raise ValueError(f"{where}: found a queue of {plain['most']}, expected {fresh.maxlen}")
            return deque(items, maxlen=plain["most"])
        if origin is tuple and args[1:] != (Ellipsis,):
            if len(plain) != len(args):
                raise ValueError(f"{where}: found {len(plain)} values, expected {len(args)}")
            return tuple(self.read(one, item, where) for one, item in zip(args, plain, strict=True))
        if origin in (list, tuple, set, frozenset):
            return origin(self.read(args[0], item, where) for item in plain)
        return self.read_object(kind, plain, where, fresh)

    def read_object(self, kind: type, plain: Any, where: str, fresh: Any = None) -> Any:
        """Read an object; `fresh` is filled with it where it can change, see `read`."""
        entries = state_entries(kind)
        if not isinstance(plain, dict) or plain.keys() != {entry.key for entry in entries}:
            names = ", ".join(entry.key for entry in entries)
            raise ValueError(f"{where}: found {_describe(plain)}, expected {names}")
        frozen = is_dataclass(kind) and kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
        in_place = type(fresh) is kind and not frozen
        if not in_place and not is_dataclass(kind):
            raise ValueError(f"{where}: found {_describe(plain)}, expected none")
        values = {}
        for key, attribute, of in entries:
            first = _attribute(fresh, attribute) if in_place else None
            values[attribute] = self.read(of, plain[key], f"{where}.{key}", first)
            if in_place and not hasattr(kind, "resume"):
                _require_same_shape(values[attribute], first, f"{where}.{key}")
        if in_place or "STATE" in vars(kind):
            made: Any = fresh if in_place else object.__new__(kind)
            for attribute, value in values.items():
                *path, last = attribute.split(".")
                vars(_attribute(made, ".".join(path)) if path else made)[last] = value
        else:
            made = kind(**values)
        if hasattr(made, "resume"):
            made.resume()
        if kind in CHECKS:
            try:
                CHECKS[kind](made)
            except (AttributeError, IndexError, RuntimeError, TypeError) as error:
                raise ValueError(f"{where}: {error}") from error
        return made


def _attribute(value: Any, path: str) -> Any:
    for name in path.split("."):
        value = getattr(value, name)
    return value


def _is_of(kind: Any, value: Any) -> bool:
    """Tell whether the outermost part of a value matches a type."""
    origin = get_origin(kind)
    if origin is Literal:
        return isinstance(value, str | int | NoneType) and value in get_args(kind)
    if kind is float:
        return isinstance(value, float | int | np.floating | np.integer) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int | np.integer) and not isinstance(value, bool)
    if kind is bool:
        return isinstance(value, bool | np.bool_)
    if kind is None:
        return value is None
    if is_array(kind):
        return isinstance(value, torch.Tensor if kind is torch.Tensor else np.ndarray)
    of = origin or kind
    return isinstance(value, dict if of is Mapping else of)


def _fits(kind: Any, plain: Any) -> bool:
    """Tell whether the outermost part of a document's value matches a type."""
    origin = get_origin(kind)
    if origin is Literal:
        return isinstance(plain, str | int | NoneType) and plain in get_args(kind)
    if kind is float:
        special = isinstance(plain, dict) and plain.keys() == {"number"} and plain["number"] in NUMBERS
        return special or (isinstance(plain, float | int) and not isinstance(plain, bool))
    if kind in (bool, int, str):
        return type(plain) is kind
    if kind in (None, NoneType):
        return plain is None
    if is_array(kind):
        return isinstance(plain, dict) and plain.keys() == {"array"}
    if kind is RigBelief:
        return isinstance(plain, dict) and plain.keys() == {"belief"}
    if origin in (dict, Mapping):
        return isinstance(plain, list) and all(isinstance(pair, list) and len(pair) == 2 for pair in plain)
    if origin is deque:
        if not isinstance(plain, dict) or plain.keys() != {"most", "items"} or not isinstance(plain["items"], list):
            return False
        most = plain["most"]
        return most is None or (type(most) is int and 0 < most <= LONGEST_QUEUE)
    if origin in (list, tuple, set, frozenset):
        return isinstance(plain, list)
    return isinstance(kind, type) and isinstance(plain, dict) and set(plain) not in ({"array"}, {"belief"}, {"number"})


def _describe(plain: Any) -> str:
    """Describe a value of a document in a few words."""
    if isinstance(plain, dict):
        return ", ".join(str(name) for name in plain)[:60] or "nothing"
    return f"a list of {len(plain)}" if isinstance(plain, list) else repr(plain)[:60]


def _number(found: Any, of: list[Any], where: str) -> int:
    if type(found) is not int or not 0 <= found < len(of):
        raise ValueError(f"{where}: found the number {found!r} of {len(of)}")
    return found


def _array(dtype: str, shape: list[int], text: str, by_columns: bool) -> np.ndarray:
    content, kind = base64.b64decode(text, validate=True), DTYPES[dtype]
    if len(shape) > MOST_AXES or not all(type(side) is int and side >= 0 for side in shape):
        raise ValueError("found an array without a shape")
    if math.prod(shape) * kind.itemsize != len(content):
        raise ValueError(f"found {len(content)} bytes for an array of {shape}")
    if kind.kind == "b" and (np.frombuffer(content, np.uint8) > 1).any():
        raise ValueError("found truth values that are neither true nor false")
    made = np.frombuffer(content, dtype=kind).copy().reshape(shape)
    return made.T if by_columns else made


def _require_same_shape(value: Any, fresh: Any, where: str) -> None:
    if isinstance(fresh, np.ndarray | torch.Tensor) and not (
        isinstance(value, type(fresh)) and value.shape == fresh.shape and value.dtype == fresh.dtype
    ):
        raise ValueError(f"{where}: found another array than one of {tuple(fresh.shape)}")

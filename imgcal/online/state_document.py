"""The state of a running rig as a document of plain values and arrays, and back, exactly: every bit of every number.

What is saved is said with each class: all fields of a dataclass, but those marked `NOT_SAVED`; of another class what its
table `STATE` lists, name in the file -> attribute and type. A file names no classes: reading follows these types, checks
shapes and values, and runs no code that a file could choose. A class that must put something in order once its state
has been read has a method `resume`, which raises `ValueError` where values do not belong together.
"""

from __future__ import annotations

import base64
import binascii
import math
import sys
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

import numpy as np
import torch

from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations, check_object, check_rig

NOT_SAVED: Mapping[str, bool] = {"saved": False}
"""Metadata of a field that whoever goes on gives anew."""
DTYPES = {name: np.dtype(name) for name in ("float64", "float32", "int64", "int32", "bool", "uint8")}
MOST_AXES = 8
NUMBERS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
"""What JSON has no number for."""


class Entry(NamedTuple):
    """One value of a class's state."""

    name: str  # in the file
    attribute: str  # dots lead to an attribute of an attribute
    kind: Any
    make: Callable[[], Any] | None  # what a new object begins with


@cache
def entries_of(kind: type) -> tuple[Entry, ...]:
    """The state of a class, see above; none of one that has none."""
    table: Mapping[str, tuple[str, Any]] | None = vars(kind).get("STATE")
    if table is not None:
        return tuple(Entry(name, attribute, of, None) for name, (attribute, of) in table.items())
    if not is_dataclass(kind):
        return ()
    found = []
    for field in fields(kind):
        if field.metadata.get("saved", True):
            make = None if field.default_factory is MISSING else field.default_factory
            owner = next(one for one in kind.__mro__ if field.name in vars(one).get("__annotations__", {}))
            of = eval(field.type, vars(sys.modules[owner.__module__])) if isinstance(field.type, str) else field.type  # noqa: S307
            found.append(Entry(field.name, field.name, of, make))
    return tuple(found)


def _attribute(value: Any, path: str) -> Any:
    for name in path.split("."):
        value = getattr(value, name)
    return value


class StateWriter:
    """Turns values into a document as they are now; `arrays` are copied, so that they may change later."""

    def __init__(self) -> None:
        """Begin with none."""
        self.arrays: list[tuple[np.ndarray, bool]] = []
        self._numbers: dict[tuple[Any, ...], int] = {}
        self._alive: list[Any] = []  # memory must not be given to another array meanwhile

    def write(self, kind: Any, value: Any) -> Any:
        """Write a value of a type.

        Raises:
            TypeError: it is of another type.
        """
        origin, args = get_origin(kind), get_args(kind)
        if origin in (Union, UnionType):
            for one in args:
                if _is(one, value):
                    return self.write(one, value)
            raise TypeError(f"found {type(value).__name__}, expected {kind}")
        if not _is(kind, value):
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
        if origin is tuple and args[1:] != (Ellipsis,):
            return [self.write(one, item) for one, item in zip(args, value, strict=True)]
        if isinstance(value, list | tuple | deque | set | frozenset):
            items = sorted(value) if isinstance(value, set | frozenset) else value
            return [self.write(args[0], item) for item in items]
        return {entry.name: self.write(entry.kind, _attribute(value, entry.attribute)) for entry in entries_of(kind)}

    def _array(self, value: torch.Tensor | np.ndarray) -> int:
        """The number of an array; the same memory gets the same one."""
        array = value.detach().numpy() if isinstance(value, torch.Tensor) else value
        if array.dtype.name not in DTYPES:
            raise TypeError(f"an array of {array.dtype} cannot be saved")
        key = array.__array_interface__["data"][0], array.shape, array.strides, array.dtype.name
        if key not in self._numbers or not array.size:
            self._numbers[key] = len(self.arrays)
            self._alive.append(array)
            columns = array.flags.f_contiguous and not array.flags.c_contiguous  # so are sums in the same order again
            self.arrays.append((np.array(array.T if columns else array, order="C"), columns))
        return self._numbers[key]

    def plain_arrays(self) -> list[list[Any]]:
        """All arrays as JSON knows them: type, shape, base64 of the bytes, whether these go column by column."""
        return [
            [array.dtype.name, list(array.shape), base64.b64encode(array.tobytes()).decode("ascii"), columns]
            for array, columns in self.arrays
        ]


def _is(kind: Any, value: Any) -> bool:
    """Tell whether a value is of a type, as far as its outermost part says."""
    origin = get_origin(kind)
    if origin is Literal:
        return value in get_args(kind)
    if kind is float:
        return isinstance(value, float | int | np.floating | np.integer) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int | np.integer) and not isinstance(value, bool)
    if kind is bool:
        return isinstance(value, bool | np.bool_)
    if origin is Callable or kind is Callable or getattr(origin, "__name__", "") == "Callable":
        return False
    of = NoneType if kind is None else origin or kind
    return isinstance(value, dict if of.__name__ == "Mapping" else of)


class StateReader:
    """Makes values of a document."""

    def __init__(self, arrays: list[Any]) -> None:
        """Make the arrays.

        Raises:
            ValueError: they are none.
        """
        try:
            self._arrays = [_array(*plain) for plain in arrays]
        except (KeyError, TypeError, ValueError, OverflowError, binascii.Error) as error:
            raise ValueError(f"arrays: {type(error).__name__}: {error}") from error

    def read(self, kind: Any, plain: Any, where: str, fresh: Any = None) -> Any:
        """Read a value of a type.

        Args:
            kind: the type.
            plain: what the document says.
            where: its name, for messages.
            fresh: what a new object has there: arrays must be of the same shape, and what can change in place does.

        Raises:
            ValueError: it is of another type or shape, or values do not belong together.
            InputError: a rig or an object cannot be.
        """
        origin, args = get_origin(kind), get_args(kind)
        if origin in (Union, UnionType):
            for one in args:
                if self._fits(one, plain):
                    return self.read(one, plain, where, fresh)
            raise ValueError(f"{where}: found {_what(plain)}")
        if not self._fits(kind, plain):
            raise ValueError(f"{where}: found {_what(plain)}")
        if isinstance(plain, dict) and "number" in plain and kind is float:
            return NUMBERS[plain["number"]]
        if plain is None or origin is Literal or kind in (bool, int, float, str):
            return plain
        if kind is torch.Tensor or origin is np.ndarray or kind is np.ndarray:
            return self._read_array(kind, plain["array"], where, fresh)
        if origin is dict:
            return {
                self.read(args[0], key, where): self.read(args[1], item, f"{where}[{key}]") for key, item in plain
            }
        if origin is tuple and args[1:] != (Ellipsis,):
            if len(plain) != len(args):
                raise ValueError(f"{where}: found {len(plain)} values, expected {len(args)}")
            return tuple(self.read(one, item, where) for one, item in zip(args, plain, strict=True))
        if origin is deque:
            most = fresh.maxlen if isinstance(fresh, deque) else None
            return deque((self.read(args[0], item, where) for item in plain), maxlen=most)
        if origin in (list, tuple, set, frozenset):
            return origin(self.read(args[0], item, where) for item in plain)
        return self.read_object(kind, plain, where, fresh)

    def read_object(self, kind: type, plain: dict[str, Any], where: str, fresh: Any = None) -> Any:
        """Read an object: in place, where there is one that can change; see `read`."""
        entries = entries_of(kind)
        if not isinstance(plain, dict) or plain.keys() != {entry.name for entry in entries}:
            names = ", ".join(entry.name for entry in entries)
            raise ValueError(f"{where}: found {_what(plain)}, expected {names}")
        frozen = is_dataclass(kind) and kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
        in_place = isinstance(fresh, kind) and not frozen
        if not in_place and not is_dataclass(kind):
            raise ValueError(f"{where}: found {_what(plain)}, expected none")
        made: Any = fresh if in_place else object.__new__(kind)
        for entry in entries:
            first = None
            if in_place:
                first = _attribute(made, entry.attribute)
            elif entry.make is not None:
                first = entry.make()
            value = self.read(entry.kind, plain[entry.name], f"{where}.{entry.name}", first)
            if in_place and not hasattr(kind, "resume"):
                _require_shape(value, first, f"{where}.{entry.name}")
            *path, last = entry.attribute.split(".")
            owner = _attribute(made, ".".join(path)) if path else made
            vars(owner)[last] = value
        if hasattr(kind, "resume"):
            made.resume()
        check = CHECKS.get(kind)
        if check is not None:
            try:
                check(made)
            except (ValueError, IndexError, RuntimeError, TypeError) as error:
                raise ValueError(f"{where}: {error}") from error
        return made

    def _read_array(self, kind: Any, number: Any, where: str, fresh: Any) -> Any:
        if type(number) is not int or not 0 <= number < len(self._arrays):
            raise ValueError(f"{where}: found no array of number {number!r}")
        array = self._arrays[number]
        return torch.from_numpy(array) if kind is torch.Tensor else array

    def _fits(self, kind: Any, plain: Any) -> bool:
        """Tell whether what a document says may be of a type."""
        origin = get_origin(kind)
        if origin is Literal:
            return isinstance(plain, str | int | type(None)) and plain in get_args(kind)
        if kind is float:
            found = isinstance(plain, dict) and plain.keys() == {"number"} and plain["number"] in NUMBERS
            return found or (isinstance(plain, float | int) and not isinstance(plain, bool))
        if kind in (bool, int, str):
            return type(plain) is kind
        if kind in (None, NoneType):
            return plain is None
        if kind is torch.Tensor or origin is np.ndarray or kind is np.ndarray:
            return isinstance(plain, dict) and plain.keys() == {"array"}
        if origin is dict:
            return isinstance(plain, list) and all(isinstance(pair, list) and len(pair) == 2 for pair in plain)
        if origin in (list, tuple, set, frozenset, deque):
            return isinstance(plain, list)
        return isinstance(kind, type) and isinstance(plain, dict) and "array" not in plain


def _what(plain: Any) -> str:
    """What a document says, in a few words."""
    if isinstance(plain, dict):
        return ", ".join(str(name) for name in plain)[:60] or "nothing"
    return f"a list of {len(plain)}" if isinstance(plain, list) else repr(plain)[:60]


def _array(dtype: str, shape: list[int], text: str, columns: bool) -> np.ndarray:
    content, kind = base64.b64decode(text, validate=True), DTYPES[dtype]
    if len(shape) > MOST_AXES or not all(type(side) is int and side >= 0 for side in shape):
        raise ValueError("found an array of no shape")
    if math.prod(shape) * kind.itemsize != len(content):
        raise ValueError(f"found {len(content)} bytes for an array of {shape}")
    if kind.kind == "b" and (np.frombuffer(content, np.uint8) > 1).any():
        raise ValueError("found truth values that are neither")
    made = np.frombuffer(content, dtype=kind).copy().reshape(shape)
    return made.T if columns else made


def _require_shape(value: Any, fresh: Any, where: str) -> None:
    if isinstance(fresh, np.ndarray | torch.Tensor):
        alike = isinstance(value, type(fresh)) and value.shape == fresh.shape and value.dtype == fresh.dtype
        if not alike:
            raise ValueError(f"{where}: found another array than one of {tuple(fresh.shape)}")
        if not np.isfinite(np.asarray(value)).all():
            raise ValueError(f"{where}: found numbers that are not finite")


def _require(right: bool, found: str) -> None:
    if not right:
        raise ValueError(f"found {found}")


def _check_rig(rig: CameraRig) -> None:
    count = len(rig.camera_names)
    shapes = {
        "focal_length": (count, 2), "principal_point": (count, 2), "image_size": (count, 2),
        "distortion": (count, rig.distortion.shape[-1]),
    }  # fmt: skip
    for name, shape in shapes.items():
        _require(tuple(getattr(rig, name).shape) == shape, f"{name} of other cameras than {count}")
    _require(tuple(rig.cam_from_rig.translation.shape) == (count, 3), f"places of other cameras than {count}")
    check_rig(rig)


def _check_object(obj: CalibrationObject) -> None:
    _require(obj.points.ndim == 2 and obj.points.shape[1] == 3, "points of no object")
    for name in ("radius", "tolerance"):
        value = getattr(obj, name)
        _require(value is None or tuple(value.shape) == (obj.num_fiducials,), f"{name} of other fiducials")
    check_object(obj)


def _check_transform(pose: RigidTransform) -> None:
    rotation, translation = pose.rotation, pose.translation
    _require(rotation.shape[-2:] == (3, 3) and rotation.shape[:-1] == translation.shape, "no pose")
    _require(bool(rotation.isfinite().all() and translation.isfinite().all()), "a pose that is not finite")


def _check_belief(belief: RigBelief) -> None:
    count, width, wide = belief.rig.num_cameras, belief.rig.num_parameters, len(belief.factor)
    own = len(belief.object_offset)
    _require(tuple(belief.unit.shape) == (count, width), "units of other cameras")
    _require(own == (0 if belief.obj.exact else 3 * belief.obj.num_fiducials + 1), "an offset of another object")
    for name in ("factor", "information"):
        matrix = getattr(belief, name)
        _require(tuple(matrix.shape) == (wide, wide) and wide == count * width + own, f"{name} of another rig")
        good = matrix.isfinite().all() and (matrix.diagonal() > 0).all()
        _require(bool(good), f"{name} that is not finite and positive")
    arrays = belief.arrays
    _require(arrays.rotation.shape == (count, 3, 3) and arrays.position.shape == (count, 3), "a rig of other cameras")
    _require(all(np.isfinite(part).all() and len(part) == count for part in arrays.parts), "a rig that is not finite")


def _check_observations(seen: Observations) -> None:
    shape = seen.seen.shape
    _require(seen.seen.dtype == torch.bool and len(shape) == 3, "no observations")
    _require(seen.uv.shape == (*shape, 2) and seen.sigma.shape == shape, "observations of several shapes")
    good = seen.uv[seen.seen].isfinite().all() and (seen.sigma[seen.seen] > 0).all()
    _require(bool(good), "observations that are not finite")


def _check_detections(blobs: Detections) -> None:
    count = len(blobs.camera)
    columns = (blobs.sigma, blobs.snapshot, blobs.fiducial, blobs.radius, blobs.flags)
    _require(blobs.uv.shape == (count, 2) and all(part.shape == (count,) for part in columns), "blobs of several counts")
    known = ((blobs.camera >= 0) & (blobs.camera < len(blobs.camera_names))).all() and (blobs.fiducial >= -1).all()
    _require(bool(known), "blobs of no camera")
    _require(bool(np.isfinite(blobs.uv).all() and (blobs.sigma > 0).all()), "blobs that are not finite")


CHECKS: dict[type, Callable[[Any], None]] = {
    CameraRig: _check_rig,
    CalibrationObject: _check_object,
    RigidTransform: _check_transform,
    RigBelief: _check_belief,
    Observations: _check_observations,
    Detections: _check_detections,
}

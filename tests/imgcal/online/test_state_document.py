"""Values survive a round trip through a document exactly, and are checked against the types of the code."""

import json
import math
from collections import deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import TypeAliasType

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.online import ClockOffsets, ForeignObject, ImageQuality
from imgcal.online.keeper_file import FORMAT
from imgcal.online.keeper_memory import KeeperMemory
from imgcal.online.labelling import Labelling
from imgcal.online.state_document import NOT_SAVED, StateReader, StateWriter, is_union, state_entries
from imgcal.types import Board, CalibrationObject

KEYS = Path(__file__).parent / f"state_keys_{FORMAT.rpartition('/')[2]}.txt"


@dataclass(frozen=True)
class Look:
    """Frozen, with a value that is not saved and one whose field has another name by now."""

    pose: RigidTransform
    side: Literal["left", "right"]
    when: float = field(metadata={"key": "time"})
    options: int = field(default=3, metadata=NOT_SAVED)


class Level:
    """No dataclass: a table says what is saved."""

    STATE: ClassVar = {"latest": ("_latest", deque[float]), "sizes": ("_sizes", NDArray[np.float64])}

    def __init__(self, most: int) -> None:
        self._latest, self._sizes, self.sum = deque[float](maxlen=most), np.zeros(2), 0.0

    def resume(self) -> None:
        self.sum = sum(self._latest)


@dataclass
class State:
    level: Level
    looks: dict[int, tuple[Look, float | None]]
    names: frozenset[str]
    before: RigBelief
    now: RigBelief
    obj: CalibrationObject
    views: list[Tensor]


def made_state() -> State:
    obj = imgcal.load_object("asymmetric8")
    belief, array = RigBelief.of_prior(imgcal.load_rig("T4"), obj), torch.arange(3.0).double()
    pose = RigidTransform(torch.eye(3).double() / 3, torch.tensor([0.1, math.pi, -0.0]).double())
    looks = {3: (Look(pose, "left", math.inf, 7), 0.1), 1: (Look(pose, "right", 2.0), None)}
    state = State(
        Level(5), looks, frozenset({"b", "a"}), belief, belief, CalibrationObject.unknown(most=4), [array, array]
    )
    state.level._latest.extend((1.0, 2.0, math.nan, 4.0, 0.5, 0.25))
    state.level._sizes = np.array([1.0, 1e-300])
    return state


def brought_back(state: State) -> State:
    writer = StateWriter()
    plain = json.loads(json.dumps(writer.write(State, state), allow_nan=False))
    fresh = State(Level(5), {}, frozenset(), state.before, state.before, state.obj, [])
    return StateReader(json.loads(json.dumps(writer.tables()))).read_object(State, plain, "state", fresh)


def test_values_come_back_exactly_and_what_was_shared_is_shared() -> None:
    state = made_state()
    found = brought_back(state)
    assert list(found.looks) == [3, 1] and found.names == state.names
    look, share = found.looks[3]
    assert (look.side, look.when, look.options, share, found.looks[1][1]) == ("left", math.inf, 3, 0.1, None)
    assert torch.equal(look.pose.rotation, state.looks[3][0].pose.rotation)
    assert torch.signbit(look.pose.translation[2])
    assert found.level._latest.maxlen == 5 and math.isnan(found.level.sum)
    np.testing.assert_array_equal(found.level._sizes, state.level._sizes)
    assert found.now is found.before and torch.equal(found.now.factor, state.now.factor)
    assert found.obj.unknown_markers and found.obj.num_fiducials == 4
    found.views[0][0] = 5.0
    assert found.views[1][0] == 5.0


@pytest.mark.parametrize("kind", ["body", "tolerances", "board", "lights", "stick"])
def test_every_kind_of_object_comes_back(kind: str) -> None:
    body = imgcal.load_object("asymmetric8")
    obj = {
        "body": body,
        "tolerances": replace(
            body, tolerance=torch.full((8,), 0.05).double(), scale_tolerance=1e-3, labels=(9, *range(7))
        ),
        "board": CalibrationObject.of_board(Board("charuco", 5, 7, 30.0, 22.0, "DICT_4X4_50", bend=(0.5, 0.0))),
        "lights": CalibrationObject.unknown(),
        "stick": replace(
            body, points=body.points * torch.tensor([1.0, 0.0, 0.0]).double(), fiducial_names=("end",) * 8
        ),
    }[kind]
    writer = StateWriter()
    plain = json.loads(json.dumps(writer.write(CalibrationObject, obj)))
    found = StateReader(writer.tables()).read(CalibrationObject, plain, "object")
    assert type(found) is type(obj)
    for name, value in vars(replace(obj)).items():
        again = getattr(found, name)
        assert torch.equal(again, value) if isinstance(value, Tensor) else again == value, name


def test_an_alias_of_an_array_s_type_is_that_type() -> None:
    """As NumPy's own NDArray since its version 2.5."""
    scalar = TypeVar("scalar", bound=np.generic)
    alias = TypeAliasType("alias", np.ndarray[Any, np.dtype[scalar]], type_params=(scalar,))
    writer, values = StateWriter(), np.arange(3.0)
    for kind in (alias[np.float64], alias[np.float64] | None):
        plain = writer.write(kind, values)
        assert (StateReader(writer.tables()).read(kind, plain, "values") == values).all()
    with pytest.raises(TypeError):
        writer.write(alias[np.float64], 1.0)
    with pytest.raises(ValueError, match="values"):
        StateReader(writer.tables()).read(alias[np.float64], 1.0, "values")


def test_sums_over_an_array_go_in_the_same_order() -> None:
    array = np.arange(6.0).reshape(2, 3).T
    writer = StateWriter()
    plain = writer.write(NDArray[np.float64], array)
    found = StateReader(writer.tables()).read(NDArray[np.float64], plain, "array")
    assert found.flags.f_contiguous and found.strides == array.strides
    np.testing.assert_array_equal(found, array)


def test_what_changes_later_is_kept_as_it_was() -> None:
    array, writer = np.zeros(3), StateWriter()
    plain = writer.write(np.ndarray, array)
    array[:] = 1.0
    np.testing.assert_array_equal(StateReader(writer.tables()).read(np.ndarray, plain, "array"), np.zeros(3))


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (int, 0.5), (float, True), (str | None, 3), (list[int], [None]), (tuple[int, int], (1, "2")),
        (dict[int, str], {"a": "b"}), (Literal["left"], "up"), (object, object()), (np.ndarray, np.array([{}])),
    ],
)  # fmt: skip
def test_a_value_of_another_type_is_not_written(kind, value) -> None:
    with pytest.raises(TypeError):
        StateWriter().write(kind, value)


@pytest.mark.parametrize(
    ("kind", "plain"),
    [
        (int, "1"), (int, True), (float, {"number": "1"}), (str | None, 3), (list[int], {}), (list[int], [0.5]),
        (tuple[int, int], [1]), (dict[int, str], [[1]]), (Literal["left"], "up"), (Literal["left"], ["left"]),
        (deque[int], {"most": 10**12, "items": []}), (deque[int], []), (np.ndarray, {"array": 0}), (np.ndarray, [1.0]),
        (RigBelief, {"belief": 0}), (RigBelief, {"belief": None}), (RigidTransform, {"rotation": None}),
        (RigidTransform, []), (CalibrationObject, {"kind": "os"}), (Level, {"latest": []}),
    ],
)  # fmt: skip
def test_another_value_than_the_type_says_is_refused(kind, plain) -> None:
    with pytest.raises(ValueError, match="found"):
        StateReader(StateWriter().tables()).read(kind, plain, "value")


@pytest.mark.parametrize(
    "array",
    [
        ["float64", [-1], "", False], ["float64", [2], "AAAA", False], ["object", [0], "", False],
        ["bool", [1], "Bw==", False], ["float64", [1]], ["float64", [0] * 9, "", False], ["float64", 1, "", False], 3,
    ],
)  # fmt: skip
def test_arrays_that_cannot_be_are_refused(array) -> None:
    with pytest.raises(ValueError):
        StateReader({"beliefs": [], "arrays": [array]})


PLAIN = {bool: "bool", int: "int", float: "float", str: "text", type(None): "null", Tensor: "tensor"}


def keys_of(kind: Any, where: str, known: dict[type, str], lines: list[str]) -> str:
    """Describe a type as a document has it, without names of the code; adds a line for each key of its classes."""
    if kind in PLAIN:
        return PLAIN[kind]
    parts = get_args(kind)
    if kind is np.ndarray or get_origin(kind) is np.ndarray:
        return "array"
    if get_origin(kind) is Literal:
        return " | ".join(map(repr, parts))
    if parts:
        name = "one" if is_union(kind) else get_origin(kind).__name__
        inner = [keys_of(part, where, known, lines) for part in parts if part is not Ellipsis]
        return f"{name}[{', '.join(inner)}]"
    if kind not in known:
        known[kind] = where
        for key, _, of in state_entries(kind):
            place = len(lines)
            lines.insert(place, f"{where}.{key}: {keys_of(of, f'{where}.{key}', known, lines)}")
    return f"<{known[kind]}>"


def state_keys() -> str:
    """All keys of a state file, a line each."""
    known: dict[type, str] = {}
    lines: list[str] = []
    keys_of(KeeperMemory, "memory", known, lines)
    keys_of(Labelling, "labelling", known, lines)
    for test in (ImageQuality, ClockOffsets, ForeignObject):
        keys_of(test, f"tests.{test.name}", known, lines)
    return "\n".join((*lines, ""))


def test_the_keys_of_a_state_file_are_those_of_its_version() -> None:
    """A name in the code may change, a key may not: files of users hold it.

    Where something else is remembered, raise the number of `keeper_file.FORMAT` and write these keys anew, by
    `python -m tests.imgcal.online.test_state_document > tests/imgcal/online/state_keys_11.txt`; delete the old ones.
    """
    assert state_keys() == KEYS.read_text()


if __name__ == "__main__":
    print(state_keys(), end="")

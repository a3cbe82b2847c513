"""Printed boards: YAML, `format: imgcal-board/1`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from imgcal.errors import InputError
from imgcal.io.names import LONGEST_NAME, title_from_name
from imgcal.io.validation import StrictModel, validate
from imgcal.io.yaml_file import Flow, parse_foreign_yaml, yaml_text
from imgcal.messages import shorten
from imgcal.types import Board, CalibrationObject, limits

FORMAT = "imgcal-board/1"
APRILTAGS = "DICT_APRILTAG_36h11"

Count = Annotated[int, Field(ge=1, le=100)]
Length = Annotated[float, Field(gt=0, le=limits.COORDINATE.high, allow_inf_nan=False)]
Deflection = Annotated[float, Field(ge=-1e4, le=1e4, allow_inf_nan=False)]
DictionaryName = Annotated[str, Field(pattern=r"^DICT_[A-Za-z0-9_]{1,40}$")]


class _Printed(StrictModel):
    format: Literal["imgcal-board/1"]
    name: Annotated[str, Field(max_length=LONGEST_NAME)] | None = None
    columns: Count
    rows: Count
    inverted: bool = False
    bend: Annotated[list[Deflection], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.0, 0.0])
    warp: Annotated[float, Field(ge=0, le=limits.TOLERANCE.high, allow_inf_nan=False)] | None = None

    def shared(self) -> dict[str, Any]:
        """Values that all boards have."""
        bend = (self.bend[0], self.bend[1])
        return {"columns": self.columns, "rows": self.rows, "inverted": self.inverted, "bend": bend, "warp": self.warp}


class _Charuco(_Printed):
    type: Literal["charuco"]
    square: Length
    marker: Length
    dictionary: DictionaryName
    first_id: Annotated[int, Field(ge=0, le=limits.MOST_FIDUCIALS)] = 0
    legacy: bool = False

    def board(self) -> Board:
        """Make the board."""
        own: dict[str, Any] = {"dictionary": self.dictionary, "first_id": self.first_id, "legacy": self.legacy}
        return Board("charuco", pitch=self.square, marker=self.marker, **own, **self.shared())


class _AprilGrid(_Printed):
    type: Literal["aprilgrid"]
    tag: Length
    gap: Length
    dictionary: DictionaryName = APRILTAGS
    first_id: Annotated[int, Field(ge=0, le=limits.MOST_FIDUCIALS)] = 0
    border: Annotated[int, Field(ge=1, le=4)] = 2
    numbered_from: Literal["top", "bottom"] = "bottom"

    def board(self) -> Board:
        """Make the board."""
        own: dict[str, Any] = {"dictionary": self.dictionary, "first_id": self.first_id, "border": self.border}
        size: dict[str, Any] = {"pitch": self.tag + self.gap, "marker": self.tag}
        return Board("aprilgrid", **size, **own, from_bottom=self.numbered_from == "bottom", **self.shared())


class _Checkerboard(_Printed):
    type: Literal["checkerboard"]
    square: Length

    def board(self) -> Board:
        """Make the board."""
        return Board("checkerboard", pitch=self.square, **self.shared())


class _Circles(_Printed):
    type: Literal["circles"]
    spacing: Length
    asymmetric: bool = False

    def board(self) -> Board:
        """Make the board."""
        return Board("circles", pitch=self.spacing, asymmetric=self.asymmetric, **self.shared())


_TYPES: dict[str, type[_Charuco] | type[_AprilGrid] | type[_Checkerboard] | type[_Circles]] = {
    "charuco": _Charuco,
    "aprilgrid": _AprilGrid,
    "checkerboard": _Checkerboard,
    "circles": _Circles,
}


def board_from_yaml(content: bytes, path: Path) -> CalibrationObject:
    """Make an object from the file of a board.

    Raises:
        InputError: one line with the file, the key, what was found and what was expected.
    """
    values = parse_foreign_yaml(content, str(path))
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        found = values.get("format") if isinstance(values, dict) else None
        raise InputError(f"{path}: format: found {shorten(str(found))!r}, expected {FORMAT!r} (a printed board)")
    kind = values.get("type")
    if kind not in _TYPES:
        raise InputError(f"{path}: type: found {shorten(str(kind))!r}, expected one of {', '.join(_TYPES)}")
    record = validate(values, _TYPES[kind], str(path))
    try:
        board = record.board()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if len(board.points) > limits.MOST_FIDUCIALS or len(board.points) < 4:
        raise InputError(f"{path}: found {len(board.points)} points, expected 4 to {limits.MOST_FIDUCIALS}")
    return CalibrationObject.of_board(board, record.name or title_from_name(path))


def board_text(obj: CalibrationObject) -> str:
    """Make the text of a board's file, which `board_from_yaml` reads."""
    board = obj.board
    assert board is not None
    content: dict[str, Any] = {"format": FORMAT, "type": board.kind, "name": obj.name}
    content |= {"columns": board.columns, "rows": board.rows}
    if board.kind == "aprilgrid":
        content |= {"tag": board.marker, "gap": board.pitch - board.marker, "border": board.border}
        content["numbered_from"] = "bottom" if board.from_bottom else "top"
    else:
        content["spacing" if board.kind == "circles" else "square"] = board.pitch
    if board.kind == "charuco":
        content |= {"marker": board.marker, "legacy": board.legacy}
    if board.kind == "circles":
        content["asymmetric"] = board.asymmetric
    if board.is_coded:
        content |= {"dictionary": board.dictionary, "first_id": board.first_id}
    content |= {"inverted": board.inverted, "bend": Flow(board.bend)}
    if board.warp is not None:
        content["warp"] = board.warp
    return yaml_text(content)

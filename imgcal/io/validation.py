"""Records in files: strict types and bounds, and a one-line error about the first bad value."""

from __future__ import annotations

import reprlib
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError, create_model
from pydantic_core import CoreSchema

from imgcal.errors import InputError
from imgcal.io.names import nearest
from imgcal.messages import shorten

MOST_PROBLEMS = 1000  # that are looked at one by one
STRICT = ConfigDict(extra="forbid", strict=True, frozen=True)


class StrictModel(BaseModel):
    """Base of all records in our YAML files: unknown keys are errors, text is not taken for a number."""

    model_config = STRICT


class StrictRecord:
    """Base of frozen dataclasses that are values in Python and blocks of a YAML file alike.

    The annotations say what each field may be, as in a `StrictModel`: `Annotated[float, Field(ge=0)]`. A dataclass adds
    what its fields must be together by a `__post_init__` of its own, which calls this one first.
    """

    __pydantic_config__ = STRICT

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: one line with the field, what was found and what was expected.
        """
        content, model = dict(vars(self)), _make_model(type(self))  # type: ignore[arg-type]
        try:
            checked = model.model_validate(content)
        except ValidationError as error:
            raise InputError(_summary(error, content, model)) from error
        for name, value in checked:
            object.__setattr__(self, name, value)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Accept a mapping in place of the record, as files have it, with the same strict checks."""
        schema = handler(source)
        inner: Any = schema
        while inner["type"] != "dataclass":
            inner = inner["schema"]
        inner["strict"] = False
        return schema


ENTRY_NAMES = {"cameras": "camera"}
"""What one record is called, of keys that hold a list of named records."""

Model = TypeVar("Model", bound=StrictModel)


def validate(content: dict[str, Any], model: type[Model], where: str) -> Model:
    """Validate plain values, read or about to be written.

    Args:
        content: the values.
        model: what they must be.
        where: what errors begin with.

    Raises:
        InputError: one line with the place, what was found and what was expected.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{where}: {_summary(error, content, model)}") from error


@cache
def _make_model(record: type[StrictRecord]) -> type[BaseModel]:
    """A model with the fields of a dataclass."""
    hints = get_type_hints(record, include_extras=True)
    own: dict[str, Any] = {field.name: (hints[field.name], ...) for field in fields(record)}  # type: ignore[arg-type]
    return create_model(record.__name__, __config__=STRICT, **own)


def _summary(error: ValidationError, content: Any, model: type) -> str:
    """Describe the first problem; a misspelt key comes before the missing key that it causes."""
    if error.error_count() > MOST_PROBLEMS:
        keys = ", ".join(_keys(model, ()))
        return f"found {error.error_count():,} values that do not belong there, expected the keys {keys}"
    unknown = ("extra_forbidden", "unexpected_keyword_argument")
    problems = sorted(error.errors(), key=lambda problem: problem["type"] not in unknown)
    first = problems[0]
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    location, found = first["loc"], reprlib.repr(first["input"])
    place = _place(location, content)
    context = first.get("ctx", {})
    match first["type"]:
        case "extra_forbidden" | "unexpected_keyword_argument":
            key = shorten(str(location[-1]))
            known = _keys(model, location[:-1])
            before = _place(location[:-1], content)
            return f"{before}unknown key `{key}`{nearest(key, known) or ', expected one of ' + ', '.join(known)}{more}"
        case "missing":
            return f"{_place(location[:-1], content)}key `{location[-1]}` is missing{more}"
        case "too_short":
            return f"{place}found {context['actual_length']} values, expected {context['min_length']} or more{more}"
        case "too_long":
            return f"{place}found more than {context['max_length']} values, expected {context['max_length']}{more}"
        case "model_type" | "dataclass_type":
            return f"{place}found {found}, expected a group of keys: {', '.join(_keys(model, location))}{more}"
        case "value_error":
            return f"{place}{context['error']}{more}"
    return f"{place}found {found}, expected {first['msg'].removeprefix('Input should be ')}{more}"


def _place(location: tuple[str | int, ...], content: Any) -> str:
    """Name the place of a problem: `camera cam03: focal_length[1]: `."""
    words: list[str] = []
    previous = ""
    for step in location:
        try:
            content = content[step]
        except (KeyError, IndexError, TypeError):
            content = None
        if isinstance(step, int) and previous in ENTRY_NAMES:
            name = content.get("name") if isinstance(content, dict) else None
            words[-1] = f"{ENTRY_NAMES[previous]} {shorten(name) if isinstance(name, str) else f'number {step + 1}'}"
        elif isinstance(step, int):
            words[-1] += f"[{step}]"
        else:
            words.append(shorten(step))
        previous = str(step)
    return "".join(word + ": " for word in words)


def _keys(record: type, location: tuple[str | int, ...]) -> list[str]:
    """Follow a location down, and name the keys of the record there: of all of them where it may be one of several."""
    records = [record]
    for step in location:
        if isinstance(step, str):
            annotations = [field_annotations(one)[step] for one in records if step in field_annotations(one)]
            records = [inner for annotation in annotations for inner in records_in(annotation)]
    return [key for one in records for key in field_annotations(one)]


def field_annotations(record: type) -> dict[str, Any]:
    """Name the fields of a record, with what each may be."""
    if issubclass(record, BaseModel):
        return {name: field.annotation for name, field in record.model_fields.items()}
    hints = get_type_hints(record)
    return {field.name: hints[field.name] for field in fields(record)}  # type: ignore[arg-type]


def records_in(annotation: Any) -> list[type]:
    """Find the records that a field may hold."""
    if isinstance(annotation, type) and (issubclass(annotation, BaseModel) or is_dataclass(annotation)):
        return [annotation]
    return [record for argument in getattr(annotation, "__args__", ()) for record in records_in(argument)]

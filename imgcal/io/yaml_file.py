"""Reading YAML strictly (duplicate keys, unknown keys, wrong types are errors of one line) and writing it readably."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from imgcal.errors import InputError
from imgcal.io.names import check_regular, nearest
from imgcal.io.yaml_values import read_values
from imgcal.messages import shortened

MOST_BYTES = 2**26
MOST_PROBLEMS = 1000  # that are looked at one by one
_BaseDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class StrictModel(BaseModel):
    """Base of all records in our YAML files: unknown keys are errors, text is not taken for a number."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Flow(list[Any]):
    """A list that is written on one line: `[1.0, 2.0]`."""


class FlowMap(dict[str, Any]):
    """A mapping that is written on one line: `{a: 1.0, b: 2.0}`."""


Model = TypeVar("Model", bound=StrictModel)


def read_yaml(path: Path, model: type[Model], file_format: str, entry_names: Mapping[str, str] | None = None) -> Model:
    """Read and validate a YAML file.

    Args:
        path: the file.
        model: what the file holds; it has a field `format`.
        file_format: the required value of the key `format`, such as "imgcal-rig/1".
        entry_names: for keys that hold a list of named records, what one record is called: {"cameras": "camera"}.

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    content = _parse(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: found {_what(content)}, expected a mapping that starts with `format: {file_format}`")
    if content.get("format") != file_format:
        found = f"`format: {reprlib.repr(content['format'])}`" if "format" in content else "no key `format`"
        raise InputError(f"{path}: found {found}, expected `format: {file_format}`")
    return validated(content, model, str(path), entry_names)


def validated(
    content: dict[str, Any], model: type[Model], where: str, entry_names: Mapping[str, str] | None = None
) -> Model:
    """Validate plain values, read or about to be written; errors begin with `where`, the rest is as for `read_yaml`."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{where}: {_summary(error, content, model, entry_names or {})}") from error


def parse_yaml(text: str, where: str) -> Any:
    """Read a value from YAML text that does not come from a file; errors begin with `where`."""
    try:
        return read_values(text.encode(errors="replace"))
    except yaml.YAMLError as error:
        raise InputError(f"{where}: found {reprlib.repr(text)}, expected a value in YAML") from error


def yaml_text(content: dict[str, Any]) -> str:
    """Write plain values as YAML in the given order; floats in their shortest exact form."""
    return yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=2**30, allow_unicode=True
    )


class _Dumper(_BaseDumper):
    """Flow style for `Flow` and `FlowMap`, block style for the rest."""


# 1e-5 is a number to the reader: the writer puts quotes around a name that looks like it.
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)
_Dumper.add_representer(Flow, lambda d, v: d.represent_sequence("tag:yaml.org,2002:seq", v, flow_style=True))
_Dumper.add_representer(FlowMap, lambda d, v: d.represent_mapping("tag:yaml.org,2002:map", v.items(), flow_style=True))


def _parse(path: Path) -> Any:
    check_regular(path)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: found {path.stat().st_size:,} bytes, expected at most {MOST_BYTES:,}")
        return read_values(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" in line {mark.line + 1}" if mark is not None else ""
        raise InputError(f"{path}: not valid YAML{line}: {error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not a YAML text file: {str(error).splitlines()[0]}") from error


def _summary(error: ValidationError, content: Any, model: type[BaseModel], entry_names: Mapping[str, str]) -> str:
    """Put the first problem into words; a misspelt key comes before the missing key that follows from it."""
    if error.error_count() > MOST_PROBLEMS:
        keys = ", ".join(model.model_fields)
        return f"found {error.error_count():,} values that do not belong there, expected the keys {keys}"
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    first = problems[0]
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    location, found = first["loc"], reprlib.repr(first["input"])
    place = _place(location, content, entry_names)
    context = first.get("ctx", {})
    match first["type"]:
        case "extra_forbidden":
            key = shortened(str(location[-1]))
            known = _record(model, location[:-1]).model_fields
            before = _place(location[:-1], content, entry_names)
            return f"{before}unknown key `{key}`{nearest(key, known) or ', expected one of ' + ', '.join(known)}{more}"
        case "missing":
            return f"{_place(location[:-1], content, entry_names)}key `{location[-1]}` is missing{more}"
        case "too_short":
            return f"{place}found {context['actual_length']} values, expected {context['min_length']} or more{more}"
        case "too_long":
            return f"{place}found more than {context['max_length']} values, expected {context['max_length']}{more}"
        case "value_error":
            return f"{place}{context['error']}{more}"
    return f"{place}found {found}, expected {first['msg'].removeprefix('Input should be ')}{more}"


def _place(location: tuple[str | int, ...], content: Any, entry_names: Mapping[str, str]) -> str:
    """Name the place of a problem: `camera cam03: focal_length[1]: `."""
    words: list[str] = []
    previous = ""
    for step in location:
        try:
            content = content[step]
        except (KeyError, IndexError, TypeError):
            content = None
        if isinstance(step, int) and previous in entry_names:
            name = content.get("name") if isinstance(content, dict) else None
            words[-1] = f"{entry_names[previous]} {shortened(name) if isinstance(name, str) else f'number {step + 1}'}"
        elif isinstance(step, int):
            words[-1] += f"[{step}]"
        else:
            words.append(shortened(step))
        previous = str(step)
    return "".join(word + ": " for word in words)


def _record(model: type[BaseModel], location: tuple[str | int, ...]) -> type[BaseModel]:
    """Follow a location down to the model of the record there."""
    for step in location:
        if isinstance(step, str):
            model = next(m for m in _models_in(model.model_fields[step].annotation))
    return model


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in getattr(annotation, "__args__", ()) for model in _models_in(argument)]


def _what(content: Any) -> str:
    return "an empty file" if content is None else f"{type(content).__name__} {reprlib.repr(content)}"

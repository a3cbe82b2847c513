"""The keys of a record: type, default and meaning, from its fields and the comments beside them."""

from __future__ import annotations

import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from pydantic import TypeAdapter

from imgcal.io.validation import field_annotations, records_in
from imgcal.messages import shorten

# What a schema says of a type, and the words for it.
NAMES = {"integer": "integer", "number": "number", "string": "text", "boolean": "true or false", "null": "null"}
BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
FAR = 1e6  # larger bounds only reject nonsense: leave them out of the table


@dataclass(frozen=True)
class Key:
    """One key of a file."""

    path: str  # "training.steps"
    kind: str  # "integer >= 1 or null"
    default: str  # "64"; empty = the key must be given
    meaning: str  # empty where the source says nothing


def list_keys(record: type, prefix: str = "") -> Iterator[Key]:
    """List the keys of a record, and of the records within it, in the order of their fields.

    Args:
        record: a `StrictModel` or a `StrictRecord`.
        prefix: of the paths, such as "training.".
    """
    schema, meanings = TypeAdapter(record).json_schema(), field_comments(record)
    required, shared = schema.get("required", ()), schema.get("$defs", {})
    for name, annotation in field_annotations(record).items():
        inner = records_in(annotation)
        if len(inner) == 1:
            yield from list_keys(inner[0], f"{prefix}{name}.")
            continue
        if inner:  # one of several, by the keys that are given: defaults are those of the kind
            for one in inner:
                yield from (replace(key, default="") for key in list_keys(one, f"{prefix}{name}."))
            continue
        found = schema["properties"][name]
        default = "" if name in required else _value(found.get("default"))
        yield Key(prefix + name, _kind(found, shared), default, meanings.get(name, ""))


@cache
def field_comments(record: type) -> Mapping[str, str]:
    """Read the comments behind the fields of a class and of its bases, by the name of the field."""
    found: dict[str, str] = {}
    for one in reversed(record.__mro__):
        if one.__module__.split(".")[0] not in ("builtins", "abc", "typing", "pydantic"):
            found |= _own_comments(one)
    return found


def _own_comments(record: type) -> dict[str, str]:
    """Comments at the end of statements `name: type`, and those on lines of their own that follow them."""
    try:
        source = inspect.getsource(record)
    except (OSError, TypeError):
        return {}
    found: dict[str, str] = {}
    line: list[str] = []
    name, depth = "", 0
    for token in tokenize.generate_tokens(io.StringIO(textwrap.dedent(source)).readline):
        match token.type:
            case tokenize.INDENT | tokenize.DEDENT:
                depth += 1 if token.type == tokenize.INDENT else -1
            case tokenize.NEWLINE:
                line = []
            case tokenize.COMMENT if depth == 1 and len(line) > 1 and line[1] == ":":
                name = line[0]
                found[name] = token.string.lstrip("#: ")
            case tokenize.NAME | tokenize.OP | tokenize.NUMBER | tokenize.STRING:
                line.append(token.string)
    return found


def _kind(schema: Mapping[str, Any], shared: Mapping[str, Any]) -> str:
    """Put a type and its bounds into words."""
    if "$ref" in schema:
        return _kind(shared[schema["$ref"].rsplit("/", 1)[1]], shared)
    if "anyOf" in schema:
        return " or ".join(_kind(one, shared) for one in schema["anyOf"])
    if "const" in schema:
        return str(schema["const"])
    if "enum" in schema:
        return " or ".join(map(str, schema["enum"]))
    match schema.get("type"):
        case "array":
            each = schema.get("prefixItems") or [schema.get("items", {})]
            return f"list of {_kind(each[0], shared)}"
        case "object":
            values = schema.get("additionalProperties")
            return f"{_kind(values, shared)} by name" if isinstance(values, dict) else "values by name"
    bounds = [f"{sign} {schema[key]:g}" for key, sign in BOUNDS.items() if abs(schema.get(key, FAR)) < FAR]
    return " ".join([NAMES.get(schema.get("type", ""), "value"), " and ".join(bounds)]).strip()


def _value(default: Any) -> str:
    """Write a default as a file has it."""
    match default:
        case None | True | False:
            return {None: "null", True: "true", False: "false"}[default]
        case str():
            return shorten(default) or '""'
        case list() | tuple():
            return f"[{', '.join(map(_value, default))}]"
        case float():
            return f"{default:g}"
    return str(default)

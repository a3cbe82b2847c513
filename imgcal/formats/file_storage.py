"""OpenCV's FileStorage: matrices in YAML, XML or JSON, to plain values and back."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from imgcal.formats.documents import Document, Element
from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.lens import Array
from imgcal.formats.source import Source
from imgcal.formats.values import numbers

ROOT = "opencv_storage"


def storages(source: Source) -> list[tuple[Document, dict[str, Any]]]:
    """The documents that may be FileStorages, as keys and values."""
    found = list(source.mappings)
    for document in source.documents:
        if isinstance(document.value, Element) and document.value.tag == ROOT:
            found.append((document, {child.tag: _plain(child) for child in document.value.children}))
    return found


def merge_storages(source: Source) -> dict[str, Any]:
    """The keys and values of all FileStorages together; the first that has a key counts."""
    together: dict[str, Any] = {}
    for _, values in storages(source):
        for key, value in values.items():
            together.setdefault(key, value)
    return together


def key_place(source: Source, key: str) -> tuple[Path, tuple[str, ...]]:
    """Where the numbers of a key stand: the document that counts, and the keys to them."""
    document, values = next((document, values) for document, values in storages(source) if key in values)
    outer = (ROOT,) if document.kind == "xml" else ()
    inner = ("data",) if isinstance(values[key], dict) else ()
    return document.path, (*outer, key, *inner)


def is_matrix(value: Any) -> bool:
    """Tell whether a value is a matrix of a FileStorage."""
    return (
        isinstance(value, dict)
        and {"data", "dt"} <= value.keys()
        and ("sizes" in value or {"rows", "cols"} <= value.keys())
    )


def matrix(value: Any, what: str) -> Array:
    """Read a matrix: (rows, cols) with the channels in the columns; an n-dimensional one in its own shape."""
    if not is_matrix(value):
        raise FormatError(f"{what}: expected a matrix of OpenCV's FileStorage")
    data = np.array(numbers(value["data"], what))
    sizes = value["sizes"] if "sizes" in value else [value["rows"], value["cols"]]
    shape = [int(size) for size in numbers(sizes, what)]
    channels = int(str(value["dt"]).strip("\"' ")[:-1] or 1) if str(value["dt"]).strip("\"' ")[:-1].isdigit() else 1
    if min(shape, default=0) < 0 or math.prod(shape) * channels != data.size:
        raise FormatError(f"{what}: found {data.size} numbers in a matrix of {shape} with {channels} channels")
    if "sizes" in value and channels == 1:
        return data.reshape(shape)
    return data.reshape(shape[0] if shape else 1, -1) if data.size else data.reshape(0, 0)


def storage_text(content: dict[str, Any]) -> bytes:
    """Write matrices, numbers, texts and lists of texts as the YAML of a FileStorage, read by OpenCV 3, 4 and 5."""
    lines = ["%YAML:1.0", "---"]
    for key, value in content.items():
        if isinstance(value, np.ndarray):
            rows, columns = value.reshape(len(value), -1).shape
            kind = "i" if value.dtype.kind == "i" else "d"
            data = ", ".join(_number(entry) for entry in value.ravel().tolist())
            lines += [f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", f"   dt: {kind}"]
            lines += [f"   data: [ {data} ]"]
        elif isinstance(value, list):
            lines += [f"{key}:", *(f"   - {_quote(str(entry))}" for entry in value)]
        else:
            lines.append(f"{key}: {_quote(value) if isinstance(value, str) else _number(value)}")
    return ("\n".join(lines) + "\n").encode()


def _number(value: float) -> str:
    text = repr(value)
    return text.replace(".0", ".") if text.endswith(".0") else text


def _quote(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _plain(element: Element) -> Any:
    """An XML node of a FileStorage as the same plain values that its YAML has."""
    if not element.children:
        text = element.text.strip()
        return text.strip('"') if text.startswith('"') else text
    if all(child.tag == "_" for child in element.children):
        return [_plain(child) for child in element.children]
    return {child.tag: _plain(child) for child in element.children}

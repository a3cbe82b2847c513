"""JSON for browsers: short numbers, None for nan and infinity, safe inside a page."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray


def round_values(values: NDArray[np.float64], digits: int = 5) -> Any:
    """Nested lists of numbers of so many significant digits; None for nan and infinity.

    Examples:
        >>> round_values(np.array([1.23456789, np.nan, 12345678.0]))
        [1.2346, None, 12346000.0]
    """
    values = np.asarray(values, dtype=np.float64)
    known = np.isfinite(values)
    size = np.where(known & (values != 0), np.abs(values), 1.0)
    scale = 10.0 ** (digits - 1 - np.floor(np.log10(size)))
    short = np.where(known, np.round(np.where(known, values, 0.0) * scale) / scale, np.nan)
    return _replace_nan(short.tolist())


def _replace_nan(values: Any) -> Any:
    if isinstance(values, list):
        return [_replace_nan(value) for value in values]
    return None if values != values else values


def to_json(content: Any) -> str:
    """Write JSON in one line, which may stand inside `<script>`, too."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def stream_event(kind: str, content: Any) -> bytes:
    """Write a server-sent event."""
    return f"event: {kind}\ndata: {to_json(content)}\n\n".encode()

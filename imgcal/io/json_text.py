"""JSON inside other files, with a limit on its depth."""

from __future__ import annotations

import json
from typing import Any

MOST_DEPTH = 32


def read_json(text: str) -> Any:
    """Read a value.

    Raises:
        ValueError: not JSON, or nested too deeply.
    """
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise ValueError(f"nested more than {MOST_DEPTH} deep") from error
    level = [value]
    for _ in range(MOST_DEPTH):
        level = [inner for outer in level for inner in _inside(outer)]
        if not level:
            return value
    raise ValueError(f"nested more than {MOST_DEPTH} deep")


def _inside(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []

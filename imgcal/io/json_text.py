"""JSON inside other files, with a limit on its depth, and the log of a training run: a line of JSON each row."""

from __future__ import annotations

import json
from pathlib import Path
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
        level = [inner for outer in level for inner in _values_inside(outer)]
        if not level:
            return value
    raise ValueError(f"nested more than {MOST_DEPTH} deep")


def _values_inside(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """Read metrics.jsonl up to the first incomplete line, as a killed process leaves one; no file gives no metrics."""
    path = Path(path)
    rows: list[dict[str, Any]] = []
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        try:
            row = read_json(line)
        except ValueError:
            break
        if not (isinstance(row, dict) and isinstance(row.get("step"), int)):
            break
        rows.append(row)
    return rows

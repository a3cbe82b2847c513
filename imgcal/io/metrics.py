"""The log of a training run: metrics.jsonl, one row of plain values a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from imgcal.io.json_text import read_json


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

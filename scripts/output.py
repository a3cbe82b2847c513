"""Helpers shared by the scripts: folders of results, JSON with the machine's name, sections of pages, small figures."""

from __future__ import annotations

import io
import json
import math
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from imgcal.errors import InputError, RefusedError
from imgcal.io import write_bytes, write_text

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
WORK = ROOT / "out" / "work"
"""Progress of campaigns that can be resumed."""
COLOURS = 128
"""Of a screenshot."""
BLUE, RED, GREEN, GREY = "#1f5fa8", "#c43c2f", "#2e8b57", "#777777"


def save_picture(screenshot: bytes, path: Path) -> None:
    """Save the screenshot of a page as a small PNG: its colours are few."""
    packed, picture = io.BytesIO(), Image.open(io.BytesIO(screenshot)).convert("RGB")
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(packed, "png", optimize=True)
    write_bytes(path, packed.getvalue())


def machine(device: str = "cpu") -> str:
    """Describe the processor and the versions, without the host name."""
    path = Path("/proc/cpuinfo")
    models = [x for x in path.read_text().splitlines() if x.startswith("model name")] if path.is_file() else []
    name = models[0].split(":")[1].strip() if models else platform.processor()
    gpu = f", {torch.cuda.get_device_name(0)}" if device.startswith("cuda") else ""
    versions = f"Python {platform.python_version()}, torch {torch.__version__}, OpenCV {cv2.__version__}"
    return f"{name}, {os.cpu_count()} cores{gpu}, {versions}"


def surroundings(device: str = "cpu") -> dict[str, Any]:
    """Entries at the top of every result file: machine, threads, load."""
    load = round(os.getloadavg()[0], 2)  # well above zero: the machine was busy, so times are too long
    return {"machine": machine(device), "threads": torch.get_num_threads(), "load_average": load}


@cache
def commit() -> str:
    """Short hash of the commit at the first call, whose code is measured; empty outside a repository."""
    asked = ["git", "rev-parse", "--short=8", "HEAD"]
    return subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def write_json(path: Path, result: dict[str, Any]) -> None:
    """Write a result in one step, numbers to five digits; those that are not finite become null."""
    make_folder(path.parent)
    write_text(path, json.dumps(_rounded(result), indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a result.

    Raises:
        InputError: not JSON.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: found no readable JSON, expected a result of scripts/results: {error}") from error
    return content


def make_folder(folder: Path) -> None:
    """Create a folder unless it exists.

    Raises:
        InputError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot create this folder: {error.strerror or error}") from error


@contextmanager
def figure(path: Path, panels: int = 1, rows: int = 1, size: tuple[float, float] = (7.0, 3.6)) -> Iterator[list[Axes]]:
    """Yield panels to draw on; write them as a PNG of few colours (about 20 kB) unless the block raises."""
    canvas = FigureCanvasAgg(Figure(figsize=size, dpi=100, layout="constrained"))
    axes = [canvas.figure.add_subplot(rows, panels, number + 1) for number in range(rows * panels)]
    yield axes
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
        one.grid(True, which="major", color="#dddddd", linewidth=0.6)
        one.set_axisbelow(True)
    drawn, packed = io.BytesIO(), io.BytesIO()
    canvas.print_png(drawn)
    Image.open(drawn).convert("RGB").quantize(48, dither=Image.Dither.NONE).save(packed, "PNG", optimize=True)
    make_folder(path.parent)
    write_bytes(path, packed.getvalue())


def markdown(head: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table; short rows are padded with empty cells."""
    columns = list(head)
    lines = [columns, ["---"] * len(columns)]
    lines += [[*row, *[""] * (len(columns) - len(row))] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def replaced(page: str, sections: Mapping[str, str], where: Path) -> str:
    """Replace the text between the markers `<!-- begin NAME -->` and `<!-- end NAME -->` of each section.

    Raises:
        InputError: a marker is missing.
    """
    for name, text in sections.items():
        pattern = re.compile(rf"(<!-- begin {re.escape(name)} -->\n).*?(<!-- end {re.escape(name)} -->)", re.DOTALL)
        if not pattern.search(page):
            raise InputError(f"{where}: found no markers of `{name}`, expected <!-- begin {name} --> and its end")
        page = pattern.sub(lambda match, text=text: f"{match[1]}\n{text}\n\n{match[2]}", page)  # type: ignore[misc]
    return page


def fill(page: Path, sections: Mapping[str, str]) -> None:
    """Replace the sections of a page between their markers; the file is written in one step.

    Raises:
        InputError: a marker is missing; the page stays as it was.
    """
    write_text(page, replaced(page.read_text("utf-8"), sections, page))


def publish(result: dict[str, Any], out: Path, official: Path, page: Path, name: str, table: str) -> None:
    """Write a result and print its table; write the official one's into its page as well, where `name` marks it."""
    write_json(out, result)
    if out.resolve() == official.resolve():
        fill(page, {name: table})
    print(table)


def command(main: Callable[[], object]) -> None:
    """Run as a command: bad input is one line on standard error and exit code 2, a refusal exit code 3."""
    try:
        main()
    except (InputError, RefusedError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        sys.exit(2 if isinstance(error, InputError) else 3)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value

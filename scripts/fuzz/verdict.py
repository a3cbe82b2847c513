"""Run a case, and check what must be true afterwards."""

from __future__ import annotations

import io
import json
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from imgcal.cli.compiling import HINT, WAIT
from imgcal.cli.main import main
from imgcal.errors import InputError
from imgcal.io import read_rig
from scripts.fuzz.cases import Case

NOISE = re.compile(r"Traceback|Warning|internal error|libpng|Corrupt JPEG|\[avi|^\s+File ", re.MULTILINE)
CODES = (0, 2, 3)
LONGEST = 1100  # characters of the message


def run(case: Case) -> str:
    """Run a case in this process; return its fault in words, empty if there is none."""
    return attempt(case)[1]


def attempt(case: Case) -> tuple[object, str]:
    """Run a case in this process; return its exit code and its fault in words, empty if there is none."""
    before = _listing(case.folder)
    torch.set_num_threads(1)  # an experiment may have set another number for the whole process
    with _written() as texts, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as the installed command does
        try:
            code: object = main(case.arguments)
        except BaseException as error:
            code = f"{type(error).__name__}: {error}"
    return code, judge(case, code, texts[1], before)


def judge(case: Case, code: object, error: str, before: set[Path]) -> str:
    """Compare what a case left behind with what imgcal promises."""
    if code not in CODES:
        return f"exit code {code}"
    if NOISE.search(error):
        return f"noise on standard error: {error[-2000:]}"
    notices = tuple(f"imgcal: {notice}" for notice in (HINT, WAIT))
    lines = [line for line in error.splitlines() if line.startswith("imgcal: ") and not line.startswith(notices)]
    if len(lines) != (code != 0):
        return f"{len(lines)} lines with exit code {code}: {error[-2000:]!r}"
    if lines and (not error.endswith(lines[0] + "\n") or len(lines[0]) > LONGEST):
        return f"the line is not the last one, or is too long: {error[-2000:]!r}"
    return _left_behind(case, code, before)


def _left_behind(case: Case, code: object, before: set[Path]) -> str:
    out = case.folder / "out"
    new = _listing(case.folder) - before
    beside = [path for path in new if path.parts[0] != "out" and path != Path("out.csv")]
    half = [path for path in new if path.name.startswith(".") or path.suffix == ".tmp"]
    if beside or half:
        return f"left behind: {sorted(map(str, beside + half))[:5]}"
    command = case.arguments[0]
    if code == 2 and command not in ("train", "simulate") and new:
        return f"unusable input, but written: {sorted(map(str, new))[:5]}"
    result = out / "result.json"
    if command != "calibrate" or case.arguments[-case.arguments[::-1].index("--out")] != str(out) or code == 2:
        return ""
    try:
        content = json.loads(result.read_text(), parse_constant=_no_constant)
        if content["status"] != ("ok" if code == 0 else "refused"):
            return f"exit code {code} with status {content['status']}"
        if (out / "rig.yaml").exists() != (code == 0):
            return f"exit code {code}, rig.yaml {(out / 'rig.yaml').exists()}"
        if code == 0:
            read_rig(out / "rig.yaml")
    except (OSError, ValueError, InputError) as error:
        return f"what was written cannot be read: {error}"
    return ""


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON")


def _listing(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


@contextmanager
def _written() -> Iterator[list[str]]:
    """Capture what this process writes, from Python or native code; yields a list that gets both texts at the end."""
    texts: list[str] = []
    streams = (sys.stdout, sys.stderr)
    kept = [os.dup(1), os.dup(2)]
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        for stream, file, number in zip(streams, (output, errors), (1, 2), strict=True):
            stream.flush()
            os.dup2(file.fileno(), number)
        sys.stdout, sys.stderr = (
            io.TextIOWrapper(io.FileIO(number, "w", closefd=False), errors="backslashreplace", write_through=True)
            for number in (1, 2)
        )
        try:
            yield texts
        finally:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:
                    stream.flush()
            sys.stdout, sys.stderr = streams
            for number, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, number)
                os.close(copy)
            for file in (output, errors):
                file.seek(0)
                texts.append(file.read().decode(errors="replace"))

"""Test every format with files and readers of its tool: `python -m scripts.results.formats --readers PYTHON ...`.

Reading: the real files of IMGCAL_FORMATS are compared with pixels that other programs computed. Writing: the tool
itself reads and projects a rig of three cameras (two if the format allows no more), see `format_readers.py`, in the
first of the given Pythons that has it. Writes docs/results/formats.json and the table of docs/formats.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from imgcal.formats import (
    FORMATS,
    ForeignCamera,
    ForeignRig,
    Format,
    Lens,
    convert_rig,
    in_millimetres,
    known_points,
    millimetres,
    read_foreign_rig,
    select_cameras,
)
from imgcal.formats.values import rotation_from_vector
from scripts.output import RESULTS, ROOT, command, fill, markdown, read_json, surroundings, write_json
from scripts.results.format_readers import READERS

RESULT, PAGE = RESULTS / "formats.json", ROOT / "docs" / "formats.md"
READ_BY = Path(__file__).with_name("format_readers.py")


def main() -> None:
    """Measure, and rewrite the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--readers", nargs="*", default=[], help="Pythons that have the tools, besides this one")
    given = parser.parse_args()
    pythons = [sys.executable, *given.readers]
    result: dict[str, Any] = {**surroundings(), "formats": {}}
    for one in FORMATS:
        row = {"title": one.title, "read": reading(one), "write": None}
        if one.write is not None:
            row["write"] = writing(one, pythons)
        result["formats"][one.name] = row
        print(one.name, json.dumps(row))
    write_json(RESULT, result)
    fill(PAGE, {"verified": table(read_json(RESULT))})


def reading(one: Format) -> dict[str, Any]:
    """Largest error in pixels over all real files of a format, and the numbers of files and cameras."""
    folder = Path(os.environ["IMGCAL_FORMATS"])
    files, cameras, worst = 0, 0, 0.0
    for path in sorted(folder.rglob("*.expected.json")):
        source = path.with_name(path.name.removesuffix(".expected.json"))
        rig = read_foreign_rig(source)
        if rig.format != one.name:
            continue
        expected = json.loads(path.read_text("utf-8"))
        unit = "mm" if "mm" in expected["unit_note"].split(";")[0] else "m"
        rows = expected["cameras"][: len(rig.cameras)]  # for images without a rig: those of the first snapshot
        for camera, row in zip(in_millimetres(rig, str(source), unit).cameras, rows, strict=True):
            away = np.abs(camera.project(np.array(row["points_rig_mm"])) - np.array(row["uv"]))
            worst, cameras = max(worst, float(away.max())), cameras + 1
        files += 1
    return {"files": files, "cameras": cameras, "worst_px": worst}


def writing(one: Format, pythons: list[str]) -> dict[str, Any]:
    """Largest error of known points in a written file, as projected by the tool itself and by our own reader."""
    rig = sample(one)
    made = convert_rig(rig, one.name, "rig")
    row: dict[str, Any] = {"own_reader_px": made.round_trip, "reader": None, "worst_px": None}
    if one.name not in READERS:
        return row
    placed = rig.in_camera_frame() if one.from_first else rig
    points = {camera.name: at for camera, at in zip(placed.cameras, known_points(placed), strict=True)}
    scale = 1.0 / millimetres(one.unit)
    with tempfile.TemporaryDirectory() as folder:
        for name, content in made.files.items():
            (Path(folder) / (name or "calibration.toml")).write_bytes(content)
        path = folder if "" not in made.files else f"{folder}/calibration.toml"
        asked = {"tool": one.name, "path": path, "points": {name: (at * scale).tolist() for name, at in points.items()}}
        answer = ask(asked, pythons)
    if answer is None:
        return row
    worst = 0.0
    for camera in placed.cameras:
        away = np.abs(np.array(answer["uv"][camera.name]) - camera.project(points[camera.name]))
        worst = max(worst, float(away.max()))
    return {**row, "reader": answer["version"], "worst_px": worst}


def ask(asked: dict[str, Any], pythons: list[str]) -> dict[str, Any] | None:
    """Answer from the first Python that has the tool."""
    for python in pythons:
        done = subprocess.run([python, READ_BY], input=json.dumps(asked), capture_output=True, text=True, check=False)
        if done.returncode == 0:
            answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
            return answer
        print(f"{asked['tool']}: {python}: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
    return None


def sample(one: Format) -> ForeignRig:
    """Make cameras with all coefficients that a format can express, and a fisheye if it can."""
    numbers = (-0.11, 0.04, 0.0007, -0.0004, 0.003, 0.02, -0.01, 0.002, 0.0003, -0.0002, 0.0001, 0.0004, 0.01, -0.02)
    lenses = [
        Lens((1010.5, 1012.25), (641.3, 478.9), numbers[: one.holds.opencv[-1]]),
        Lens((990.0, 991.0), (635.0, 481.0)),
    ]
    lenses.insert(1, Lens((600.0, 601.0), (639.0, 470.0), (0.01, -0.02, 0.003, -0.001), "fisheye"))
    if not one.holds.fisheye or one.name in ("opencv-stereo", "pose2sim"):  # Pose2Sim triangulates without fisheyes
        lenses[1] = Lens((800.0, 801.0), (639.0, 470.0), (0.05, -0.02, 0.001, 0.002))
    cameras = []
    for number, lens in enumerate(lenses):
        rotation = rotation_from_vector(np.array([0.05, -0.12 + 0.1 * number, 0.02 * number]))
        centre = np.array([300.0 * number - 90.0, 12.0 * number, 40.0 + 25.0 * number])
        cameras.append(ForeignCamera(str(number), lens, (1280, 960), rotation, -rotation @ centre))
    rig = ForeignRig("sample", tuple(cameras), "mm", "its own")
    return select_cameras(rig, tuple(rig.names[: one.cameras[1]]))


def table(result: dict[str, Any]) -> str:
    """Make the table of what was verified, by format."""
    rows = []
    for name, row in result["formats"].items():
        read, write = row["read"], row["write"]
        seen = (
            f"{read['cameras']} in {read['files']}: {read['worst_px']:.1e}"
            if read["files"]
            else "no file in the public set"
        )
        if name == "caliscope-config":
            seen = "as `caliscope`"
        if write is None:
            rows.append((row["title"], f"`{name}`", seen, "only read", "–"))
            continue
        tool = write["reader"] or ("not available" if name in READERS else "none on PyPI or Debian")
        worst = f"{write['worst_px']:.1e}" if write["worst_px"] is not None else "–"
        rows.append((row["title"], f"`{name}`", seen, f"{write['own_reader_px']:.1e}", f"{tool}: {worst}"))
    head = (
        "format",
        "name",
        "read: cameras in files, worst px",
        "written, read by us: px",
        "read by the tool itself: worst px",
    )
    return markdown(head, rows)


if __name__ == "__main__":
    command(main)

"""The stories of docs/formats.md, run as they are printed: from a foreign file to a foreign file."""

import contextlib
import doctest
import io
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imgcal.cli.main import main
from imgcal.formats import from_camera_rig, in_millimetres, load_rig, read_foreign_rig, select_cameras, worst_difference

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r"^```(python|console)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def told(title: str) -> list[tuple[str, str]]:
    """The blocks of the story whose heading holds a title, and of those before it."""
    stories = (ROOT / "docs" / "formats.md").read_text("utf-8").partition("## Stories")[2].partition("\n## ")[0]
    assert title in stories
    return FENCE.findall(stories)


def run(blocks: list[tuple[str, str]]) -> dict[str, Any]:
    """Go through the blocks; what the commands say must be what stands under them."""
    names: dict[str, Any] = {}
    for kind, text in blocks:
        if kind == "python":
            exec(compile(text, "docs/formats.md", "exec"), names)
            continue
        for line, expected in re.findall(r"^\$ imgcal (.*)\n((?:(?!\$ ).*\n)*)", text, re.MULTILINE):
            said = io.StringIO()
            expected, _, refused = expected.partition("exit code ")
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said if refused else sys.stderr):
                code = main([*shlex.split(line), *(["--no-report"] if line.startswith("calibrate") else [])])
            assert code == int(refused or 0), line
            assert doctest.OutputChecker().check_output(expected, said.getvalue(), OPTIONS), said.getvalue()
    return names


def test_stories_end_as_they_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "tests" / "stories", tmp_path / "stories")
    monkeypatch.chdir(tmp_path / "stories")
    names = run(told("A Kalibr rig"))
    # ROS has the pair where it is now, not where it was.
    factory = load_rig("camchain.yaml")
    pair = ("cam3", "cam4")
    true = select_cameras(from_camera_rig(factory.retract(names["bump"])), pair)
    ros = in_millimetres(read_foreign_rig("ros"), "ros")
    assert worst_difference(true, ros)[0] < 5
    assert worst_difference(select_cameras(from_camera_rig(factory), pair), ros)[0] > 50
    # COLMAP's new model has its pixels, and the unit of its old one is the ruler's.
    models = (("colmap", "1m"), ("colmap-new", "m"))
    before, after = (in_millimetres(read_foreign_rig(name), name, unit) for name, unit in models)
    assert [camera.image_size for camera in before.cameras] == [camera.image_size for camera in after.cameras]
    truth = from_camera_rig(names["truth"].rig)
    assert worst_difference(truth, after)[0] < 5
    rows = (tmp_path / "stories" / "colmap-new" / "cameras.txt").read_text().splitlines()
    cx = float(rows[1].split()[6])
    assert cx == pytest.approx(after.cameras[0].lens.principal_point[0] + 0.5)
    # Pose2Sim's cameras see the room where it is, by the wand's scale; what was refused is not there.
    room = in_millimetres(read_foreign_rig("Calib.toml"), "Pose2Sim")
    assert room.format == "pose2sim" and room.names == ["0", "1", "2", "3"]
    rigs = (from_camera_rig(names["room"]), room)
    true, found = (np.array([camera.centre for camera in rig.cameras]) for rig in rigs)
    apart, apart_found = (np.linalg.norm(at[:, None] - at, axis=-1) for at in (true, found))
    assert np.abs(apart_found - apart).max() < 0.005 * apart.max()
    assert np.abs(found[0]).max() < 1e-6 and not Path("Calib-exact.toml").exists()

"""README's commands and Python run as printed; slow ones are listed with the test that covers each."""

import re
import shlex
from pathlib import Path

import pytest

from imgcal.cli.main import main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = [
    re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in re.findall(r"(?:^    .*\n|^\n(?=    ))+", README, re.M)
]
COMMANDS = [
    command.split("#")[0].strip()
    for block in BLOCKS
    for command in re.sub(r"\\\n\s*", "", block).splitlines()
    if re.match(r"(imgcal|scripts/\w+|pip) ", command) and not command.startswith("imgcal: ")
]
COMMANDS += re.findall(r"\| `(imgcal [^`]+)` \|", README)  # the table of jobs
DEMO = next(command for command in COMMANDS if "sample:O10" in command)
LONG = {
    "pip install": "a network",
    "uv pip install": "a network",
    "scripts/demo": "the same command as the demo's",
    "scripts/test": "this suite",
    "imgcal train": "cli/test_train",
    "imgcal compare": "cli/test_evaluate",
    "imgcal evaluate": "cli/test_evaluate",
    "imgcal simulate": "cli/test_simulate: twenty snapshots at full size take half a minute",
    "imgcal calibrate CAPTURE": "cli/test_calibrate",
    "imgcal detect": "cli/test_calibrate",
    "imgcal score": "cli/test_score",
    "imgcal fleet": "cli/test_fleet",
    "imgcal watch": "cli/test_watch",
    "imgcal convert": "cli/test_convert",
    "imgcal demo": "cli/test_demo",
    "imgcal export": "cli/test_export",
}
"""Beginnings of commands that are not run here."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder: the sample is part of the package."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_command_is_tried_here_or_known_to_take_long() -> None:
    assert len(COMMANDS) > 6
    left = [command for command in COMMANDS if command != DEMO and not command.startswith(tuple(LONG))]
    assert not left, left


def test_the_demo_prints_what_stands_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(shlex.split(DEMO)[1:]) == 0
    printed = [re.sub(r"[\d.]+", "#", line) for line in capsys.readouterr().out.splitlines()]
    block = next(block for block in BLOCKS if "reprojection error before" in block)
    shown = [re.sub(r"[\d.]+", "#", line) for line in block.splitlines() if line]
    shown = shown[next(i for i, line in enumerate(shown) if line.startswith("reprojection error")) :]
    for line in shown:
        assert any(found.startswith(line.split("; #")[0]) for found in printed), line
    files = {path.name for path in (folder / "out" / "demo").iterdir()}
    assert files == {"rig.yaml", "rig.posterior.safetensors", "result.json", "report.html"}


def test_python_runs_to_its_end(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = next(block for block in BLOCKS if "import imgcal\n" in block)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    assert (folder / "recalibrated.yaml").is_file()
    assert "CameraRig('O10 half resolution'" in capsys.readouterr().out
    assert names["name"] == "00003"  # the running rig has seen the last snapshot

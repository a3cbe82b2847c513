"""A core install calibrates, and says in one line which extra other features need."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from imgcal.extras import EXTRAS, advice, missing

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "data" / "samples" / "O10"
IMPORTED_AS = {"prometheus-client": "prometheus_client", "pyzmq": "zmq"}
BROUGHT_ALONG = ("huggingface_hub", "markupsafe", "PIL", "torchvision")  # by libraries of the extras
CALIBRATE = ["calibrate", str(SAMPLE), "--rig", f"{SAMPLE}/rig.yaml", "--object", f"{SAMPLE}/object.csv", "--out"]


def run_without(libraries: tuple[str, ...], *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command line where some libraries cannot be imported."""
    absent = "import sys; sys.modules |= dict.fromkeys(sys.argv.pop(1).split()); "
    code = absent + "from imgcal.cli.main import run; run()"
    command = [sys.executable, "-c", code, " ".join(libraries), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=os.environ, check=False)


def without_extras(*arguments: str) -> subprocess.CompletedProcess[str]:
    return run_without((*EXTRAS["train"], *EXTRAS["report"], *BROUGHT_ALONG), *arguments)


def said(done: subprocess.CompletedProcess[str]) -> list[str]:
    """Lines on standard error, without the notice of a first run that compiles, or waits for one that does."""
    return [line for line in done.stderr.splitlines() if "for this machine" not in line]


def test_extras_are_those_of_the_package() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, libraries in EXTRAS.items():
        packages = [re.match(r"[a-z0-9-]+", line)[0] for line in extras[extra]]
        assert tuple(IMPORTED_AS.get(package, package) for package in packages) == libraries
        assert not missing(*libraries)
    assert advice("numpy") is None and advice(None) is None


def test_the_core_calibrates_all_but_the_report(tmp_path: Path) -> None:
    done = without_extras(*CALIBRATE, str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    assert said(done) == ['note: no report.html, which needs jinja2: pip install ".[report]" in the clone']
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "rig.yaml",
        "rig.posterior.safetensors",
        "result.json",
    }
    assert json.loads((tmp_path / "out" / "result.json").read_text())["status"] == "ok"
    assert "report.html" not in done.stdout


@pytest.mark.parametrize(
    ("arguments", "needs"),
    [
        (["train", "table1-row01", "--out", "{out}"], 'train needs tensorboard: pip install ".[train]" in the clone'),
        (
            ["evaluate", "--rig", "O10", "--object", "cube8", "--out", "{out}"],
            '--out needs matplotlib: pip install ".[report]" in the clone',
        ),
    ],
)
def test_what_needs_an_extra_says_so(arguments: list[str], needs: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = without_extras(*(argument.format(out=out) for argument in arguments))
    assert said(done) == [f"imgcal: {needs}"]
    assert done.returncode == 2
    assert not out.exists()


@pytest.mark.parametrize("guess", ["points", "cnn"])
def test_networks_that_ship_need_no_extra_to_start_from(guess: str, tmp_path: Path) -> None:
    done = without_extras(*CALIBRATE, str(tmp_path / "out"), "--first-guess", guess, "--no-report")
    assert done.returncode == 0, done.stderr
    assert not said(done)
    assert "network alone" in done.stdout

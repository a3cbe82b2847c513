"""Imports: commands do not wait for libraries that they do not use."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

import pytest

import imgcal
from imgcal.cli.main import COMMANDS

HEAVY = {"torch", "numba", "cv2", "scipy", "kornia", "timm", "tensorboard", "accelerate", "matplotlib"}
NO_ARGUMENTS = {"evaluate", "warmup"}  # work without any
OF_OTHER_COMMANDS = {"timm", "tensorboard", "accelerate", "matplotlib"}


def imported_by(code: str) -> set[str]:
    """Top-level modules there after a piece of code, in a process of its own; SystemExit is passed over."""
    script = f"import sys\ntry:\n    {code}\nexcept SystemExit:\n    pass\nprint('|', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in done.stdout.rpartition("|")[2].split()}


def test_import_waits_for_nothing() -> None:
    assert not imported_by("import imgcal") & (HEAVY | {"numpy", "pydantic"})


@pytest.mark.parametrize("given", [["--help"], [], ["calibarte"], ["--tyro-print-completion", "bash"]])
def test_what_concerns_all_commands_waits_for_nothing_heavy(given: list[str]) -> None:
    assert not imported_by(f"from imgcal.cli.main import main; main({given})") & HEAVY


@pytest.mark.parametrize("given", [["--help"], ["--no-such-option"], []])
def test_help_and_slips_of_a_command_wait_for_nothing_heavy(given: list[str]) -> None:
    commands = [name for name in COMMANDS if given or name not in NO_ARGUMENTS]
    scripts = [f"from imgcal.cli.main import main; main({[command, *given]})" for command in commands]
    with ThreadPoolExecutor(2) as pool:
        found = dict(zip(commands, pool.map(imported_by, scripts), strict=True))
    assert not {command: names & HEAVY for command, names in found.items() if names & HEAVY}


def test_a_command_waits_for_no_network_or_plot(tmp_path: Path) -> None:
    given = ["rig", "look-at", "--cameras", "3", "--out", str(tmp_path / "rig.yaml")]
    found = imported_by(f"from imgcal.cli.main import main; main({given})")
    assert (tmp_path / "rig.yaml").is_file() and "torch" in found and not found & OF_OTHER_COMMANDS


ROOMS = [found.name for found in iter_modules(imgcal.__path__) if found.ispkg and found.name != "cli"]


@pytest.mark.parametrize("room", ["imgcal", *(f"imgcal.{name}" for name in ROOMS)])
def test_every_public_name_is_there(room: str) -> None:
    package = import_module(room)
    for name in package.__all__:
        assert getattr(package, name) is not None
    assert set(package.__all__) <= set(dir(package))


def test_what_the_tool_promises() -> None:
    for name in imgcal.__all__:
        assert not isinstance(getattr(imgcal, name), ModuleType), name
    with pytest.raises(AttributeError, match="nothing"):
        _ = imgcal.nothing

"""Imports: commands do not wait for libraries that they do not use."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

import pytest

import imgcal
from imgcal.cli.main import COMMANDS

HEAVY = {"torch", "numba", "cv2", "scipy", "kornia", "timm", "tensorboard", "accelerate", "matplotlib"}
NO_ARGUMENTS = {"evaluate", "warmup"}  # work without any
IMPORTED = """
import os, sys
exec(sys.argv[1])
for code in sys.argv[2:]:
    child = os.fork()
    if not child:
        try:
            exec(code)
        except SystemExit:
            pass
        print()
        print("|", *sys.modules, flush=True)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, code
"""
OF_OTHER_COMMANDS = {"timm", "tensorboard", "accelerate", "matplotlib", "kornia"}


def imported_by(*codes: str, first: str = "pass") -> list[set[str]]:
    """Top-level modules there after each piece of code, in a process of its own; SystemExit is passed over.

    The processes are forked from one that has run the code that all begin with.
    """
    done = subprocess.run([sys.executable, "-c", IMPORTED, first, *codes], capture_output=True, text=True, check=True)
    lines = [line.removeprefix("|") for line in done.stdout.splitlines() if line.startswith("|")]
    assert len(lines) == len(codes), done.stderr
    return [{name.partition(".")[0] for name in line.split()} for line in lines]


def test_import_waits_for_nothing() -> None:
    (found,) = imported_by("import imgcal")
    assert not found & (HEAVY | {"numpy", "pydantic"})


MAIN = "from imgcal.cli.main import main"


@pytest.mark.parametrize("given", [["--help"], [], ["calibarte"], ["--tyro-print-completion", "bash"]])
def test_what_concerns_all_commands_waits_for_nothing_heavy(given: list[str]) -> None:
    (found,) = imported_by(f"{MAIN}; main({given})")
    assert not found & HEAVY


@pytest.mark.parametrize("given", [["--help"], ["--no-such-option"], []])
def test_help_and_slips_of_a_command_wait_for_nothing_heavy(given: list[str]) -> None:
    commands = [name for name in COMMANDS if given or name not in NO_ARGUMENTS]
    found = imported_by(*(f"main({[command, *given]})" for command in commands), first=MAIN)
    assert not {command: names & HEAVY for command, names in zip(commands, found, strict=True) if names & HEAVY}


def test_a_command_waits_for_no_network_or_plot(tmp_path: Path) -> None:
    given = ["rig", "look-at", "--cameras", "3", "--out", str(tmp_path / "rig.yaml")]
    (found,) = imported_by(f"{MAIN}; main({given})")
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

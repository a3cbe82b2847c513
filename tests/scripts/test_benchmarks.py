"""The suite of benchmarks: its command, its page, and how it takes times."""

import sys
import time
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from imgcal.errors import InputError
from scripts.benchmarks import __main__ as suite
from scripts.timing import side_by_side


@pytest.mark.benchmark
def test_a_benchmark_writes_its_result_its_plot_and_the_page(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "benchmarks"
    assert suite.main(["networks", "--smoke", "--out", str(folder)]) == 0
    assert {path.name for path in folder.iterdir()} == {"networks.json", "networks.png", "tables.md"}
    page = (folder / "tables.md").read_text()
    assert "| networks | " in page and "**points-O10-cube8**" in page
    assert "networks latency" in capsys.readouterr().out


FOLDER = Path(suite.__file__).parent
NEEDS = {"splats_warp": "warp", "mrcal_worker": "mrcal"}  # others import their peer when it is used
MODULES = [".".join(path.relative_to(FOLDER).with_suffix("").parts) for path in sorted(FOLDER.rglob("[a-z]*.py"))]
WITH_COMMAND = [name for name in MODULES if "\n    command(" in (FOLDER / f"{name.replace('.', '/')}.py").read_text()]


@pytest.mark.parametrize("name", MODULES)
def test_every_module_can_be_imported(name):
    needed = NEEDS.get(name.rpartition(".")[2])
    if needed and not find_spec(needed):
        pytest.skip(f"{needed} is not installed")
    import_module(f"scripts.benchmarks.{name}")


@pytest.mark.parametrize("name", ["__main__", *WITH_COMMAND])
def test_every_command_tells_how_it_is_used(name, capsys, monkeypatch):
    module = import_module(f"scripts.benchmarks.{name}")
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as stop:
        module.main(["--help"]) if name == "__main__" else module.main()
    assert not stop.value.code
    shown = " ".join(capsys.readouterr().out.split())
    assert "usage:" in shown and len(shown) > 200
    if name == "__main__":
        assert all(option in shown for option in ("--smoke", "--out"))


def test_every_benchmark_is_a_module_with_the_three_functions():
    for name in suite.BENCHMARKS:
        module = suite._module(name)
        assert callable(module.measure) and callable(module.tables) and callable(module.draw), name


def test_a_full_run_takes_less_than_thirty_minutes():
    assert sum(suite.BENCHMARKS.values()) < 30


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="blob: not a benchmark, expected one of recalibration"):
        suite.main(["blob"])


def test_cases_are_timed_in_turn_and_prepared_each_time():
    calls = []
    cases = {"fast": lambda: calls.append("fast"), "slow": lambda: (calls.append("slow"), time.sleep(0.02))}
    timings = side_by_side(cases, 0.3, prepare=lambda: calls.append("prepare"))
    assert list(timings) == ["fast", "slow"]
    assert calls[::2] == ["prepare"] * (len(calls) // 2)
    assert timings["slow"].calls >= 3 and timings["fast"].calls > timings["slow"].calls
    assert 20 <= timings["slow"].best <= timings["slow"].p50 <= timings["slow"].p99
    first_slow, last_fast = calls.index("slow", 5), len(calls) - calls[::-1].index("fast")
    assert first_slow < last_fast  # taken in turn, not one after the other


def test_a_case_that_takes_too_long_runs_once_after_its_warm_up():
    calls = []
    side_by_side({"slow": lambda: (calls.append(1), time.sleep(0.1)), "fast": lambda: None}, 0.05)
    assert len(calls) == 2

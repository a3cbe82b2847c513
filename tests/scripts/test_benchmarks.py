"""The suite of benchmarks: its command, its page, and how it takes times."""

import time

import pytest

from imgcal.errors import InputError
from scripts.benchmarks import __main__ as suite
from scripts.timing import side_by_side


def test_a_benchmark_writes_its_result_its_plot_and_the_page(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "benchmarks"
    assert suite.main(["networks", "--smoke", "--out", str(folder)]) == 0
    assert {path.name for path in folder.iterdir()} == {"networks.json", "networks.png"}
    page = (tmp_path / "benchmarks.md").read_text()
    assert "| networks | " in page and "**points-O10-cube8**" in page
    assert "networks latency" in capsys.readouterr().out


def test_every_benchmark_is_a_module_with_the_three_functions():
    for name in suite.BENCHMARKS:
        module = suite._module(name)
        assert callable(module.measure) and callable(module.tables) and callable(module.draw), name


def test_a_full_run_takes_less_than_thirty_minutes():
    assert sum(suite.BENCHMARKS.values()) < 30


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="blob: found no such benchmark, expected one of recalibration"):
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

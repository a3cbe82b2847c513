import math
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from renderers.compiling import njit
from renderers.interpreting import MOST_ELEMENTS, interpret_first, without_machine_code


def make(heavy: bool = False):
    """A function of its own for each test, so that no test finds the machine code of another."""

    @njit(cache=False, heavy=heavy)
    def total(values):
        found = 0.0
        for value in values:
            found += value / 3
        return found

    return total


def test_outside_everything_is_compiled_at_once():
    total = make()
    assert total(np.ones(6)) == pytest.approx(2)
    assert total.overloads and total.interpretable.spent == 0


def test_a_function_is_compiled_once_interpreting_it_has_taken_as_long():
    total, values = make(), np.ones(3000)
    with interpret_first():
        assert total(values) == pytest.approx(1000)
        assert not total.overloads
        spent = total.interpretable.spent
        assert 0 < spent < total.interpretable.seconds
        while not total.overloads:
            before = total.interpretable.spent
            assert total(values) == pytest.approx(1000)
        assert total.interpretable.seconds <= before == total.interpretable.spent


@pytest.mark.parametrize("values", [np.ones(MOST_ELEMENTS + 1), np.ones(MOST_ELEMENTS + 1, np.uint8)])
def test_large_arrays_are_not_interpreted_but_images_may_be(values):
    total = make()
    with interpret_first():
        total(values)
    assert bool(total.overloads) == (values.itemsize == 8)


def test_what_runs_for_each_pixel_is_interpreted_only_while_another_process_compiles_it():
    total = make(heavy=True)
    total.interpretable.is_being_compiled = lambda: True
    with interpret_first():
        assert total(np.ones(3)) == 1
        assert not total.overloads
        total.interpretable.is_being_compiled = lambda: False
        assert total(np.ones(3)) == 1
        assert total.overloads


def test_without_patience_all_is_compiled_and_with_endless_patience_nothing():
    compiled, interpreted = make(), make(heavy=True)
    with interpret_first(0):
        compiled(np.ones(3))
        with interpret_first(math.inf):
            interpreted(np.ones(3))
    assert compiled.overloads and not interpreted.overloads


def test_the_rest_of_the_arguments():
    @njit(cache=False)
    def count(first, *rest):
        return first + len(rest)

    with interpret_first():
        assert count(1, 2.0, (3, 4)) == 3
        assert not count.overloads
    assert count(1, 2.0, (3, 4)) == 3
    assert count.overloads


def test_only_the_own_time_counts():
    inner = make()

    @njit(cache=False)
    def outer(values):
        return inner(values) + 1

    with interpret_first(math.inf):
        assert outer(np.ones(15_000)) == pytest.approx(5001)
    assert 0 < outer.interpretable.spent < 0.5 * inner.interpretable.spent


def test_numpy_does_not_warn_as_machine_code_does_not():
    @njit(cache=False, error_model="numpy")
    def divide(values):
        return values[0] / values[1]

    with warnings.catch_warnings(), interpret_first():
        warnings.simplefilter("error")
        assert math.isinf(divide(np.array([1.0, 0.0])))


def test_a_twin_stands_in_for_a_function_and_all_that_it_calls_as_long_as_compiling_them_takes():
    inner = make()

    @njit(cache=False)
    def outer(values):
        return inner(values) + 1

    def twin(values: np.ndarray) -> float:
        time.sleep(0.001)
        return values.sum() / 3 + 1

    assert without_machine_code(outer) is None
    costs = inner.interpretable.seconds + outer.interpretable.seconds
    with interpret_first():
        missing = without_machine_code(outer)
        assert missing is outer.interpretable
        assert missing.call_twin(twin, np.ones(6)) == 3
        assert 0 < missing.spent < outer.interpretable.seconds
        missing.spent = costs - 1e-9
        assert without_machine_code(outer) is missing
        missing.spent = costs
        assert without_machine_code(outer) is None
        missing.spent = 0.0
        outer.interpretable._compile(np.ones(6))
        assert without_machine_code(outer) is None


LAB = """
from renderers.compiling import njit

@njit()
def double(x):
    return 2 * x
"""
SCRIPT = """
import math, subprocess, sys, time
from lab import double
from renderers.interpreting import LOOK_EVERY, interpret_first, without_machine_code

with interpret_first(math.inf):
    for value in (1.0, 2):
        assert double(value) == 2 * value and not double.overloads
    assert without_machine_code(double) is double.interpretable
    subprocess.run([sys.executable, "-c", "from lab import double; double(1.0)"], check=True)
    time.sleep(2 * LOOK_EVERY)
    assert double(1.0) == 2.0
    assert sum(double.stats.cache_hits.values()) == len(double.overloads) == 1
    assert without_machine_code(double) is None
    assert double(2) == 4 and len(double.overloads) == 1  # other arguments: still interpreted
"""

BOTH = """
import math, subprocess, sys
from lab import double
from renderers import interpreting
from renderers.interpreting import interpret_first

subprocess.run([sys.executable, "-c", "from lab import double; double(1.0); double(2)"], check=True)
interpreting.LOOK_EVERY, double.interpretable.last_look = 3600.0, -math.inf
with interpret_first(math.inf):
    assert double(1.0) == 2.0 and double(2) == 4
    assert sum(double.stats.cache_hits.values()) == len(double.overloads) == 2
"""


@pytest.mark.parametrize("script", [SCRIPT, BOTH])
def test_what_another_process_has_compiled_is_loaded(tmp_path: Path, script: str):
    (tmp_path / "lab.py").write_text(LAB)
    environment = {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-800:]

"""Lens models: the benchmark runs, and each model has its number of parameters."""

import pytest

from scripts.benchmarks import lenses
from scripts.benchmarks.effort import Effort


@pytest.mark.benchmark
def test_every_model_is_estimated():
    result = lenses.measure(Effort(smoke=True))
    assert [row["parameters"] for row in result["rows"]] == [4 * 15 - 6, 4 * 18 - 6, 4 * 14 - 6, 15 + 18 + 14 + 15 - 6]
    assert all(row["converged"] == result["captures"] and 0.3 < row["joint"] < 3 for row in result["rows"])
    assert len(lenses.table(result).splitlines()) == 2 + len(result["rows"])

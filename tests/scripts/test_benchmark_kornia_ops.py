"""The comparison with kornia's operations runs, and equivalent operations agree."""

import pytest

from scripts.benchmarks import kornia_ops
from scripts.benchmarks.effort import Effort


@pytest.mark.benchmark
def test_rows_are_complete_and_agree():
    result = kornia_ops.measure(Effort(smoke=True))
    limits = {"px": 0.05, "rad": 1e-5, "1": 1e-5, "of peak": 0.1}
    assert all(row["largest_difference"] < limits[row["unit"]] for row in result["rows"])
    assert len(kornia_ops.table(result).splitlines()) == 2 + len(kornia_ops.pairs())

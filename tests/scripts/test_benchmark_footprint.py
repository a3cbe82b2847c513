"""The benchmark of start-up, memory and size."""

import json

import pytest

from scripts.benchmarks import footprint
from scripts.benchmarks.effort import Effort


@pytest.mark.benchmark
def test_smoke(tmp_path):
    result = json.loads(json.dumps(footprint.measure(Effort(smoke=True))))
    tables = footprint.tables(result)
    assert "| imgcal --help |" in tables["footprint start-up"] and "core install" in tables["footprint installed"]
    footprint.draw(result, tmp_path / "footprint.png")
    assert (tmp_path / "footprint.png").stat().st_size > 1000
    assert 5 < result["memory"]["python alone"]["memory_mb"] < 100


def test_a_core_install_is_what_is_needed_without_extras():
    packages = footprint.needed("imgcal")
    assert {"torch", "numba", "numpy", "llvmlite", "sympy"} <= set(packages)
    assert not {"pytest", "matplotlib", "imgcal"} & set(packages)
    sizes = footprint.installed()
    parts = sum(part["megabytes"] for part in sizes["packages"].values())
    assert sizes["core"]["megabytes"] == pytest.approx(parts + sizes["imgcal"]["megabytes"])
    assert sizes["packages"]["torch"]["megabytes"] > 100

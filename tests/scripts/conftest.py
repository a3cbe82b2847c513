"""Benchmarks' tests run whole benchmarks on next to nothing: minutes, which not every run of the suite should take."""

import pytest


def pytest_itemcollected(item: pytest.Item) -> None:
    if item.path.name.startswith("test_benchmark_"):
        item.add_marker(pytest.mark.benchmark)

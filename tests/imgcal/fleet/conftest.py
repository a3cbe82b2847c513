"""A small fleet on disk, and one Ray for all tests of a file."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from imgcal.fleet import Engine, write_manifest
from tests.imgcal.fleet.small_captures import write_capture


@pytest.fixture(scope="module")  # no longer: Ray's processes take 4 % of a core even if nothing is asked of them
def engine() -> Iterator[Engine]:
    with Engine(cores=2) as engine:
        yield engine


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    """Folder with manifest.csv: six captures of six devices."""
    rows = []
    for number in range(6):
        write_capture(tmp_path / f"{number}.csv", number)
        day = f"2026-01-{1 + number // 3:02d}T12:00:00"
        rows.append({"capture": f"{number}.csv", "device": f"d{number}", "time": day, "temperature": 20.0 + number})
    write_manifest(tmp_path / "manifest.csv", rows)
    return tmp_path

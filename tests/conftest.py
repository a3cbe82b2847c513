"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of real captured frames; tests that need it are skipped, visibly, without IMGCAL_CAPTURES."""
    folder = os.environ.get("IMGCAL_CAPTURES")
    if not folder:
        pytest.skip("IMGCAL_CAPTURES is not set: real frames are not at hand")
    return Path(folder)

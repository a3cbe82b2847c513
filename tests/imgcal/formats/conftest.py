"""Where the samples are."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def formats() -> Path:
    """Folder of real calibration files; tests that need it are skipped, visibly, without IMGCAL_FORMATS."""
    folder = os.environ.get("IMGCAL_FORMATS")
    if not folder:
        pytest.skip("IMGCAL_FORMATS is not set: real calibration files are not at hand")
    return Path(folder)

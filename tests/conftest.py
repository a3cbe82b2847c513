"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest

from imgcal.io import load_object, load_rig
from imgcal.types.calibration_object import CalibrationObject
from imgcal.types.rig import CameraRig


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of real captured frames; tests that need it are skipped, visibly, without IMGCAL_CAPTURES."""
    folder = os.environ.get("IMGCAL_CAPTURES")
    if not folder:
        pytest.skip("IMGCAL_CAPTURES is not set: real frames are not at hand")
    return Path(folder)


@pytest.fixture(scope="session")
def o10() -> CameraRig:
    """The reference rig of ten cameras, float64."""
    return load_rig("O10")


@pytest.fixture(scope="session")
def asymmetric8() -> CalibrationObject:
    """The default object, float64."""
    return load_object("asymmetric8")

"""Fixtures for all tests, and which tests run by default."""

import os
import shutil
from pathlib import Path

import pytest

from imgcal.io import load_object, load_rig
from imgcal.types.calibration_object import CalibrationObject
from imgcal.types.rig import CameraRig

LEFT_OUT = pytest.StashKey[int]()
CHROMIUM = shutil.which("chromium")
ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--benchmarks", action="store_true", help="run the smokes of the benchmarks (minutes), too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the benchmarks' smokes, unless they are asked for: by --benchmarks, by -m, or by their file's name."""
    named = any("test_benchmark" in argument for argument in config.args)
    if config.getoption("--benchmarks") or config.option.markexpr or named:
        return
    left = [item for item in items if item.get_closest_marker("benchmark")]
    if left:
        config.stash[LEFT_OUT] = len(left)
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in set(left)]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if left := config.stash.get(LEFT_OUT, 0):
        terminalreporter.write_line(
            f"{left} smokes of benchmarks were left out: run them with --benchmarks", yellow=True
        )


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of real captured frames; tests that need it are skipped, visibly, without IMGCAL_CAPTURES."""
    folder = os.environ.get("IMGCAL_CAPTURES")
    if not folder:
        pytest.skip("IMGCAL_CAPTURES is not set: real frames are not at hand")
    return Path(folder)


@pytest.fixture(scope="session")
def formats() -> Path:
    """Folder of real calibration files; tests that need it are skipped, visibly, without IMGCAL_FORMATS."""
    folder = os.environ.get("IMGCAL_FORMATS")
    if not folder:
        pytest.skip("IMGCAL_FORMATS is not set: real calibration files are not at hand")
    return Path(folder)


@pytest.fixture(scope="session")
def o10() -> CameraRig:
    """The reference rig of ten cameras, float64."""
    return load_rig("O10")


@pytest.fixture(scope="session")
def asymmetric8() -> CalibrationObject:
    """The default object, float64."""
    return load_object("asymmetric8")


@pytest.fixture(scope="module")  # no longer than that: while it lives, this thread has a running loop
def browser(tmp_path_factory):
    """Headless Chromium; tests that need it are skipped, visibly, where there is none."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed: pages are not tried in a browser")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("browser"), executable_path=CHROMIUM, args=ARGUMENTS
        )
        yield context
        context.close()

"""Fixtures for all tests, and which tests run by default."""

import gc
import os
import shutil
from functools import cache
from pathlib import Path

import pytest

from imgcal.io import load_object, read_rig
from imgcal.types import CalibrationObject, CameraRig

LEFT_OUT = pytest.StashKey[dict[str, int]]()
SLOW = {
    name: float(seconds)
    for name, seconds in (
        line.split() for line in (Path(__file__).parent / "slow_tests.txt").read_text().splitlines() if line[0] != "#"
    )
}
CHROMIUM = shutil.which("chromium")
ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--benchmarks", action="store_true", help="run the smokes of the benchmarks (minutes), too")
    parser.addoption("--slow", action="store_true", help="run the tests that take long, too; CI=true does the same")


def pytest_configure(config: pytest.Config) -> None:
    """Run slow tests in CI, and where paths are given; workers have the option from the process that started them.

    Workers share the cores: with a thread of its own for each core, every one of them takes three times as long.
    """
    if getattr(config.option, "numprocesses", None):
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if not hasattr(config, "workerinput") and (os.environ.get("CI") or not whole):
        os.environ["IMGCAL_SLOW_TESTS"] = "1"  # workers inherit the environment, and not what is set among the options


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out benchmarks' smokes and slow tests, unless they are asked for: by an option, by -m, or by name.

    Several workers begin with the files that take longest, so that none of them is left for the end.
    """
    for item in items:
        if item.nodeid.startswith(tuple(SLOW)):
            item.add_marker(pytest.mark.slow)
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: -seconds_of_file(item.nodeid.partition("::")[0]))
    if config.option.markexpr:
        return
    named = any("test_benchmark" in argument for argument in config.args)
    wanted = {
        "benchmark": config.getoption("--benchmarks") or named,
        "slow": config.getoption("--slow") or "IMGCAL_SLOW_TESTS" in os.environ,
    }
    counts = {}
    for marker in (marker for marker, run in wanted.items() if not run):
        left = [item for item in items if item.get_closest_marker(marker)]
        if left:
            counts[marker] = len(left)
            config.hook.pytest_deselected(items=left)
            items[:] = [item for item in items if item not in set(left)]
    config.stash[LEFT_OUT] = counts


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over what has been imported: it would look at all of it every few tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


@cache
def seconds_of_file(file: str) -> float:
    """What the slow tests of a file take together."""
    return sum(seconds for name, seconds in SLOW.items() if name.partition("::")[0] == file)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    left = config.stash.get(LEFT_OUT, {})
    options = {"benchmark": "smokes of benchmarks", "slow": "slow tests"}
    for marker, what in options.items():
        if marker in left:
            option = "--slow" if marker == "slow" else "--benchmarks"
            terminalreporter.write_line(f"{left[marker]} {what} were left out: run them with {option}", yellow=True)


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
    return read_rig("O10")


@pytest.fixture(scope="session")
def asymmetric8() -> CalibrationObject:
    """The default object, float64."""
    return load_object("asymmetric8")


@pytest.fixture
def few_timings(monkeypatch: pytest.MonkeyPatch) -> None:
    """`imgcal evaluate` and `imgcal compare` measure latencies on two rigs: tests do not ask how precise they are."""
    monkeypatch.setattr("imgcal.cli.evaluate.TIMED_RIGS", 2)
    monkeypatch.setattr("imgcal.cli.evaluate.TIMED_RIGS_SLOW", 2)


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

import contextlib
import gc
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numba
import pytest
from numba import config
from numba.core import event

import renderers.compiling
from imgcal import detection
from imgcal.cli import background_compiler, compiling
from imgcal.cli.compiling import HINT, WAIT, announce_compilation, help_to_compile
from imgcal.errors import InputError, RefusedError
from renderers import interpreting


def test_compiling_is_told_once_and_counted(capsys):
    with announce_compilation() as compiled:
        for plus in (1, 2):
            numba.njit(lambda x, plus=plus: x + plus)(1)
    assert len(compiled) == 2
    assert capsys.readouterr().err == f"imgcal: {HINT}\n"
    with announce_compilation():
        pass
    numba.njit(lambda x: x + 3)(1)
    assert capsys.readouterr().err == ""


def test_waiting_for_another_process_is_told_once(capsys):
    with announce_compilation() as compiled:
        for _ in range(2):
            with event.trigger_event(renderers.compiling.WAITING):
                pass
    assert compiled == []
    assert capsys.readouterr().err == f"imgcal: {WAIT}\n"


def test_waiting_for_the_own_helper_is_compiling(capsys, monkeypatch):
    monkeypatch.setattr(compiling, "_helpers", [object()])
    with announce_compilation() as compiled:
        with event.trigger_event(renderers.compiling.WAITING):
            pass
        numba.njit(lambda x: x + 4)(1)
    assert len(compiled) == 1
    assert capsys.readouterr().err == f"imgcal: {HINT}\n"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(renderers.compiling, "cache_folder", lambda: str(tmp_path))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(compiling, "_load", lambda: 0.5)
    return tmp_path


@pytest.fixture
def helpers(cache: Path, monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The helpers that are started; they wait to be told how the command has ended, and say that."""
    started = []

    def start() -> subprocess.Popen[bytes]:
        code = f"import sys, pathlib; pathlib.Path({str(cache / 'told')!r}).write_bytes(sys.stdin.buffer.read())"
        started.append(subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE))
        return started[-1]

    monkeypatch.setattr(compiling, "start_helper", start)
    monkeypatch.setattr(compiling, "_helpers", [])
    return started


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
@pytest.mark.parametrize("error", [None, InputError("no such file")])
def test_a_second_process_helps_and_goes_on_after_the_command(cache, helpers, monkeypatch, error):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    with contextlib.suppress(InputError), help_to_compile():
        assert helpers[0].poll() is None
        assert interpreting._patience == 1 and os.environ["OMP_NUM_THREADS"] == "1"  # meanwhile
        if error is not None:
            raise error
    assert interpreting._patience is None and "OMP_NUM_THREADS" not in os.environ
    assert helpers[0].wait(60) == 0 and len(helpers) == 1
    assert (cache / "told").read_bytes() == compiling.GO_ON


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
def test_the_second_process_learns_that_the_command_is_interrupted(cache, helpers):
    with pytest.raises(KeyboardInterrupt), help_to_compile():
        raise KeyboardInterrupt
    assert helpers[0].wait(60) == 0
    assert (cache / "told").read_bytes() == b""


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
def test_a_command_does_not_start_a_second_helper_beside_that_of_another(cache, helpers):
    code = f"from renderers.compiling import hold\nwith hold({compiling.HELPER!r}): print(flush=True); input()"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], env=environment, **pipes) as other:
        other.stdout.readline()
        with help_to_compile():
            assert interpreting._patience == 1
        assert not helpers and compiling.is_helped()
        other.communicate(b"\n")
    assert not compiling.is_helped()


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
@pytest.mark.parametrize("error", [None, RefusedError("no camera")])
def test_the_helper_leaves_a_mark_when_all_is_compiled_or_cannot_be(cache, monkeypatch, error):
    def calibrate() -> None:
        if error is not None:
            raise error

    monkeypatch.setattr(background_compiler, "_calibrate", calibrate)
    monkeypatch.setattr(detection, "warm_up_detection", lambda: None)
    monkeypatch.setattr(background_compiler, "_end_if_interrupted", lambda: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    assert compiling.is_useful()
    background_compiler.main()
    assert not compiling.is_lacking() and not compiling.is_useful()
    assert compiling.completion_mark().read_text() == ("" if error is None else "RefusedError: no camera\n")


CODE = """
import pathlib, time
from imgcal.cli import background_compiler
from imgcal import detection

def work():
    try:
        print("here", flush=True)
        for _ in range({steps}):
            time.sleep(0.05)
    finally:
        pathlib.Path({mark!r}).touch()

detection.warm_up_detection = lambda: None
background_compiler._calibrate = work
background_compiler.main()
"""


def start(steps: int, cache: Path) -> subprocess.Popen[bytes]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    code = CODE.format(steps=steps, mark=str(cache / "tidy"))
    as_a_job_in_the_background = ["sh", "-c", 'trap "" INT; exec "$0" -c "$1"', sys.executable, code]
    helper = subprocess.Popen(as_a_job_in_the_background, env=environment, **pipes)
    assert helper.stdout.readline() == b"here\n"
    return helper


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
def test_a_helper_that_is_done_before_the_command_ends_well(tmp_path):
    with start(0, tmp_path) as helper:
        assert (helper.wait(60), helper.stderr.read()) == (0, b"")


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
def test_a_helper_whose_command_is_interrupted_tidies_up_and_ends(tmp_path):
    with start(2400, tmp_path) as helper:
        began = time.monotonic()
        helper.communicate(b"")
    assert helper.returncode != 0 and (tmp_path / "tidy").exists() and time.monotonic() - began < 60
    assert not list(tmp_path.glob("complete-*"))


def test_the_mark_depends_on_sources_and_versions(cache, monkeypatch):
    before = compiling.completion_mark()
    assert before == compiling.completion_mark()
    monkeypatch.setattr(numba, "__version__", "0.1")
    assert compiling.completion_mark() != before


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
def test_the_helper_calibrates_the_sample_and_says_nothing():
    with compiling.start_helper() as helper:
        helper.communicate(compiling.GO_ON)
    assert helper.returncode == 0
    deadline = time.monotonic() + 300
    while compiling.is_helped() and time.monotonic() < deadline:  # by the helper of another test
        time.sleep(0.1)
    assert compiling.completion_mark().read_text() == ""


def test_no_help_where_it_is_of_no_use(cache, monkeypatch):
    assert compiling.is_useful() == (renderers.compiling.fcntl is not None)
    with monkeypatch.context() as one:
        one.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
        assert not compiling.is_useful()
    with monkeypatch.context() as busy:
        busy.setattr(compiling, "_load", lambda: 1.0)
        assert not compiling.is_useful()
    with monkeypatch.context() as elsewhere:  # a folder of this process alone
        elsewhere.setattr(renderers.compiling, "cache_folder", lambda: "/tmp/imgcal-compiled-x")
        assert not compiling.is_useful()
    compiling.completion_mark().touch()
    assert not compiling.is_useful()


def test_processes_that_run_now_count_and_not_those_of_a_minute_ago(tmp_path, monkeypatch):
    running = iter("123456789")
    monkeypatch.setattr(Path, "read_text", lambda self, encoding: f"9.00 5.00 2.00 {next(running)}/300 4711\n")
    assert compiling._load() == 5 - 1  # without this process

    def refuse(self: Path, encoding: str) -> str:
        raise FileNotFoundError(self)

    monkeypatch.setattr(Path, "read_text", refuse)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.7, 0.5, 0.5), raising=False)
    assert compiling._load() == 0.7


def test_without_help_functions_are_compiled_before_they_are_called(cache, monkeypatch):
    monkeypatch.setattr(compiling, "is_useful", lambda: False)
    with help_to_compile():
        assert interpreting._patience is None


def test_a_helper_that_goes_on_after_the_command_is_no_forgotten_process(monkeypatch):
    started = []

    def start():
        process = compiling.Helper([sys.executable, "-c", "import time; time.sleep(60)"], stdin=subprocess.PIPE)
        started.append(process.pid)
        return process

    monkeypatch.setattr(compiling, "start_helper", start)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with compiling._run_helper():
            pass
        gc.collect()
    os.kill(started[0], signal.SIGKILL)
    os.waitpid(started[0], 0)
    assert not warned

import os
import time
from pathlib import Path

import numba
import pytest
from numba import config
from numba.core import event

import renderers.compiling
from imgcal.cli import compiling
from imgcal.cli.compiling import HINT, NEEDED_LAST, WAIT, announce_compilation, help_to_compile
from imgcal.estimation import levenberg_marquardt_cpu
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
    monkeypatch.setattr(os, "getloadavg", lambda: (0.5, 0.5, 0.5), raising=False)
    return tmp_path


@pytest.mark.skipif(renderers.compiling.fcntl is None, reason="no help on Windows")
def test_a_second_process_helps_and_ends_with_the_command(cache, monkeypatch, capfd):
    said = "import pathlib, time, imgcal; print('a word'); "
    monkeypatch.setattr(compiling, "HELP", said + f"pathlib.Path({str(cache / 'here')!r}).touch(); time.sleep(60)")
    started = []
    start = compiling.start_helper
    monkeypatch.setattr(compiling, "start_helper", lambda: started.append(start()) or started[-1])
    with help_to_compile():
        deadline = time.monotonic() + 120
        while not (cache / "here").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert started[0].poll() is None
        assert interpreting._patience == 1  # meanwhile
    assert interpreting._patience is None
    assert (cache / "here").exists() and len(started) == 1
    assert started[0].returncode not in (None, 0)  # it was ended
    assert capfd.readouterr() == ("", "")


def test_no_help_where_it_is_of_no_use(cache, monkeypatch):
    assert compiling.is_useful() == (renderers.compiling.fcntl is not None)
    with monkeypatch.context() as one:
        one.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
        assert not compiling.is_useful()
    with monkeypatch.context() as busy:
        busy.setattr(os, "getloadavg", lambda: (1.5, 0.5, 0.5), raising=False)
        assert not compiling.is_useful()
    with monkeypatch.context() as elsewhere:  # a folder of this process alone
        elsewhere.setattr(renderers.compiling, "cache_folder", lambda: "/tmp/imgcal-compiled-x")
        assert not compiling.is_useful()
    (cache / "estimation_0").mkdir()
    (cache / "estimation_0" / "levenberg_marquardt_cpu._minimize_rig-1.py311.nbi").touch()
    assert not compiling.is_useful()


def test_without_help_functions_are_compiled_before_they_are_called(cache, monkeypatch):
    monkeypatch.setattr(compiling, "is_useful", lambda: False)
    with help_to_compile():
        assert interpreting._patience is None


def test_what_shows_that_no_help_is_needed_is_a_module_of_compiled_functions():
    assert levenberg_marquardt_cpu.__file__ and Path(levenberg_marquardt_cpu.__file__).match(NEEDED_LAST)

import gc
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numba
import pytest
from numba.core import event

from renderers import compiling

# A function is called in a process of its own, which prints how often something was compiled.
SCRIPT = """
import os, sys
if "read-only" in sys.argv:
    os.access = lambda path, mode: mode != os.W_OK
import numpy as np
from numba import config
from numba.core import event

class Count(event.Listener):
    times = 0
    def on_start(self, happening):
        Count.times += 1
    def on_end(self, happening):
        pass

event.register("numba:compile", Count())
from imgcal.geometry.kernels import fill_free_turns  # its file imports no PyTorch, which takes seconds
from renderers.compiling import cache_folder

fill_free_turns(np.ones((2, 3), np.dtype(sys.argv[1])), np.ones((3, 3), np.dtype(sys.argv[1])))
print(Count.times, repr(config.CACHE_DIR), cache_folder(), sep="|")
"""


def run(*arguments: str, **environment: str) -> tuple[int, str, Path]:
    given = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    command = [sys.executable, "-c", SCRIPT, *arguments]
    done = subprocess.run(command, env=given | environment, capture_output=True, text=True, check=True)
    times, config, folder = done.stdout.strip().split("|")
    return int(times), config, Path(folder)


def kept(folder: Path) -> set[str]:
    return {path.name.split(".")[0] for path in folder.rglob("*.nbc")}


def test_compiled_code_is_kept_by_version_in_the_users_cache_and_only_ours(tmp_path: Path) -> None:
    times, config, folder = run("float32", XDG_CACHE_HOME=str(tmp_path))
    assert times > 0 and config == "''"
    assert folder == tmp_path / "imgcal" / version("imgcal")
    assert kept(folder) == {"kernels"}
    assert run("float32", XDG_CACHE_HOME=str(tmp_path))[0] == 0


def test_a_folder_that_the_user_names_goes_before(tmp_path: Path) -> None:
    _, config, folder = run("float32", NUMBA_CACHE_DIR=str(tmp_path / "mine"), XDG_CACHE_HOME=str(tmp_path / "user"))
    assert folder == tmp_path / "mine" and config == repr(str(folder))
    assert kept(folder) and not (tmp_path / "user").exists()


def test_a_folder_that_cannot_be_written_is_read(tmp_path: Path) -> None:
    run("float32", NUMBA_CACHE_DIR=str(tmp_path))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    for kind, compiles in (("float32", False), ("float64", True)):
        times, _, folder = run(kind, "read-only", NUMBA_CACHE_DIR=str(tmp_path))
        assert (times > 0) == compiles
        assert folder != tmp_path and not folder.exists()
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}


def test_code_that_calls_what_has_changed_is_compiled_again(tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    lab.mkdir()
    head = "from renderers.compiling import njit\n\n@njit()\ndef {}(x):\n    return {}\n"
    sources = {
        "__init__.py": "",
        "constants.py": "WIDTH = 2.0\n",
        "low.py": head.format("inner", "3 * x"),
        "middle.py": "from lab import low\n" + head.format("between", "low.inner(x)"),
        "high.py": "from lab.constants import WIDTH\nfrom lab.middle import between\n"
        + head.format("outer", "WIDTH + between(x)")
        + "\nprint(outer(1.0), sum(outer.stats.cache_hits.values()))\n",
    }
    for name, text in sources.items():
        (lab / name).write_text(text)

    def call() -> str:
        environment = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
        environment |= {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
        command = [sys.executable, "-c", "import lab.high"]
        done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert call() == "5.0 0"
    assert call() == "5.0 1"
    (lab / "low.py").write_text(head.format("inner", "4 * x"))
    assert call() == "6.0 0"
    (lab / "constants.py").write_text("WIDTH = 1.0\n")
    assert call() == "5.0 0"
    assert call() == "5.0 1"


def test_where_nothing_can_be_written_functions_are_compiled_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def njit(*functions: object, **options: object) -> object:
        if options.get("cache"):
            raise RuntimeError("cannot cache function 'twice': no locator available for file 'a.py'")
        return original(*functions, **options)

    original = numba.njit
    monkeypatch.setattr(numba, "njit", njit)

    @compiling.njit()
    def twice(x: float) -> float:
        return 2 * x

    assert twice(1.5) == 3.0


def test_a_users_cache_that_cannot_be_made_leaves_the_choice_to_numba(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    assert compiling.cache_folder.__wrapped__() == ""


def test_the_garbage_collector_rests_while_ours_is_compiled_and_works_again_after() -> None:
    seen: list[bool] = []

    class Watch(event.Listener):
        def on_start(self, happening: event.Event) -> None:
            seen.append(gc.isenabled())

        def on_end(self, happening: event.Event) -> None:
            pass

    @compiling.njit(cache=False)
    def inner(x: float) -> float:
        return x + 1

    @compiling.njit(cache=False)
    def outer(x: float) -> float:
        return inner(x) + 2

    watch = Watch()
    event.register("numba:compile", watch)
    try:
        outer(1.0)
        assert seen[:2] == [False, False] and gc.isenabled()
        seen.clear()
        numba.njit(lambda x: x + 2)(1.0)  # not ours
        assert seen == [True]
        with pytest.raises(numba.core.errors.TypingError):
            inner("a")
        assert gc.isenabled()
    finally:
        event.unregister("numba:compile", watch)


def test_wart_numba_saves_two_signatures_at_once_under_one_name(tmp_path: Path) -> None:
    """Hence the lock: without it, one of them is later given the code of the other."""
    source = f"""
import threading, numba
import numba.core.caching as caching

together = threading.Barrier(2)
load = caching.IndexDataCacheFile._load_index

def twins():
    files = [caching.IndexDataCacheFile({str(tmp_path)!r}, "f-1.py", "stamp") for _ in range(2)]
    def meet(file):
        found = load(file)
        together.wait()
        return found
    caching.IndexDataCacheFile._load_index = meet
    threads = [threading.Thread(target=file.save, args=(key, key)) for file, key in zip(files, ("a", "b"))]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]

twins()
"""
    subprocess.run([sys.executable, "-c", source], check=True)
    assert len(list(tmp_path.glob("*.nbc"))) == 1


@pytest.mark.skipif(compiling.fcntl is None, reason="there are no such locks on Windows")
def test_one_process_compiles_a_function_and_the_others_load_it(tmp_path: Path) -> None:
    """The second starts while the first compiles, tells that it waits, and compiles nothing."""
    source = """
import sys, time
from numba.core import event
from renderers.compiling import WAITING, njit

class Tell(event.Listener):
    def __init__(self, word):
        self.word = word
    def on_start(self, happening):
        print(self.word, flush=True)
        if self.word == "compiles" and happening.data["dispatcher"].py_func.__name__ == "thrice":
            sys.stdin.readline()
    def on_end(self, happening):
        pass

event.register("numba:compile", Tell("compiles"))
event.register(WAITING, Tell("waits"))

@njit()
def thrice(x):
    return 3 * x

print(thrice(1.5), flush=True)
"""
    (tmp_path / "lab.py").write_text(source)
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": paths}

    def start() -> subprocess.Popen[str]:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        return subprocess.Popen([sys.executable, "-c", "import lab"], env=environment, text=True, **pipes)

    with start() as first:
        assert first.stdout and first.stdout.readline() == "compiles\n"
        with start() as second:
            assert second.stdout and second.stdout.readline() == "waits\n"
            assert first.communicate("\n")[0] == "4.5\n"
            assert second.communicate()[0] == "4.5\n"


def test_a_function_that_fails_to_compile_leaves_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "cache_folder", lambda: str(tmp_path))

    @compiling.njit()
    def increment(x: float) -> float:
        return x + 1

    with pytest.raises(numba.core.errors.TypingError):
        increment("a")
    assert increment(1.5) == 2.5


def test_without_compilation_everything_can_be_imported():
    """NUMBA_DISABLE_JIT=1, as coverage and debuggers set it; compiled functions that are called say so."""
    code = "import imgcal, imgcal.online, imgcal.watch, imgcal.cli.main; print(imgcal.load_rig('T4').num_cameras)"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "4", done.stderr[-500:]

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.io import PREVIOUS, keep_previous, publishing, write_text
from imgcal.io.atomic import DEAD_AFTER, PREFIX, is_unfinished

NAMES = ("report", "rig", "result")
OLD = {"report": "old", "rig": "old", "result": "old", "mine": "untouched"}
NEW = {"report": "new", "rig": "new", "result": "new", "mine": "untouched"}
REFUSED = {"report": "new", "result": "new", "mine": "untouched"}


def content(folder: Path) -> dict[str, str]:
    """What a reader sees: hidden entries are nobody's result."""
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file() and path.name[0] != "."}


def publish(folder: Path, wanted: dict[str, str], keeping: bool = False) -> None:
    with publishing(folder, NAMES, mark="result") as stage:
        if keeping:
            keep_previous(folder, stage, NAMES)
        for name in NAMES:
            if name in wanted:
                write_text(stage / name, wanted[name])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    out = tmp_path / "out"
    out.mkdir()
    for name, text in OLD.items():
        (out / name).write_text(text)
    return out


class Killed(BaseException):
    pass


@contextmanager
def failing(monkeypatch: pytest.MonkeyPatch, at: int, error: BaseException, for_good: bool) -> Iterator[list[int]]:
    """Let the `at`-th change of the file system fail, and all later ones as well if it is `for_good`."""
    done = [0]

    def spoiled(change: Callable[..., object]) -> Callable[..., object]:
        def wrapper(*args: object, **options: object) -> object:
            done[0] += 1
            if done[0] == at or (for_good and done[0] > at):
                raise error
            return change(*args, **options)

        return wrapper

    with monkeypatch.context() as patch:
        for module, name in (
            (os, "replace"),
            (os, "fsync"),
            (os, "mkdir"),
            (os, "unlink"),
            (os, "rmdir"),
            (os, "link"),
        ):
            patch.setattr(module, name, spoiled(getattr(module, name)))
        patch.setattr(shutil, "rmtree", spoiled(shutil.rmtree))
        yield done


def attempts(
    folder: Path, error: BaseException, for_good: bool, monkeypatch: pytest.MonkeyPatch, keeping: bool = False
) -> Iterator[dict]:
    """Publish, with every single step failing in turn; yields what is there afterwards."""
    spare = folder.with_name("spare")
    shutil.copytree(folder, spare)
    for wanted in (NEW, REFUSED):
        for at in count(1):
            shutil.rmtree(folder)
            shutil.copytree(spare, folder)
            expected = suppress(InputError, OSError, KeyboardInterrupt, Killed)
            with failing(monkeypatch, at, error, for_good) as done, expected:
                publish(folder, wanted, keeping)
            if done[0] < at:
                assert at > 10 and content(folder) == wanted
                break
            yield {"wanted": wanted, "found": content(folder), "left": is_unfinished(folder)}


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_step_that_fails_leaves_all_of_the_old_or_all_of_the_new(
    error: BaseException, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = list(attempts(folder, error, False, monkeypatch))
    assert all(state["found"] in (OLD, state["wanted"]) for state in found)
    assert sum(state["found"] == OLD for state in found) > 15


def test_a_kill_at_any_step_leaves_no_mark_beside_what_does_not_belong_to_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = list(attempts(folder, Killed(), True, monkeypatch))
    assert len(found) > 15
    unclaimed = 0
    for state in found:
        assert set(state["found"].values()) <= {"old", "new", "untouched"}
        if "result" in state["found"]:
            assert state["found"] in (OLD, state["wanted"])
        else:
            unclaimed += 1
            assert state["left"]
    assert unclaimed > 4


OLDER = {"rig": "older", "result": "older"}


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), Killed()])
def test_what_is_kept_is_there_whole_after_a_failure_of_any_step(
    error: BaseException, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = dict.fromkeys(NAMES, "old")
    (folder / PREVIOUS).mkdir()
    for name, text in OLDER.items():
        (folder / PREVIOUS / name).write_text(text)
    for state in attempts(folder, error, isinstance(error, Killed), monkeypatch, keeping=True):
        previous = content(folder / PREVIOUS) if (folder / PREVIOUS).exists() else None
        assert previous in (OLDER, kept, None)
        assert previous == kept or state["found"] == OLD
    assert content(folder / PREVIOUS) == kept and content(folder) == REFUSED


def test_files_are_kept_where_a_file_cannot_have_two_names(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsupported(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", unsupported)
    publish(folder, REFUSED, keeping=True)
    assert content(folder / PREVIOUS) == dict.fromkeys(NAMES, "old") and content(folder) == REFUSED


def test_an_exception_of_the_block_leaves_the_old(folder: Path) -> None:
    with pytest.raises(ZeroDivisionError), publishing(folder, NAMES, mark="result") as stage:
        write_text(stage / "rig", "new")
        raise ZeroDivisionError
    assert content(folder) == OLD
    assert not is_unfinished(folder)


def test_a_folder_that_was_not_there_is_not_there_after_a_failure(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ZeroDivisionError), publishing(out, NAMES, mark="result"):
        raise ZeroDivisionError
    assert not out.exists()
    publish(out, NEW)
    assert sorted(path.name for path in out.iterdir()) == sorted(NAMES)


def test_whole_folders_are_published_and_never_replaced(tmp_path: Path) -> None:
    for attempt in range(2):
        try:
            with publishing(tmp_path, ("settings", "frames"), mark="frames") as stage:
                (stage / "frames" / "a").mkdir(parents=True)
                (stage / "frames" / "a" / "0.png").write_text(str(attempt))
                assert not (tmp_path / "frames").exists() or attempt
        except InputError as error:
            assert attempt and f"{tmp_path / 'frames'}: found a folder or device" in str(error)
    assert (tmp_path / "frames" / "a" / "0.png").read_text() == "0"


def test_a_message_names_the_place_where_the_file_is_expected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError) as caught:
        publish(tmp_path, NEW)
    assert str(caught.value) == f"{tmp_path / 'report'}: cannot be written: No space left on device"


def test_a_file_in_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x")
    with pytest.raises(InputError, match=r"a: cannot be written"):
        publish(tmp_path / "a", NEW)


def test_what_a_killed_run_left_is_removed_when_it_is_surely_dead(tmp_path: Path) -> None:
    for name, age in (("dead", 2 * DEAD_AFTER), ("alive", 0.0)):
        left = tmp_path / f"{PREFIX}{name}"
        left.mkdir()
        (left / "rig").write_text("x")
        for path in (left / "rig", left):
            os.utime(path, (time.time() - age, time.time() - age))
    publish(tmp_path, NEW)
    assert [path.name for path in tmp_path.glob(".*")] == [f"{PREFIX}alive"]

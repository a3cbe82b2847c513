import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.watch import EventLog, event_log, forget_after
from tests.imgcal.watch.states import event


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def append(log, event):
    log.add(event)
    log.write()


def test_events_are_appended_over_restarts(tmp_path):
    path = tmp_path / "events.jsonl"
    for start in range(3):
        log = EventLog(path)
        append(log, event(start, message="line\nbreak \udcff"))
        log.close()
    assert [line["snapshot"] for line in lines(path)] == ["00000", "00001", "00002"]
    assert path.read_bytes().count(b"\n") == 3


def test_a_deleted_folder_is_made_again(tmp_path):
    """Later events went to a file that nobody could find."""
    (tmp_path / "out").mkdir()
    log = EventLog(tmp_path / "out" / "events.jsonl")
    append(log, event(1))
    shutil.rmtree(tmp_path / "out")
    append(log, event(2))
    append(log, event(3))
    assert log.unwritten == 0
    log.close()
    assert [line["snapshot"] for line in lines(tmp_path / "out" / "events.jsonl")] == ["00002", "00003"]


@pytest.mark.parametrize("left", [b'{"event": "mov', b"\x00" * 5000])
def test_what_a_power_failure_left_of_a_line_is_cut_off(left, tmp_path):
    path = tmp_path / "events.jsonl"
    log = EventLog(path)
    append(log, event(1))
    log.close()
    with open(path, "ab") as file:
        file.write(left)
    log = EventLog(path)
    append(log, event(2))
    log.close()
    assert [line["snapshot"] for line in lines(path)] == ["00001", "00002"]


def test_it_does_not_grow_for_ever(tmp_path):
    log = EventLog(tmp_path / "events.jsonl", most_bytes=1000)
    for number in range(50):
        append(log, event(number))
    log.close()
    kept = [*lines(tmp_path / "events.1.jsonl"), *lines(tmp_path / "events.jsonl")]
    assert [line["snapshot"] for line in kept] == [f"{n:05d}" for n in range(50 - len(kept), 50)] and len(kept) > 4
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2000


@pytest.mark.parametrize("fails", ["replace", "open"])
def test_where_the_long_file_cannot_be_put_aside_nothing_is_lost_nor_written_elsewhere(fails, tmp_path, monkeypatch):
    log = EventLog(tmp_path / "events.jsonl", most_bytes=1000)
    for number in range(3):
        append(log, event(number, message="x" * 100))

    def refuse(*_):
        raise OSError("no such luck")

    with monkeypatch.context() as broken, open(tmp_path / "others", "wb") as others:
        broken.setattr(*((os, "replace") if fails == "replace" else (event_log, "LineFile")), refuse)
        for number in (3, 4):
            with pytest.raises(OSError, match="no such luck"):
                append(log, event(number, message="x" * 100))
        assert os.fstat(others.fileno()).st_size == 0
    assert [line["snapshot"] for line in lines(tmp_path / "events.jsonl")] == [f"{n:05d}" for n in range(5)]
    append(log, event(5))
    log.close()
    log.close()
    with pytest.raises(OSError, match="closed"):
        append(log, event(6))
    assert [line["snapshot"] for line in lines(tmp_path / "events.jsonl")] == ["00005"]
    assert len(lines(tmp_path / "events.1.jsonl")) == 5


def test_a_full_disk_leaves_whole_lines_and_loses_no_event(tmp_path):
    path = tmp_path / "events.jsonl"
    log = EventLog(path)
    append(log, event(1))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, limits[1]))
    try:
        with pytest.raises(OSError, match=r"20 of|too large"):
            append(log, event(2))
        assert log.unwritten == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    append(log, event(3))
    log.close()
    assert [line["snapshot"] for line in lines(path)] == ["00001", "00002", "00003"]


def test_lines_are_whole_after_sigkill(tmp_path):
    path = tmp_path / "events.jsonl"
    code = (
        "import sys\nfrom pathlib import Path\nfrom imgcal.online.events import Event\n"
        "from imgcal.watch.event_log import EventLog\nlog = EventLog(Path(sys.argv[1]))\n"
        "for number in range(10**9): log.add(Event(1.7e9, number, 'moved', 'cam02', message='x' * 3000)); log.write()\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, path], env=os.environ | {"PYTHONPATH": str(Path.cwd())})
    ends = time.monotonic() + 120
    while time.monotonic() < ends and not (path.exists() and path.stat().st_size > 100_000):
        time.sleep(0.01)
    process.kill()
    process.wait()
    EventLog(path).close()  # cuts off what was being written
    found = lines(path)
    assert [line["snapshot"] for line in found] == [f"{n:05d}" for n in range(len(found))] and len(found) > 10


def test_a_folder_in_its_place(tmp_path):
    (tmp_path / "events.jsonl").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        EventLog(tmp_path / "events.jsonl")


def test_what_came_after_a_moment_is_cut_off(tmp_path):
    path = tmp_path / "events.jsonl"
    forget_after(path, 0)
    assert not path.exists()
    log = EventLog(path)
    append(log, event(1))
    size = log.size
    append(log, event(2))
    log.close()
    for asked in (10**6, size, size):
        forget_after(path, asked)
    assert [line["snapshot"] for line in lines(path)] == ["00001"] and path.stat().st_size == size
    (tmp_path / "empty").touch()
    forget_after(tmp_path / "empty", 5)  # a new one was begun
    assert not (tmp_path / "empty").stat().st_size

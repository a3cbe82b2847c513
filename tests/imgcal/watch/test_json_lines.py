import os
import sys
import tempfile
import threading

import pytest

from imgcal.watch import Exposure, JsonLines, Unreadable
from imgcal.watch.json_lines import AT_ONCE
from imgcal.watch.wire import LONGEST_LINE

LINE = b'{"camera": "a", "time": %d, "uv": [[1, 2]]}\n'


@pytest.fixture(params=["linux", "win32"], autouse=True)
def _system(request, monkeypatch):
    monkeypatch.setattr(sys, "platform", request.param)


def read(content):
    """What comes of bytes that are written into a pipe."""
    out, into = os.pipe()

    def write():
        with open(into, "wb") as file:
            file.write(content)

    writer = threading.Thread(target=write)
    writer.start()
    found = [item for item in JsonLines(out).items() if item is not None]
    writer.join()
    os.close(out)
    return found


def test_lines_come_as_they_are_written_and_none_while_nothing_does():
    out, into = os.pipe()
    items = JsonLines(out).items()
    assert next(items) is None
    os.write(into, LINE % 1 + LINE % 2 + (LINE % 3)[:10])
    assert [next(items).time for _ in range(2)] == [1, 2]
    assert next(items) is None
    os.write(into, (LINE % 3)[10:])
    assert next(items).time == 3
    os.close(into)
    assert list(items) == []
    os.close(out)


def test_a_line_that_cannot_be_read_does_not_end_the_stream():
    found = read(LINE % 1 + b"junk\n\n" + b"\x00\xff\n" + LINE % 2 + (LINE % 3).strip())
    assert [type(item) for item in found] == [Exposure, Unreadable, Unreadable, Exposure, Exposure]


def test_a_line_without_end_is_read_over():
    found = read(LINE % 1 + b"x" * (LONGEST_LINE + 3 * AT_ONCE) + b"\n" + LINE % 2)
    assert [type(item) for item in found] == [Exposure, Unreadable, Exposure]
    assert "expected at most 4,194,304" in found[1].reason


def test_a_pipe_goes_on_by_itself_and_a_file_waits():
    out, into = os.pipe()
    assert JsonLines(out).live
    os.close(into)
    os.close(out)
    with tempfile.TemporaryFile() as file:
        assert not JsonLines(file.fileno()).live

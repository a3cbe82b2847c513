"""Output of native libraries to file descriptor 2, which Python settings do not affect."""

import os
import threading
from pathlib import Path

import pytest

from imgcal.io.frames import silence_stderr


def test_native_words_go_nowhere_and_come_back_after(capfd) -> None:
    os.write(2, b"before ")
    with silence_stderr():
        os.write(2, b"within ")
        with silence_stderr():
            os.write(2, b"deeper ")
        os.write(2, b"still within ")
    os.write(2, b"after")
    assert capfd.readouterr().err == "before after"


def test_an_error_within_ends_the_silence(capfd) -> None:
    with pytest.raises(ValueError), silence_stderr():
        raise ValueError
    os.write(2, b"heard")
    assert capfd.readouterr().err == "heard"


def test_threads_that_overlap_end_it_together(capfd) -> None:
    begun, may_end = threading.Event(), threading.Event()

    def decode() -> None:
        with silence_stderr():
            begun.set()
            may_end.wait(10)

    other = threading.Thread(target=decode)
    other.start()
    begun.wait(10)
    with silence_stderr():
        pass
    os.write(2, b"the other thread still decodes ")
    may_end.set()
    other.join()
    os.write(2, b"done")
    assert capfd.readouterr().err == "done"


def test_no_file_descriptor_is_lost() -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(50):
        with silence_stderr():
            pass
    assert len(list(Path("/proc/self/fd").iterdir())) == before

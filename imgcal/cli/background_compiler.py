"""Compile what a first calibration needs, beside it and after it: `python -m imgcal.cli.background_compiler`."""

from __future__ import annotations

import _thread
import contextlib
import io
import os
import signal
import tempfile
import threading
import time

from imgcal.cli.compiling import GO_ON, HELPER, completion_mark
from renderers.compiling import hold

SAMPLE = "sample:O10"
GIVE_UP = 10.0
"""Seconds for tidying up after an interruption."""


def main() -> None:
    """Compile first what the calibration needs first, then the rest; nothing if another process does so already."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits that it is ignored
    threading.Thread(target=_end_if_interrupted, daemon=True).start()
    with hold(HELPER) as free:
        if not free:
            return
        try:
            from imgcal.detection import warm_up_detection

            warm_up_detection()
            _calibrate()
        except Exception as error:  # trying it again with each command would not help
            completion_mark().write_text(f"{type(error).__name__}: {error}\n", "utf-8")
        else:
            completion_mark().touch()


def _end_if_interrupted() -> None:
    """Read how the command has ended, without Python's buffer: a thread that waits in that would abort the process."""
    said = b""
    while part := os.read(0, len(GO_ON)):
        said += part
    if said != GO_ON:
        _thread.interrupt_main()
        time.sleep(GIVE_UP)
        os._exit(1)


def _calibrate() -> None:
    from imgcal.cli.main import parse

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        parse(["calibrate", SAMPLE, "--rig", SAMPLE, "--object", SAMPLE, "--out", f"{folder}/out"]).run()


if __name__ == "__main__":
    main()

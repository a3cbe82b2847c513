"""Compile what a first calibration needs, beside it and after it: `python -m imgcal.cli.compiler`."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
import threading
from pathlib import Path

from imgcal.cli.compiling import COMPLETE, GO_ON, HELPER
from renderers.compiling import cache_folder, hold

SAMPLE = "sample:O10"


def main() -> None:
    """Compile, what the calibration meets first before the rest; nothing if another process does so already."""
    threading.Thread(target=_end_if_interrupted, daemon=True).start()
    with hold(HELPER) as free:
        if free:
            from imgcal.detection.warmup import warm_up_detection

            warm_up_detection()
            _calibrate()
            Path(cache_folder(), COMPLETE).touch()


def _end_if_interrupted() -> None:
    if sys.stdin.buffer.read() != GO_ON:
        os._exit(1)


def _calibrate() -> None:
    from imgcal.cli.main import parse

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        parse(["calibrate", SAMPLE, "--rig", SAMPLE, "--object", SAMPLE, "--out", f"{folder}/out"]).run()


if __name__ == "__main__":
    main()

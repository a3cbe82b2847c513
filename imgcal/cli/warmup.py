"""`imgcal warmup`: compile ahead of time what the first calibration would wait for."""

from __future__ import annotations

import sys
import time

from imgcal.cli import arguments
from imgcal.cli.compiling import announce_compilation
from imgcal.messages import plural
from imgcal.online import warm_up
from renderers.compiling import cache_folder


class Warmup(arguments.Warmup):
    """Run `imgcal warmup`."""

    def run(self) -> None:
        """Compile, and say where it is kept."""
        started = time.perf_counter()
        with announce_compilation("compiling for this machine, which takes a few minutes") as compiled:
            warm_up(self.all_lenses)
        what = f"{plural(len(compiled), 'function')} compiled" if compiled else "everything was already compiled"
        where = cache_folder() or "where Python keeps the compiled files of imgcal"
        print(f"{what} in {time.perf_counter() - started:.1f} s, kept in {where}", file=sys.stderr)

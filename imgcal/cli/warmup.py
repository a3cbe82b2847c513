"""`imgcal warmup`: compile ahead of time what the first calibration would wait for."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

from imgcal.cli.compiling import tells_of_compiling
from imgcal.online import warm_up
from renderers.compiling import cache_folder


@dataclass(frozen=True)
class Warmup:
    """Compile ahead of time what the first calibration would wait for: when an image is built, before a service starts.

    What is compiled is kept in the folder that the environment variable NUMBA_CACHE_DIR names, or else in the user's
    cache folder, for this version and this kind of processor. Example for an image that others will run, from a file
    system that cannot be written: ENV NUMBA_CACHE_DIR=/opt/imgcal-cache, then RUN imgcal warmup
    """

    all_lenses: bool = False
    """compile also for rigs that have a camera with another lens than brown_conrady (rational, equidistant)"""

    def run(self) -> None:
        """Compile, and say where it is kept."""
        started = time.perf_counter()
        with tells_of_compiling("compiling, which takes a while") as compiled:
            warm_up(self.all_lenses)
        what = f"{len(compiled)} functions compiled" if compiled else "all was compiled already"
        where = cache_folder() or "where Python keeps the compiled files of imgcal"
        print(f"{what} in {time.perf_counter() - started:.1f} s, kept in {where}", file=sys.stderr)

"""TRC, the table of markers that OpenSim and others read: written row by row, readable after a kill.

Source: OpenSim documentation, Marker (.trc) Files, https://opensimconfluence.atlassian.net/wiki/spaces/OpenSim
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WIDTH = 10  # characters of the number of frames, which is written again and again


class TRCFile:
    """Points in millimetres; what was not seen is an empty cell."""

    def __init__(self, path: Path, labels: Sequence[str], rate: float) -> None:
        """Make the file.

        Args:
            path: must not exist.
            labels: of the points.
            rate: frames a second.

        Raises:
            OSError: it cannot be made.
        """
        self.frames, self._rate = 0, rate
        names = [label.replace("\t", " ") for label in labels]
        head = (
            f"PathFileType\t4\t(X/Y/Z)\t{path.name}\n"
            "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
        )
        first = f"{rate:.6f}\t{rate:.6f}\t"
        second = f"\t{len(names)}\tmm\t{rate:.6f}\t1\t"
        self._counts = (len((head + first).encode()), len((head + first + " " * WIDTH + second).encode()))
        axes = "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, len(names) + 1))
        text = f"{head}{first}{self._count}{second}{self._count}\nFrame#\tTime\t"
        text += "\t\t\t".join(names) + f"\t\t\n\t\t{axes}\n\n"
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        self._file = os.fdopen(os.open(path, flags, 0o644), "r+b")
        self._file.write(text.encode())
        self._file.flush()

    @property
    def _count(self) -> str:
        return f"{self.frames:>{WIDTH}}"

    def append(self, points: NDArray[np.float64], error: NDArray[np.float64], cameras: NDArray[np.int64]) -> None:
        """Add frames; the format has no place for errors and cameras.

        Args:
            points: (F, N, 3) mm; NaN = not seen.
            error: (F, N) mm.
            cameras: (F, N) bits.

        Raises:
            OSError: they cannot be written.
        """
        rows = []
        for number, frame in enumerate(points, start=self.frames):
            cells = ["" if np.isnan(value) else f"{value:.5f}" for value in frame.ravel()]
            rows.append("\t".join((str(number + 1), f"{number / self._rate:.6f}", *cells)) + "\n")
        self._file.seek(0, os.SEEK_END)
        self._file.write("".join(rows).encode())
        self._file.flush()  # the rows are there before they are counted
        self.frames += len(points)
        for place in self._counts:
            self._file.seek(place)
            self._file.write(self._count.encode())
        self._file.flush()

    def close(self) -> None:
        """Write no more."""
        self._file.close()

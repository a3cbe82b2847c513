"""TRC, the marker table of OpenSim and others: written row by row, readable after a kill.

Source: OpenSim documentation, Marker (.trc) Files, https://opensimconfluence.atlassian.net/wiki/spaces/OpenSim
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io import write_text
from imgcal.watch.line_file import create_whole, write_whole

HEADER_LINES = 6
WIDTH = 10  # characters of the number of frames, which is overwritten


class TRCFile:
    """Points in millimetres; a missing point is an empty cell."""

    def __init__(self, path: Path, labels: Sequence[str], rate: float) -> None:
        """Create the file.

        Args:
            path: must not exist.
            labels: names of the points.
            rate: frames per second.

        Raises:
            OSError: the file cannot be created.
        """
        self.frames, self._rate, self._path, self._points = 0, rate, path, len(labels)
        text = self._begin(labels)
        self._file = create_whole(path, text.encode())

    def _begin(self, labels: Sequence[str]) -> str:
        """Make the lines before the frames, and note the positions of the counts."""
        names = [label.replace("\t", " ") for label in labels]
        head = (
            f"PathFileType\t4\t(X/Y/Z)\t{self._path.name}\n"
            "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
        )
        first = f"{self._rate:.6f}\t{self._rate:.6f}\t"
        second = f"\t{len(names)}\tmm\t{self._rate:.6f}\t1\t"
        self._counts = (len((head + first).encode()), len((head + first + " " * WIDTH + second).encode()))
        axes = "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, len(names) + 1))
        text = f"{head}{first}{self._count}{second}{self._count}\nFrame#\tTime\t"
        return text + "\t\t\t".join(names) + f"\t\t\n\t\t{axes}\n\n"

    def widen(self, labels: Sequence[str]) -> None:
        """Add columns for more points, missing in all frames so far, atomically.

        Args:
            labels: names of the existing points, followed by the new ones.

        Raises:
            InputError: the file cannot be rewritten; it is unchanged.
        """
        self._file.seek(0)
        rows = self._file.read().decode().split("\n")[HEADER_LINES:-1]
        counts, empty = self._counts, "\t" * 3 * (len(labels) - self._points)
        self._file.close()
        try:
            write_text(self._path, self._begin(labels) + "".join(f"{row}{empty}\n" for row in rows))
            self._points = len(labels)
        except InputError:
            self._counts = counts
            raise
        finally:
            self._file = open(self._path, "r+b", buffering=0)  # noqa: SIM115  # open until close

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
            OSError: the frames cannot be written; the file holds the frames so far.
        """
        rows = []
        for number, frame in enumerate(points, start=self.frames):
            cells = ["" if np.isnan(value) else f"{value:.5f}" for value in frame.ravel()]
            rows.append("\t".join((str(number + 1), f"{number / self._rate:.6f}", *cells)) + "\n")
        self._file.seek(0, os.SEEK_END)
        self._write("".join(rows))
        self.frames += len(points)
        for place in self._counts:  # after the rows that they count
            self._file.seek(place)
            self._write(self._count)

    def _write(self, text: str) -> None:
        write_whole(self._file.fileno(), text.encode(), self._path)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

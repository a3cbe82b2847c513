"""`Board`: a printed pattern, whose corners or circles are the fiducials of a `CalibrationObject`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError

BoardKind = Literal["charuco", "aprilgrid", "checkerboard", "circles"]
WARP = 0.002
"""Standard deviation of the middle's deflection, as a share of the longer side, if a board's file gives none."""


@dataclass(frozen=True)
class Board:
    """A printed board: x to the right along its rows, y down, z into it; lengths in mm.

    Fiducials are numbered row by row from the top left: the inner corners of a chessboard, the circles, or the
    four corners of each tag (clockwise from its top left; tags in order of their numbers).

    Examples:
        >>> board = Board("charuco", columns=5, rows=7, pitch=30.0, marker=22.0, dictionary="DICT_4X4_50")
        >>> board.shape, board.points[0].tolist()
        ((4, 6), [30.0, 30.0, 0.0])
    """

    kind: BoardKind
    columns: int  # squares, tags or circles in a row
    rows: int
    pitch: float  # mm: side of a square; distance between tags or circles, or half of it if asymmetric
    marker: float = 0.0  # mm: side of a marker or tag, the black border included
    dictionary: str = ""  # of markers or tags, as OpenCV names it
    inverted: bool = False  # printed white on black
    first_id: int = 0  # of the first marker or tag
    border: int = 1  # bits of black around a marker
    from_bottom: bool = False  # tags are numbered from the bottom row upwards, as Kalibr does
    legacy: bool = False  # a ChArUco board as OpenCV printed it before 4.6
    asymmetric: bool = False  # every second row of circles is shifted by half of their distance
    bend: tuple[float, float] = (0.0, 0.0)  # mm, known deflection of the middle along x and y: positive = away, +z
    warp: float | None = None  # mm, standard deviation of the deflections; None = `WARP` of the longer side; 0 = exact

    def __post_init__(self) -> None:
        least = 3 if self.kind in ("charuco", "checkerboard") else 1 if self.kind == "aprilgrid" else 2
        if min(self.columns, self.rows) < least:
            raise InputError(
                f"board: found {self.columns} columns and {self.rows} rows, expected at least {least} of each"
            )
        if self.kind in ("charuco", "aprilgrid") and not 0 < self.marker < self.pitch:
            raise InputError(
                f"board: found markers of {self.marker:g} mm, expected more than 0 and less than {self.pitch:g} mm, "
                "the distance between neighbours"
            )

    @property
    def is_coded(self) -> bool:
        """Tell whether markers identify the corners, so that part of the board is enough."""
        return self.kind in ("charuco", "aprilgrid")

    @property
    def shape(self) -> tuple[int, int]:
        """Number of fiducials in a row, and of rows; for an AprilGrid, of tags."""
        if self.kind in ("charuco", "checkerboard"):
            return self.columns - 1, self.rows - 1
        return self.columns, self.rows

    def __str__(self) -> str:
        """Describe it: `ChArUco board of 5x7 squares (DICT_4X4_50)`."""
        grid = "asymmetric grid" if self.asymmetric else "grid"
        names = {"charuco": "ChArUco board", "aprilgrid": "AprilGrid", "circles": grid}
        parts = {"aprilgrid": "tags", "circles": "circles"}
        code = f" ({self.dictionary})" if self.is_coded else ""
        what = f"{self.columns}x{self.rows} {parts.get(self.kind, 'squares')}{code}"
        return f"{names.get(self.kind, self.kind)} of {what}"

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Fiducials of the flat board with its known bend: (N, 3) mm."""
        return self._flat + np.tensordot(np.array(self.bend), self.deflections, 1)

    @property
    def modes(self) -> NDArray[np.float64]:
        """Displacements (2, N, 3) mm of fiducials by one standard deviation of each deflection; (0, N, 3) if exact."""
        std = self.warp_std
        return std * self.deflections if std > 0 else self.deflections[:0]

    @property
    def warp_std(self) -> float:
        """Standard deviation of each deflection, mm."""
        return WARP * float(np.ptp(self._flat, axis=0).max()) if self.warp is None else self.warp

    @cached_property
    def _flat(self) -> NDArray[np.float64]:
        across, down = self.shape
        row, column = (index.ravel().astype(np.float64) for index in np.indices((down, across)))
        if self.kind == "aprilgrid":
            corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * self.marker
            row = down - 1 - row if self.from_bottom else row
            xy = (np.stack((column, row), -1)[:, None] * self.pitch + corner).reshape(-1, 2)
        elif self.kind == "circles":
            xy = self.pitch * np.stack((2 * column + row % 2 if self.asymmetric else column, row), -1)
        else:
            xy = self.pitch * np.stack((column + 1, row + 1), -1)
        return np.concatenate((xy, np.zeros((len(xy), 1))), axis=1)

    def deflection_at(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Deflection of positions (K, 2) mm on the board from its plane: (K,) mm along z."""
        low, extent = self._flat[:, :2].min(0), np.maximum(np.ptp(self._flat[:, :2], axis=0), 1e-300)
        share = (xy - low) / extent
        return 4 * (share * (1 - share)) @ np.array(self.bend)

    @property
    def deflections(self) -> NDArray[np.float64]:
        """Displacements (2, N, 3) of fiducials by a deflection of 1 mm along x and y.

        Source: mrcal, "board deformation": z = 4 wx s (1 - s) + 4 wy t (1 - t), s and t from 0 to 1 over the fiducials.
        """
        flat = self._flat
        share = (flat[:, :2] - flat[:, :2].min(0)) / np.maximum(np.ptp(flat[:, :2], axis=0), 1e-300)
        result = np.zeros((2, *flat.shape))
        result[..., 2] = (4 * share * (1 - share)).T
        return result

    @cached_property
    def turns(self) -> tuple[tuple[float, NDArray[np.int64]], ...]:
        """Rotations that an image cannot distinguish: angle about z (rad), and the fiducial that each one (N,) maps to.

        The first is the identity. Boards with markers have no other.
        """
        if self.is_coded:
            return ((0.0, np.arange(len(self.points))),)
        across, down = self.shape
        number = np.arange(across * down).reshape(down, across)
        found = [(0.0, number.ravel())]
        if self.kind == "circles" and self.asymmetric and down % 2 == 1:
            return tuple(found)
        colour = self.kind == "checkerboard"
        if not colour or (self.columns + self.rows) % 2 == 0:
            found.append((math.pi, number[::-1, ::-1].ravel()))
        if across == down and not self.asymmetric and (not colour or self.columns % 2 == 1):
            # A quarter turn maps the point at (row, column) to (column, last - row): x to y, y to -x.
            place = number[:, ::-1].T.ravel()
            back = np.empty_like(place)
            back[place] = np.arange(len(place))
            found += [(math.pi / 2, place), (-math.pi / 2, back)]
        return tuple(found)

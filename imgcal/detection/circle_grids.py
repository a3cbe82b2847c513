"""Grids of circles: blobs that lie on a square lattice, numbered by the layout of a board.

Lattices grow from cell to cell, so neither perspective nor a lens disturbs them. A grid is a lattice with exactly the
cells of the layout; the lattice is what says which circle is which, and that there are more circles than expected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from imgcal.types import Board

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Cell = tuple[int, int]

NEAREST = 9
"""Blobs around a first one, itself included, among which the sides of the first cell are searched."""
LEAST_SINE = 0.5
"""Of the angle between the sides of a cell: the shortest sides of a lattice are 60 to 90 degrees apart."""
OFF_CELL = 0.2
"""Largest distance from the place where a circle is expected, in units of the distance to its nearest neighbour."""
LIKE = 3.0
"""Largest ratio of the radii of neighbours: some prints mark the origin by a larger circle."""
LEAST_CELLS = 6
"""Cells of a lattice that is worth naming; four blobs often form a parallelogram by chance."""
SIDES: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))
STEPS: tuple[Cell, ...] = (*SIDES, *((i, j) for i, j in product(range(-2, 3), repeat=2) if abs(i * j) in (1, 2)))
FARTHEST_STEP = 2
"""Steps along lines of the lattice. Those that are no sides reach corners of grids whose shortest sides are oblique."""
BASES = np.array(
    [matrix for matrix in product(range(-2, 3), repeat=4) if matrix[0] * matrix[3] - matrix[1] * matrix[2] == 1]
).reshape(-1, 2, 2)
"""Changes of a lattice's basis. Seen obliquely, the shortest sides are not those of the print."""


@dataclass(frozen=True)
class Lattice:
    """Blobs on one lattice, each at a cell of its own; the sides of a cell turn clockwise, as x and y of the image."""

    cells: Ints  # (K, 2)
    rows: Ints  # (K,) of the blobs


def find_lattices(uv: Floats, radius: Floats) -> list[Lattice]:
    """Find the square lattices that blobs form, largest first; a blob belongs to one at most.

    Args:
        uv: (M, 2) pixels.
        radius: (M,) pixels.
    """
    if len(uv) < 4:
        return []
    tree, covered, found = cKDTree(uv), np.zeros(len(uv), dtype=np.bool_), []
    near = tree.query(uv, min(NEAREST, len(uv)))[1].astype(np.int64)
    for first in range(len(uv)):
        cells = {} if covered[first] else _grow(first, near[first, 1:], uv, radius, tree)
        if len(cells) >= 4:
            found.append(Lattice(np.array(list(cells)), np.array(list(cells.values()))))
            covered[found[-1].rows] = True
    found.sort(key=lambda lattice: -len(lattice.rows))
    covered[:] = False
    largest = []
    for lattice in found:
        if not covered[lattice.rows].any():
            largest.append(lattice)
            covered[lattice.rows] = True
    return largest


def number_circles(lattice: Lattice, board: Board, uv: Floats) -> Ints | None:
    """Find the blob (N,) of each circle of a board; None if the lattice is another grid.

    Fewer blobs beyond the layout than half of a row are clutter; with more of them, the grid is larger than the board.
    Where the layout looks the same after a turn, the rows run to the right in the image, as far as they can.

    Args:
        lattice: of the blobs.
        board: a grid of circles.
        uv: (M, 2) pixels of all blobs.
    """
    layout = _layout_cells(board)
    size, clutter = layout.max(0) + 1, len(lattice.rows) - len(layout)
    if not 0 <= clutter < min(board.columns, board.rows) / 2:
        return None
    numbered = []
    for basis in BASES:
        cells = lattice.cells @ basis.T
        cells -= cells.min(0)
        room = cells.max(0) + 1 - size
        if room.min() < 0 or room.max() > FARTHEST_STEP * clutter:
            continue
        blob = np.full(room + size, -1)
        blob[tuple(cells.T)] = lattice.rows
        for shift in np.ndindex(*(room + 1)):
            rows = blob[tuple((layout + shift).T)]
            if rows.min() >= 0:
                numbered.append(rows)
    last = board.columns - 1  # of the first row
    return max(numbered, key=lambda rows: _cosine(uv[rows[last]] - uv[rows[0]]), default=None)


def name_grid(lattice: Lattice, board: Board, uv: Floats) -> str:
    """Describe the grid that a lattice is: `grid of 4x11 circles`; empty if it is none.

    Args:
        lattice: of the blobs.
        board: the grid that was expected; its kind and its columns and rows are tried first.
        uv: (M, 2) pixels of all blobs.
    """
    count = len(lattice.rows)
    if count < LEAST_CELLS:
        return ""
    for asymmetric in (board.asymmetric, not board.asymmetric):
        sizes = [(columns, count // columns) for columns in range(2, count // 2 + 1) if count % columns == 0]
        for columns, rows in sorted(sizes, key=lambda size: abs(size[0] - board.columns) + abs(size[1] - board.rows)):
            other = Board("circles", columns, rows, 1.0, asymmetric=asymmetric)
            if number_circles(lattice, other, uv) is not None:
                return str(other)
    return ""


def _cosine(step: Floats) -> float:
    """Cosine of the angle between a step (2,) in the image and x."""
    return float(step[0] / np.hypot(*step))


def _layout_cells(board: Board) -> Ints:
    """Cells (N, 2) of a board's circles, from zero on. Asymmetric grids are square lattices turned by 45 degrees."""
    row, column = (index.ravel() for index in np.indices((board.rows, board.columns)))
    if not board.asymmetric:
        return np.stack((column, row), 1)
    across = 2 * column + row % 2
    cells = np.stack(((across + row) // 2, (row - across) // 2), 1)
    return np.asarray(cells - cells.min(0))


def _grow(first: int, near: Ints, uv: Floats, radius: Floats, tree: cKDTree) -> dict[Cell, int]:
    """Grow a lattice from a first blob and the blobs near it; returns the blob of each cell."""
    near = near[_alike(radius[first], radius[near])]
    if len(near) < 2:
        return {}
    steps = uv[near] - uv[first]
    length = np.linalg.norm(steps, axis=1)
    turned = steps[0, 0] * steps[:, 1] - steps[0, 1] * steps[:, 0]
    across = np.flatnonzero(abs(turned) > LEAST_SINE * length[0] * length)
    if not len(across):
        return {}
    second = across[0]
    sides = (0, second) if turned[second] > 0 else (second, 0)
    cells = {(0, 0): first, (1, 0): int(near[sides[0]]), (0, 1): int(near[sides[1]])}
    used, waiting, tried = set(cells.values()), dict.fromkeys(cells), set()
    while waiting:
        cell, _ = waiting.popitem()
        for step in STEPS:
            target, behind = (cell[0] + step[0], cell[1] + step[1]), (cell[0] - step[0], cell[1] - step[1])
            attempt = cell, step, behind in cells  # what is expected depends on the latter
            if target in cells or attempt in tried or (expected := _expect(cell, step, cells, uv)) is None:
                continue
            tried.add(attempt)
            around = [uv[cells[other]] for other in _around(cell) if other in cells and other != cell]
            gap = np.linalg.norm(np.array(around) - uv[cells[cell]], axis=1).min() if around else np.inf
            reach = OFF_CELL * min(gap, float(np.linalg.norm(expected - uv[cells[cell]])))
            distance, blob = tree.query(expected, distance_upper_bound=reach)
            if np.isfinite(distance) and blob not in used and _alike(radius[cells[cell]], radius[blob]):
                cells[target] = int(blob)
                used.add(int(blob))
                waiting |= dict.fromkeys(other for other in _around(target) if other in cells)
    return cells


def _around(cell: Cell) -> Iterator[Cell]:
    """The cells around one, and itself."""
    return product(range(cell[0] - 1, cell[0] + 2), range(cell[1] - 1, cell[1] + 2))


def _expect(cell: Cell, step: Cell, cells: dict[Cell, int], uv: Floats) -> Floats | None:
    """Expect the circle a step from a cell (2,): as far as that behind it, or as between two cells beside it."""
    here, behind = uv[cells[cell]], (cell[0] - step[0], cell[1] - step[1])
    if behind in cells:
        return np.asarray(2 * here - uv[cells[behind]])
    for across in ((step[1], step[0]), (-step[1], -step[0])) if step in SIDES else ():
        beside = (cell[0] + across[0], cell[1] + across[1])
        ahead = (beside[0] + step[0], beside[1] + step[1])
        if beside in cells and ahead in cells:
            return np.asarray(here + uv[cells[ahead]] - uv[cells[beside]])
    return None


def _alike(one: Floats, other: Floats) -> NDArray[np.bool_]:
    """Compare radii."""
    return np.asarray((one < LIKE * other) & (other < LIKE * one))

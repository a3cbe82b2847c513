"""Corners and circles of printed boards in one frame: OpenCV finds corners, `circle_grids` numbers circles.

Detections are kept only where they agree with the board's layout. Their accuracy is estimated from the image: corners
are compared with homographies of their neighbourhoods, which lens distortion or a bent print hardly affects over such a
short distance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from imgcal.detection.blob_search import find_blobs
from imgcal.detection.centroids import Blobs
from imgcal.detection.checks import Frame
from imgcal.detection.circle_grids import find_lattices, name_grid, number_circles
from imgcal.detection.options import DetectionOptions
from imgcal.errors import InputError
from imgcal.messages import list_names, with_article
from imgcal.types import BlobFlag, Board

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NEIGHBOURS = 9
"""Points of a neighbourhood, including the point itself, to which a homography is fitted."""
LEAST_POINTS = 4
UNKNOWN_SIGMA = 0.2  # px, where too few corners, or only those of a line, can be compared
LEAST_SIGMA, MOST_SIGMA = 0.02, 2.0  # px
MANY_SIGMAS = 3.0
"""Distance from its neighbours' homography, in sigmas, beyond which a corner is less certain than they are."""
LEAST_DETERMINED = 1e-6
"""Smallest singular value of a homography's equations, relative to the largest; less is rounding."""
OFF_LAYOUT = 0.3
"""Tolerance in units of the distance between neighbouring points: a corner farther off is another one."""
LEAST_ON_LAYOUT = 0.7
"""Smallest share of the markers that must agree with the layout."""
WINDOW = 0.8
"""Half the side of the window in which a corner is refined, in units of the gap between the corner and its markers."""
LEAST_WINDOW = 2  # px
REFINED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
"""When the refinement of a corner ends: steps, px."""
SIDE = 40.0
"""Longest part of a tag's side, px, from which its end is found: over more, lenses bend it."""
SIDE_SAMPLES, PROFILE_SAMPLES = 24, 17
"""Profiles across this part of a side, and grey values of each."""
END = 0.08
"""Share of this part, at both of its ends, where corners are too near."""
MOST_REACH = 3.0  # px, of a profile to both sides of an edge
REACH = 0.5
"""The same, in units of the black border's or the white gap's width."""
ROUNDS = 4
"""Rounds in which the corners of tags are refined."""
LARGEST_CIRCLE = 150.0  # px, radius
CONTRAST = 0.25
"""Contrast relative to that inside the board, from which the pattern continues beyond the grid's edge."""
ALTERNATING = 0.8
"""Correlation of grey values with the colours of squares, from which the pattern continues beyond the grid's edge."""
MOST_LOOKED = 8
"""Most frames that are examined to explain why a board was not found."""
LOOKED_TWICE = 4
"""Frames of a capture that are searched for a second checkerboard."""
REPEATED = 2
"""Markers seen twice in one frame, from which it shows two boards; a single one may be a false detection."""
OTHER_SIZES = 2
"""Columns and rows more or fewer that are tried for this explanation."""


@dataclass(frozen=True)
class _Seen:
    """The points of a board found in one frame."""

    uv: Floats  # (K, 2) pixels
    fiducial: Ints  # (K,)


def find_board(frame: Frame, board: Board) -> Blobs:
    """Find a board in one frame (H, W) of any depth. Returns labelled points; their camera is 0."""
    grey = _eight_bits(frame, board)
    seen = _FINDERS[board.kind](grey, board)
    if seen is None or len(seen.uv) < LEAST_POINTS:
        seen = _Seen(np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
    count = len(seen.uv)
    sigma = corner_sigma(board.points[seen.fiducial, :2], seen.uv)
    flags = np.full(count, int(BlobFlag.NONE), dtype=np.uint8)
    camera, radius = np.zeros(count, dtype=np.int64), np.full(count, np.nan)
    return Blobs(seen.uv, sigma, radius, flags, camera, np.ones(count), seen.fiducial, np.zeros(count))


def require_board(blobs: Sequence[Blobs], snapshots: Iterable[Mapping[str, Frame | None]], board: Board) -> None:
    """Explain why no frame shows the board, if none does, or that frames show two of them.

    Args:
        blobs: what was found in each snapshot.
        snapshots: the same snapshots, camera -> frame (H, W); only as many are taken as the explanation needs.
        board: the board.

    Raises:
        InputError: no frame shows it, or two checkerboards are visible at once: which is which, no image says.
    """
    if not any(len(shot.uv) for shot in blobs):
        why = explain_missing((frame for shot in snapshots for frame in shot.values() if frame is not None), board)
        raise InputError(f"frames: found no {board}" + (f": {why}" if why else ""))
    if board.kind != "checkerboard":
        return
    looked = 0
    for found, shot in zip(blobs, snapshots, strict=False):
        for camera, (name, frame) in enumerate(shot.items()):
            uv = found.uv[found.camera == camera]
            if frame is None or len(uv) < len(board.points):
                continue
            if _shows_second(_eight_bits(frame, board), uv, board):
                raise InputError(f"camera {name}: found two boards at once, each a {board}, expected one")
            looked += 1
        if looked >= LOOKED_TWICE:
            return


def _shows_second(grey: NDArray[np.uint8], uv: Floats, board: Board) -> bool:
    """Look for another checkerboard beside that with the inner corners (N, 2)."""
    low, high = board.points[:, :2].min(0) - board.pitch, board.points[:, :2].max(0) + board.pitch
    sheet = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    matrix, _ = cv2.findHomography(board.points[:, :2], uv)
    outline = cv2.perspectiveTransform(sheet[:, None], matrix)
    covered = cv2.fillConvexPoly(grey.copy(), np.rint(outline).astype(np.int32), float(np.percentile(grey, 99)))
    return bool(cv2.findChessboardCornersSB(covered, board.shape, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)[0])


def corner_sigma(xy: Floats, uv: Floats) -> Floats:
    """Standard deviation (K,) px, each axis, of corners, from the residuals of homographies of their neighbourhoods.

    It is the same for all, except for corners that are off by many times that from the homography of their neighbours.

    Args:
        xy: (K, 2) positions on the board.
        uv: (K, 2) pixels.
    """
    sigma = np.full(len(xy), UNKNOWN_SIGMA)
    count = min(NEIGHBOURS, len(xy))
    if count < 6:
        return sigma
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
    near = np.argsort(apart, axis=1, kind="stable")[:, :count]
    near = near[_determines_homography(xy[near])]
    if not len(near):
        return sigma
    left = _homography_residuals(xy[near], uv[near])
    freedom = 2 * count - 8
    variance = np.square(left).sum((1, 2)) / freedom
    # The median of chi-squared over its degrees of freedom is less than one.
    usual = (1 - 2 / (9 * freedom)) ** 3
    sigma[:] = np.clip(np.sqrt(np.median(variance) / usual), LEAST_SIGMA, MOST_SIGMA)
    # A fit takes its share of the residuals.
    own = np.linalg.norm(left[:, 0], axis=1) * np.sqrt(2 * count / freedom)
    sigma[near[:, 0]] = np.maximum(sigma[near[:, 0]], own / MANY_SIGMAS)
    return sigma


def _determines_homography(xy: Floats) -> NDArray[np.bool_]:
    """Tell which sets of points (K, M, 2) determine a homography: (K,). Those on one line but for one do not."""
    source, _ = _normalize(xy)
    size = np.linalg.svd(_homography_equations(source, source), compute_uv=False)
    return np.asarray(size[:, 7] > LEAST_DETERMINED * size[:, 0])


def _homography_residuals(xy: Floats, uv: Floats) -> Floats:
    """Residuals of homographies (least squares, direct linear): (K, M, 2) and (K, M, 2) -> (K, M, 2) pixels."""
    source, _ = _normalize(xy)
    target, scale = _normalize(uv)
    matrix = np.linalg.svd(_homography_equations(source, target))[2][:, -1].reshape(-1, 3, 3)
    mapped = np.concatenate((source, np.ones_like(source[..., :1])), -1) @ matrix.transpose(0, 2, 1)
    return (mapped[..., :2] / mapped[..., 2:] - target) * scale


def _normalize(points: Floats) -> tuple[Floats, Floats]:
    """Centre sets of points (K, M, 2), and divide each by its size (K, 1, 1), which is returned, too."""
    centred = points - points.mean(1, keepdims=True)
    size = np.sqrt(np.square(centred).mean((1, 2), keepdims=True)) + 1e-12
    return centred / size, size


def _homography_equations(source: Floats, target: Floats) -> Floats:
    """Linear equations (K, 2 M, 9) for homographies from points (K, M, 2) to others (K, M, 2)."""
    rows = np.concatenate((source, np.ones_like(source[..., :1])), -1)
    zero = np.zeros_like(rows)
    upper = np.concatenate((rows, zero, -target[..., :1] * rows), -1)
    lower = np.concatenate((zero, rows, -target[..., 1:] * rows), -1)
    return np.concatenate((upper, lower), 1)


def _eight_bits(frame: Frame, board: Board) -> NDArray[np.uint8]:
    """Stretch the grey values of a frame to eight bits, and invert the frame for an inverted board."""
    grey = np.ascontiguousarray(frame)
    if grey.dtype != np.uint8:
        values = grey.astype(np.float64)
        low, high = (float(value) for value in np.percentile(values, (0.5, 99.8)))
        grey = np.asarray(np.clip((values - low) / max(high - low, 1.0), 0, 1) * 255)
    plain = grey.astype(np.uint8)
    return 255 - plain if board.inverted else plain


# Markers


@lru_cache(maxsize=32)
def _dictionary(name: str) -> Any:
    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or number is None:
        raise InputError(f"board: dictionary: found {name!r}, expected one of OpenCV's: {list_names(dictionaries())}")
    return cv2.aruco.getPredefinedDictionary(number)


def dictionaries() -> list[str]:
    """Names of OpenCV's dictionaries."""
    by_number = {getattr(cv2.aruco, name): name for name in sorted(dir(cv2.aruco)) if name.startswith("DICT_")}
    return sorted(by_number.values())


def _parameters(board: Board) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = board.border
    return parameters


@lru_cache(maxsize=8)
def _make_charuco(board: Board) -> Any:
    """Describe a ChArUco board to OpenCV."""
    count = board.columns * board.rows // 2
    dictionary = _dictionary(board.dictionary)
    if board.first_id + count > len(dictionary.bytesList):
        raise InputError(
            f"board: found {count} markers from id {board.first_id} on, expected at most "
            f"{len(dictionary.bytesList)} of {board.dictionary}"
        )
    ids = np.arange(board.first_id, board.first_id + count, dtype=np.int32)
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.pitch, board.marker, dictionary, ids)
    made.setLegacyPattern(board.legacy)
    return made


def _charuco(grey: NDArray[np.uint8], board: Board) -> _Seen | None:
    made = _make_charuco(board)
    detector = cv2.aruco.CharucoDetector(made, cv2.aruco.CharucoParameters(), _parameters(board))
    corners, ids, marker_corners, marker_ids = detector.detectBoard(grey)
    if ids is None or marker_ids is None or _count_repeated(np.ravel(marker_ids)) >= REPEATED:
        return None
    layout = {int(k): np.asarray(p)[:, :2] for k, p in zip(made.getIds().ravel(), made.getObjPoints(), strict=True)}
    if not _matches_layout(marker_corners, marker_ids, layout, board.marker):
        return None
    markers = np.asarray(marker_corners, dtype=np.float64).reshape(-1, 4, 2)
    uv = _refine_saddles(grey, np.asarray(corners, dtype=np.float64).reshape(-1, 2), markers, board)
    return _Seen(uv, np.asarray(ids).ravel().astype(np.int64))


def _refine_saddles(grey: NDArray[np.uint8], uv: Floats, markers: Floats, board: Board) -> Floats:
    """Refine inner corners (K, 2) of a ChArUco board, in windows that the nearest marker of (M, 4, 2) does not reach.

    OpenCV's own windows contain corners of markers, and it stops within a tenth of a pixel.
    """
    nearest = np.linalg.norm(uv[:, None, None] - markers, axis=-1).min(2).argmin(1)
    side = np.linalg.norm(markers - np.roll(markers, 1, axis=1), axis=-1).min(1)[nearest]
    gap = side * (board.pitch - board.marker) / (2 * board.marker)
    refined = uv.astype(np.float32).reshape(-1, 1, 1, 2)
    for corner, half in zip(refined, np.maximum(LEAST_WINDOW, np.ceil(WINDOW * gap)).astype(int).tolist(), strict=True):
        cv2.cornerSubPix(grey, corner, (half, half), (-1, -1), REFINED)
    return refined.reshape(-1, 2).astype(np.float64)


def _matches_layout(corners: Any, ids: Any, layout: dict[int, Any], size: float) -> bool:
    """Check that markers lie on a plane as in a layout: id -> (4, 2) mm."""
    known = [k for k, marker in enumerate(np.ravel(ids)) if int(marker) in layout]
    if len(known) < LEAST_ON_LAYOUT * len(np.ravel(ids)):
        return False
    if len(known) < 2:
        return len(known) == 1
    uv = np.concatenate([np.asarray(corners[k], dtype=np.float64).reshape(4, 2) for k in known])
    xy = np.concatenate([np.asarray(layout[int(np.ravel(ids)[k])], dtype=np.float64) for k in known])
    matrix, _ = cv2.findHomography(uv, xy, cv2.RANSAC, OFF_LAYOUT * size)
    if matrix is None:
        return False
    mapped = cv2.perspectiveTransform(uv[:, None], matrix)[:, 0]
    on = np.linalg.norm(mapped - xy, axis=1) < OFF_LAYOUT * size
    return bool(on.mean() >= LEAST_ON_LAYOUT)


def _april_grid(grey: NDArray[np.uint8], board: Board) -> _Seen | None:
    corners, ids, repeated = _markers(grey, board)
    if len(ids) == 0 or repeated >= REPEATED:
        return None
    number = ids - board.first_id
    inside = (number >= 0) & (number < board.columns * board.rows)
    if inside.mean() < LEAST_ON_LAYOUT:
        return None
    corners, number = corners[inside], number[inside]
    points = board.points[:, :2].reshape(-1, 4, 2)[number]
    layout = {int(n): p for n, p in zip(number, points, strict=True)}
    # Printed tags may all be rotated in place: OpenCV's images and AprilTag's own differ by half a turn.
    for turn in range(4):
        turned = np.roll(corners, turn, axis=1)
        if len(number) > 1 and _matches_layout(turned, number, layout, board.marker):
            fiducial = (4 * number[:, None] + np.arange(4)).ravel()
            return _Seen(_intersect_sides(grey, turned, board).reshape(-1, 2), fiducial)
    return None


def _intersect_sides(grey: NDArray[np.uint8], corners: Floats, board: Board) -> Floats:
    """Refine corners (K, 4, 2) of tags, clockwise: where lines meet that are fitted to both sides next to a corner.

    Blur rounds corners that stand alone, and moves them inward; it leaves edges where they are. An edge is at the mean
    place of the grey value's slope along a profile across it.
    """
    bits = _dictionary(board.dictionary).markerSize + 2 * board.border
    margin = min(board.border / bits, board.pitch / board.marker - 1)  # of a side: black within it, white around it
    shortest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).min(1)
    reach = np.clip(REACH * margin * shortest, 1, MOST_REACH)[:, None, None, None]
    share = np.linspace(END, 1 - END, SIDE_SAMPLES)
    at_corner = np.linalg.pinv(np.vander(share, 2))[1]  # extrapolates a line to the corner
    across = reach[..., None] * np.linspace(-1, 1, PROFILE_SAMPLES)
    for _ in range(ROUNDS):
        side = np.stack((np.roll(corners, -1, axis=1), np.roll(corners, 1, axis=1)), 2) - corners[:, :, None]
        length = np.linalg.norm(side, axis=-1, keepdims=True)  # (K, 4, 2, 1): to the next corner, to the previous one
        along = side / length
        outward = np.stack((along[..., 1], -along[..., 0]), -1) * np.array([[1.0], [-1.0]])
        edge = corners[:, :, None, None] + share[:, None] * (np.minimum(length, SIDE) * along)[..., None, :]
        place = edge[..., None, :] + across[..., None] * outward[..., None, None, :]
        value = map_coordinates(grey, [place[..., 1], place[..., 0]], np.float64, order=1, mode="nearest")
        step, ends = value[..., -1] - value[..., 0], value[..., -1] + value[..., 0]
        mean = (value.sum(-1) - ends / 2) / (PROFILE_SAMPLES - 1)
        offset = reach * np.clip((ends - 2 * mean) / np.maximum(step, 1), -1, 1)
        corners = corners + np.linalg.solve(outward, (offset @ at_corner)[..., None])[..., 0]
    return corners


def _markers(grey: NDArray[np.uint8], board: Board) -> tuple[Floats, Ints, int]:
    """Detect all markers of the board's dictionary: corners (K, 4, 2), ids (K,), and how many are seen repeatedly."""
    corners, ids, _ = cv2.aruco.ArucoDetector(_dictionary(board.dictionary), _parameters(board)).detectMarkers(grey)
    if ids is None or not len(corners):
        return np.zeros((0, 4, 2)), np.zeros(0, dtype=np.int64), 0
    number = np.asarray(ids, dtype=np.int64).ravel()
    _, first = np.unique(number, return_index=True)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)[first], number[first], _count_repeated(number)


def _count_repeated(ids: NDArray[Any]) -> int:
    """Count the different ids of (K,) that occur more than once."""
    return int((np.unique(ids, return_counts=True)[1] > 1).sum())


# Grids


def _checkerboard(grey: NDArray[np.uint8], board: Board) -> _Seen | None:
    across, down = board.shape
    found, corners = cv2.findChessboardCornersSB(
        grey, (across, down), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    )
    if not found:
        return None
    grid = np.asarray(corners, dtype=np.float64).reshape(down, across, 2)
    grid = _flip_mirrored(grid)
    if _continues(grey, grid):
        return None
    # The first square, at the top left, is black; so is the first square enclosed by four inner corners.
    if _colour(grey, grid, 0, 0) > _colour(grey, grid, 0, 1):
        turned = grid[::-1, ::-1]
        if _colour(grey, turned, 0, 0) > _colour(grey, turned, 0, 1) and across == down:
            turned = _flip_mirrored(grid.transpose(1, 0, 2))
        grid = turned
    return _Seen(grid.reshape(-1, 2), np.arange(across * down))


def _circles(grey: NDArray[np.uint8], board: Board) -> _Seen | None:
    for blobs in _find_circles(grey):
        grids = _number_grids(blobs, board)
        if grids:
            break
    # Which of several is meant, no image says.
    if len(grids) != 1 or (blobs.flags[grids[0]] & BlobFlag.BORDER).any():
        return None
    return _Seen(blobs.uv[grids[0]], np.arange(len(grids[0])))


def _number_grids(blobs: Blobs, board: Board) -> list[Ints]:
    """Find grids that have the layout of a board: the blob (N,) of each circle."""
    lattices = find_lattices(blobs.uv, blobs.radius)
    return [rows for lattice in lattices if (rows := number_circles(lattice, board, blobs.uv)) is not None]


def _find_circles(grey: NDArray[np.uint8]) -> Iterator[Blobs]:
    """Find dark circles: those of usual sizes, then more of them, each time with those found before.

    Our own blobs are the more accurate ones, but where circles are dense, their neighbours hide the background.
    OpenCV's thresholds do not need it; they lose others.
    """
    blobs = find_blobs(grey, DetectionOptions(polarity="dark"), 255)
    yield blobs
    blobs = _join(blobs, _find_by_thresholds(grey))
    yield blobs
    yield _join(blobs, find_blobs(grey, DetectionOptions(polarity="dark", max_radius=LARGEST_CIRCLE), 255))


def _find_by_thresholds(grey: NDArray[np.uint8]) -> Blobs:
    """Find dark circles with OpenCV."""
    found = _blob_detector().detect(grey)
    uv = np.array([point.pt for point in found], dtype=np.float64).reshape(-1, 2)
    radius = np.array([point.size / 2 for point in found])
    room = np.minimum(uv, np.array(grey.shape[::-1]) - 1 - uv).min(1) - radius
    flags = np.where(room < 1, int(BlobFlag.BORDER), int(BlobFlag.NONE)).astype(np.uint8)
    count = len(uv)
    return Blobs(
        uv, np.full(count, UNKNOWN_SIGMA), radius, flags, np.zeros(count, np.int64), np.ones(count),
        np.full(count, -1, np.int64), np.zeros(count),
    )  # fmt: skip


def _join(blobs: Blobs, others: Blobs) -> Blobs:
    """Add those others that are not within a radius of blobs."""
    apart = np.linalg.norm(others.uv[:, None] - blobs.uv[None], axis=-1)
    new = others.select((apart > np.maximum(others.radius[:, None], blobs.radius)).all(1))
    return Blobs(*(np.concatenate((getattr(blobs, f.name), getattr(new, f.name))) for f in fields(Blobs)))


@lru_cache(maxsize=1)
def _blob_detector() -> Any:
    library: Any = cv2  # its type stubs lack this class
    parameters = library.SimpleBlobDetector_Params()
    parameters.minArea, parameters.maxArea = 12, 50_000
    parameters.minDistBetweenBlobs = 4
    return library.SimpleBlobDetector_create(parameters)


def _flip_mirrored(grid: Floats) -> Floats:
    """Reverse the rows of a grid (R, C, 2) that is numbered as in a mirror image."""
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return grid if right[0] * down[1] - right[1] * down[0] > 0 else grid[:, ::-1]


def _colour(grey: NDArray[np.uint8], grid: Floats, row: int, column: int) -> float:
    """Grey value at the centre of four inner corners."""
    return _grey_at(grey, grid[row : row + 2, column : column + 2].mean((0, 1))[None])[0]


def _grey_at(grey: NDArray[np.uint8], uv: Floats) -> Floats:
    """Grey values at pixels (K, 2), averaged over 3 x 3; nan outside."""
    smooth = cv2.blur(grey, (3, 3))
    column, row = np.rint(uv).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < grey.shape[1]) & (row < grey.shape[0])
    value = smooth[np.clip(row, 0, grey.shape[0] - 1), np.clip(column, 0, grey.shape[1] - 1)].astype(np.float64)
    return np.where(inside, value, np.nan)


def _continues(grey: NDArray[np.uint8], grid: Floats) -> bool:
    """Check whether the squares continue beyond a side of the grid: then the board is larger than expected."""
    for side in (grid, grid[::-1], grid.transpose(1, 0, 2), grid[:, ::-1].transpose(1, 0, 2)):
        rows, count = min(3, len(side)), side.shape[1] - 1
        if count < 2:
            continue
        corners = np.stack(np.meshgrid(np.arange(count + 1.0), np.arange(float(rows))), -1).reshape(-1, 2)
        matrix, _ = cv2.findHomography(corners, side[:rows].reshape(-1, 2))
        # The last squares of the board lie beyond the side; the next ones would be these.
        inner, beyond = (_grey_of_squares(grey, matrix, count, row) for row in (0.5, -1.5))
        if not np.isfinite(beyond).all():
            continue
        sign = np.resize((1.0, -1.0), count)
        sign -= sign.mean()
        # Objects behind the board may be light and dark in turn, but they are not as even as squares.
        contrast, usual = (abs(sign @ grey_values.mean(1)) / (count * sign.std()) for grey_values in (beyond, inner))
        if contrast > max(CONTRAST * usual, ALTERNATING * beyond.std()):
            return True
    return False


def _grey_of_squares(grey: NDArray[np.uint8], matrix: Any, count: int, row: float) -> Floats:
    """Grey values at nine points of each square of a row: (count, 9); nan outside.

    Args:
        grey: the frame.
        matrix: (3, 3) homography from columns and rows of corners to pixels.
        count: number of squares, the first between corners 0 and 1.
        row: of their centres.
    """
    around = np.stack(np.meshgrid((-0.25, 0.0, 0.25), (-0.25, 0.0, 0.25)), -1).reshape(-1, 2)
    centres = np.column_stack((np.arange(count) + 0.5, np.full(count, row)))
    points = (centres[:, None] + around).reshape(-1, 1, 2)
    return _grey_at(grey, cv2.perspectiveTransform(points, matrix)[:, 0]).reshape(count, -1)


_FINDERS: dict[str, Callable[[NDArray[np.uint8], Board], _Seen | None]] = {
    "charuco": _charuco,
    "aprilgrid": _april_grid,
    "checkerboard": _checkerboard,
    "circles": _circles,
}


# Explanations for a missing board


def explain_missing(frames: Iterable[Frame], board: Board) -> str:
    """Explain as well as possible why no frame shows a board: one line, to follow `found no ...`."""
    looked = [_eight_bits(frame, board) for _, frame in zip(range(MOST_LOOKED), frames, strict=False)]
    negative = [255 - grey for grey in looked]
    if not board.is_coded:
        return _explain_other_grid(looked, board) or _explain_inverted(negative, board)
    found = [_markers(grey, board) for grey in looked]
    ids = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(number for _, number, _ in found)]))
    if max((repeated for *_, repeated in found), default=0) >= REPEATED:
        return "the same markers are visible twice: show one board at a time"
    if len(ids) >= 2:
        count = board.columns * board.rows // (2 if board.kind == "charuco" else 1)
        last = board.first_id + count - 1
        if ids.max() > last or ids.min() < board.first_id:
            return (
                f"markers {ids.min()} to {ids.max()} of {board.dictionary} are visible, expected {board.first_id} to "
                f"{last}: the board has another number of columns or rows, or another first_id"
            )
        seen = f"{len(ids)} markers of {board.dictionary} are visible, but not in the layout of this board"
        if board.kind == "charuco":
            return f"{seen}: check whether columns and rows are swapped, or the pattern is a legacy one"
        return f"{seen}: check columns, rows, tag, gap and numbered_from"
    if sum(len(_markers(grey, board)[1]) for grey in negative) >= 2:
        return f"black and white are swapped: expected inverted: {'false' if board.inverted else 'true'}"
    return _explain_other_dictionary(looked, board)


def _explain_other_dictionary(looked: list[NDArray[np.uint8]], board: Board) -> str:
    counts = {}
    for name in dictionaries():
        detector = cv2.aruco.ArucoDetector(_dictionary(name), _parameters(board))
        ids = [detector.detectMarkers(grey)[1] for grey in looked]
        counts[name] = sum(0 if found is None else len(found) for found in ids)
    best = max(counts.values())
    if best < 3:
        return "no marker of any dictionary is visible"
    # The small dictionaries of a family are prefixes of the large ones.
    names = [name for name in counts if counts[name] == best]
    return f"its markers are from {' or '.join(names[:4])}, expected {board.dictionary} as in its file"


def _explain_other_grid(looked: list[NDArray[np.uint8]], board: Board) -> str:
    if board.kind == "circles":
        return _explain_other_circles(looked, board)
    steps = range(-OTHER_SIZES, OTHER_SIZES + 1)
    sizes = [(board.columns + i, board.rows + j) for i in steps for j in steps] + [(board.rows, board.columns)]
    sizes = [size for size in dict.fromkeys(sizes) if min(size) >= 3 and size != (board.columns, board.rows)]
    sizes.sort(key=lambda size: -size[0] * size[1])
    for grey in looked[: MOST_LOOKED // 2]:
        for columns, rows in sizes:
            if _checkerboard(grey, Board(board.kind, columns, rows, board.pitch)) is not None:
                return f"a board of {columns}x{rows} squares is visible, expected {board.columns}x{board.rows}"
    return ""


def _explain_other_circles(looked: list[NDArray[np.uint8]], board: Board) -> str:
    for grey in looked:
        *_, blobs = _find_circles(grey)
        lattices = find_lattices(blobs.uv, blobs.radius)
        names = [name for lattice in lattices if (name := name_grid(lattice, board, blobs.uv))]
        if str(board) in names:
            if names.count(str(board)) > 1:
                return f"{names.count(str(board))} of them are visible at once, expected one"
            return "it is cut off by the edge of the image"
        if names:
            return f"{with_article(names[0])} is visible, expected {with_article(str(board))}"
    return ""


def _explain_inverted(negative: list[NDArray[np.uint8]], board: Board) -> str:
    if any(_FINDERS[board.kind](grey, board) is not None for grey in negative):
        return f"black and white are swapped: expected inverted: {'false' if board.inverted else 'true'}"
    return "the whole board must be in the image, with a white margin" if not board.inverted else ""

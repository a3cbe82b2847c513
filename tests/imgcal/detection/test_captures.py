"""The detector on real frames: published centres are the reference."""

import csv

import cv2
import numpy as np
import pytest

from imgcal.detection import DetectionOptions, detect_frame
from imgcal.types import UNUSABLE, BlobFlag
from tests.imgcal.detection.discs import nearest


def published(folder, camera, columns=("u", "v")):
    with (folder / "detections.csv").open(newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row["camera"] == camera]
    return np.array([[float(row[column]) for column in columns] for row in rows])


@pytest.mark.parametrize("camera", ["cam1", "cam2", "cam3"])
def test_three_cameras_dots(captures, camera):
    folder = captures / "three-cameras-dots"
    blobs = detect_frame(cv2.imread(str(folder / f"frames/{camera}.tif"), cv2.IMREAD_UNCHANGED), DetectionOptions())
    rows, distance = nearest(blobs.uv, published(folder, camera))
    found = distance < 1.0
    assert found.mean() > 0.99
    assert np.sqrt((distance[found] ** 2).mean() / 2) < 0.20
    assert ((blobs.flags[rows[found]] & UNUSABLE) == 0).mean() > 0.97


@pytest.mark.parametrize("camera", ["cam3", "cam4"])
def test_cavity_two_cameras(captures, camera):
    folder = captures / "cavity-two-cameras"
    blobs = detect_frame(cv2.imread(str(folder / f"frames/{camera}.png"), cv2.IMREAD_UNCHANGED), DetectionOptions())
    columns = published(folder, camera, ("u", "v", "pixels", "width", "height"))
    # The dots of the target are as large as this; the thousands of particles are smaller.
    dots = columns[(columns[:, 2] >= 60) & (columns[:, 3:] >= 8).all(1) & (columns[:, 3:] <= 12).all(1), :2]
    rows, distance = nearest(blobs.uv, dots)
    found = distance < 1.0
    assert found.mean() > 0.92
    assert np.sqrt((distance[found] ** 2).mean() / 2) < 0.20
    assert ((blobs.flags[rows[found]] & UNUSABLE) == 0).mean() > 0.95


def lattice(points):
    """Walk over a regular grid of points (M, 2) from its middle: {(column, row): index}."""
    start = int(np.linalg.norm(points - np.median(points, 0), axis=1).argmin())
    offset = points - points[start]
    near = np.argsort(np.linalg.norm(offset, axis=1))[1:]
    right = offset[near[0]]
    sine = abs(right[0] * offset[near, 1] - right[1] * offset[near, 0]) / np.linalg.norm(offset[near], axis=1)
    down = offset[near[np.flatnonzero(sine > 0.6 * np.linalg.norm(right))[0]]]
    cells, queue = {(0, 0): start}, [((0, 0), right, down)]
    while queue:
        (i, j), right, down = queue.pop(0)
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            step = di * right + dj * down
            distance = np.linalg.norm(points - points[cells[i, j]] - step, axis=1)
            k, cell = int(distance.argmin()), (i + di, j + dj)
            if cell not in cells and k not in cells.values() and distance[k] < 0.25 * np.linalg.norm(step):
                walked = points[k] - points[cells[i, j]]
                cells[cell] = k
                queue.append((cell, di * walked if di else right, dj * walked if dj else down))
    return cells


@pytest.mark.parametrize("view", range(15))
def test_dot_grid(captures, view):
    frame = cv2.imread(str(captures / f"dot-grid-10x10/frames/{view:02d}.png"), cv2.IMREAD_UNCHANGED)
    blobs = detect_frame(frame, DetectionOptions(polarity="dark"))
    large = (blobs.flags & BlobFlag.MERGED) == 0
    large &= blobs.radius > 0.6 * np.median(blobs.radius[large])
    cells = lattice(blobs.uv[large])
    columns, rows = np.array(list(cells)).T
    assert np.ptp(columns) == np.ptp(rows) == 9
    # In view 2 the large origin dot is cut by the border of the image.
    cut = blobs.flags[large][list(cells.values())] & BlobFlag.BORDER
    assert len(cells) == 100 if view != 2 else len(cells) >= 99
    assert np.count_nonzero(cut) == 0 or view == 2
    assert large.sum() < 115
    assert blobs.sigma.max() < 5

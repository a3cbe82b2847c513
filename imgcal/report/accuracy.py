"""How good the rig is where it is used: one map a camera, one slice through the working volume, one plain sentence."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from markupsafe import Markup

from imgcal.estimation import MAP_DEPTHS, MAP_SIZE, PredictedError
from imgcal.messages import list_names
from imgcal.report import svg
from imgcal.report.charts import RESIDUAL_CLASSES
from imgcal.report.content import ReportContent
from imgcal.report.svg import Array, Axes

WORTH_SAYING = 0.8
"""Of the error in mm: without the exceptions it must be less to be mentioned."""
MOST_ADVISED = 3
"""Cameras for which more snapshots are advised."""
MORE_SNAPSHOTS = (5, 10, 20, 30, 50, 100)
"""Numbers that are advised."""
MAP = len(MAP_DEPTHS) // 2
"""The map that is drawn: the one in the middle of the depths."""
SLICE = 15
"""Cells along each side of the slice through the volume; odd, so that it passes through the middle."""


def sentences(content: ReportContent) -> tuple[str, ...]:
    """Describe in plain words how accurate the rig is over the working volume; nothing if that is not known."""
    predicted = content.predicted
    if predicted is None or not math.isfinite(predicted.median_px):
        return ()
    usual = float(np.nanmedian(predicted.camera_px))
    names = [content.cameras[i] for i in predicted.exceptions]
    words = ""
    if math.isfinite(predicted.median_mm):
        most = length(predicted.p95_mm)
        words = f"Median predicted error {length(predicted.median_mm)}; 95 % of the volume below {most}; "
        without = float(predicted.mm_without_exceptions.nanmedian())
        if without < WORTH_SAYING * predicted.median_mm:
            words += f"{length(without)} without {list_names(names)}; "
    words += f"{'' if words else 'Median predicted error '}in the images {svg.pixels(usual)} px"
    if names:
        worst = [f"{content.cameras[i]} ({svg.pixels(predicted.camera_px[i])} px)" for i in predicted.exceptions]
        words += f", except through {list_names(worst)}"
    found = [words + "."]
    if content.scale:
        found.append(f"{content.scale[0].upper()}{content.scale[1:]}.")
    if 0 < predicted.seen_share < 0.95:
        found.append(f"{100 * (1 - predicted.seen_share):.0f} % of the volume is seen by fewer than two cameras.")
    return tuple(found)


def advice(content: ReportContent) -> tuple[str, ...]:
    """Advise snapshots in the view of the cameras that are less accurate than the rest."""
    predicted = content.predicted
    if predicted is None:
        return ()
    usual = float(np.nanmedian(predicted.camera_px)) if predicted.exceptions else math.nan
    seen = [_snapshots_seen(content, camera) for camera in range(len(content.cameras))]
    steps: dict[int, list[str]] = {}
    for camera in predicted.exceptions[:MOST_ADVISED]:
        wanted = more_snapshots(seen[camera], int(np.median(seen)), predicted.camera_px[camera] / usual)
        steps.setdefault(wanted, []).append(content.cameras[camera])
    return tuple(f"Take {n} more snapshots in the view of {', '.join(names)}." for n, names in steps.items())


def more_snapshots(seen: int, usual: int, ratio: float) -> int:
    """Estimate how many more snapshots make a camera as accurate as the others.

    As many as it has seen fewer than they; or less, if its variance, which falls with their number, gets there earlier.

    Args:
        seen: snapshots that took part, in which the camera saw the object.
        usual: the same, of the others.
        ratio: its error over that of the others.
    """
    by_variance = seen * (ratio**2 - 1)
    wanted = min(by_variance, usual - seen) if 0 < seen < usual else by_variance or usual
    return next((n for n in MORE_SNAPSHOTS if n >= wanted), MORE_SNAPSHOTS[-1])


def length(mm: float) -> str:
    """Write a length to two digits: "0.31 mm", "12 mm"."""
    return f"{mm:.2g} mm" if mm < 99.5 else f"{mm:.0f} mm"


def limits(values: Array) -> Array:
    """Upper limits of the classes, of the series 1, 2, 5, 10; the last class is open: (classes - 1,).

    The median lies in the second class.
    """
    known = values[np.isfinite(values)]
    middle = max(float(np.median(known)), 1e-9) if len(known) else 1.0
    series = [digit * 10.0**power for power in range(-10, 8) for digit in (1, 2, 5)]
    first = next(i for i, value in enumerate(series) if value >= middle) - 1
    return np.array(series[first : first + RESIDUAL_CLASSES - 1])


def camera_map(predicted: PredictedError, camera: int, image_size: Array, limits: Array) -> Markup:
    """Draw one camera's errors over its image at the middle depth; what lies outside the volume is pale."""
    width, height = (float(x) for x in image_size)
    scale = 240 / width
    rows, columns = MAP_SIZE
    error, inside = predicted.maps.px[camera, MAP].numpy(), predicted.maps.inside[camera, MAP].numpy()
    parts = [svg.box(1, 1, 240, height * scale, "panel")]
    for kind, chosen in (("pale", ~inside), ("", inside)):
        parts.append(_cells(error, chosen, 1, 1, 240 / columns, height * scale / rows, limits, kind))
    if not np.isfinite(error).any():
        parts.append(svg.text(121, height * scale / 2 + 4, "sees nothing of the volume"))
    title = f"Predicted error over the image of {predicted.camera_names[camera]}"
    return svg.drawing(242, height * scale + 2, title, *parts)


def volume_slice(predicted: PredictedError, limits: Array) -> tuple[Markup, str]:
    """Draw the slice through the middle of the volume over which the error changes most, and name it."""
    mm = predicted.mm.numpy()
    normal = int(np.argmax([_range(mm.take(len(mm) // 2, axis=axis)) for axis in range(3)]))
    across, up = (axis for axis in range(3) if axis != normal)
    low, high = predicted.volume.low.numpy(), predicted.volume.high.numpy()
    width, height = float(high[across] - low[across]), float(high[up] - low[up])
    scale = 300 / max(width, height)
    axes = Axes(
        56, 56 + width * scale, 12, 12 + height * scale,
        (float(low[across]), float(high[across])), (float(low[up]), float(high[up])),
    )  # fmt: skip
    points = predicted.volume.grid(SLICE).select(normal, SLICE // 2).flatten(0, 1)
    error = predicted.uncertainty.point_error(points).view(SLICE, SLICE).numpy().T[::-1]  # rows from the top
    step = (axes.right - axes.left) / error.shape[1], (axes.bottom - axes.top) / error.shape[0]
    cells = _cells(error, np.isfinite(error), axes.left, axes.top, *step, limits, "")
    names = "xyz"
    positions = predicted.uncertainty.rig.positions.numpy()
    place = np.clip(positions, low, high)
    marks = svg.dots(axes.x(place[:, across]), axes.y(place[:, up]), "camera-mark")
    value = (low[normal] + high[normal]) / 2
    words = f"Slice at {names[normal]} = {value:.0f} mm in the rig's frame"
    drawn = svg.drawing(
        axes.right + 24, axes.bottom + 42, f"Predicted error of triangulated points. {words}", cells,
        svg.grid(axes, f"{names[across]} (mm)", f"{names[up]} (mm)", count=4), marks,
    )  # fmt: skip
    return drawn, words


def _cells(error: Array, chosen: Array, left: float, top: float, dx: float, dy: float, limits: Array, kind: str) -> str:
    """Rectangles of the chosen cells (rows, columns), neighbours of one class together, one path a class."""
    group = np.where(chosen & np.isfinite(error), np.searchsorted(limits, np.nan_to_num(error)), -1)
    steps: dict[int, list[str]] = {}
    for row, line in enumerate(group):
        ends = [0, *(np.flatnonzero(np.diff(line)) + 1).tolist(), len(line)]
        for start, end in pairwise(ends):
            if line[start] >= 0:
                x, y, width = left + start * dx, top + row * dy, svg.number((end - start) * dx)
                box = f"M{svg.number(x)} {svg.number(y)}h{width}v{svg.number(dy)}h-{width}z"
                steps.setdefault(int(line[start]), []).append(box)
    paths = (f'<path class="cell c{i} {kind}" d="{"".join(parts)}"/>' for i, parts in sorted(steps.items()))
    return "".join(paths)


def _range(values: Array) -> float:
    """The ratio of large values to small ones."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, 0.95) / max(np.quantile(known, 0.05), 1e-300)) if len(known) else 0.0


def _snapshots_seen(content: ReportContent, camera: int) -> int:
    rows = content.used & (content.detections.camera == camera)
    return len(np.unique(content.detections.snapshot[rows]))

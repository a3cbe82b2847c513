"""The rig in 3D: factory and recalibrated cameras, and the object in each snapshot, as a plotly figure."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.report.content import Array, ReportContent
from imgcal.types import CameraRig

Figure = dict[str, Any]  # {"data": [...], "layout": {...}} of plotly; colours may be "var(--name)" of the style sheet

EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100)
CLOUD_COLOURS = [[0, "#4f83e8"], [0.5, "#b860c4"], [1, "#f0a030"]]  # first to last snapshot, on light and on dark
LARGEST_CLOUD = 6000  # fiducials drawn, of all snapshots together


def rig_figure(content: ReportContent) -> Figure:
    """Build the figure of the rig; `layout.meta` holds the recalibrated cameras for each exaggeration.

    Convention: drawn in the factory's rig frame; the recalibrated rig is laid upon the factory's by `content.gauge`.
    """
    factory = content.factory.to(torch.float64)
    poses = _object_points(content, factory)
    length = _frustum_length(factory, poses)
    names = [escape(name, quote=False) for name in content.cameras]
    centres = factory.positions.cpu().numpy()
    data: list[Figure] = [_lines("factory", _frustums(factory, length), "var(--ghost)", 2)]
    meta: Figure = {"factors": [], "start": 0, "moving": []}
    if content.recalibrated is not None:
        factors, start = _exaggerations(content, length)
        drawn = [_exaggerated(content, factor) for factor in factors]
        frustums = [_frustums(rig, length) for rig in drawn]
        arrows = [_joined(np.stack((centres, rig.positions.cpu().numpy()), axis=1)) for rig in drawn]
        moving = [[_columns(points) for points in steps] for steps in (frustums, arrows)]
        traces = [{"trace": 1 + i, "steps": steps} for i, steps in enumerate(moving)]
        meta = {"factors": factors, "start": start, "moving": traces}
        data.append(_lines("recalibrated", frustums[start], "var(--after)", 4))
        data.append(_lines("shift of the centre", arrows[start], "var(--before)", 5))
    data.append(_labels(centres, names, length))
    if poses is not None:
        data.append(_cloud(content, poses))
    data.append(_axes(length))
    return {"data": data, "layout": _layout(meta, has_object=poses is not None)}


def drawn_fiducials(content: ReportContent) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Choose snapshots and fiducials to draw: indices, evenly spread, all of them where there are few."""
    if content.rig_from_object is None or content.object_points is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    good = np.flatnonzero(np.isfinite(content.rig_from_object.translation.cpu().numpy()).all(axis=1))
    snapshots = good[_evenly(len(good), 60)]
    fiducials = _evenly(len(content.object_points), max(LARGEST_CLOUD // max(len(snapshots), 1), 1))
    return snapshots, fiducials


def _evenly(count: int, largest: int) -> NDArray[np.int64]:
    return np.linspace(0, max(count - 1, 0), min(count, largest)).round().astype(np.int64)


def _object_points(content: ReportContent, factory: CameraRig) -> Array | None:
    """Fiducials of the drawn snapshots in the factory's rig frame: (S', N', 3) mm."""
    snapshots, fiducials = drawn_fiducials(content)
    if content.recalibrated is None or content.rig_from_object is None or not len(snapshots):
        return None
    recalibrated, laid = content.recalibrated.to(torch.float64), content.laid
    drawn_from_rig = (recalibrated if laid is None else laid).cam_from_rig[0].inverse() @ recalibrated.cam_from_rig[0]
    points = torch.as_tensor(content.object_points)[fiducials].to(torch.float64)
    poses = content.rig_from_object.to(torch.float64)[torch.as_tensor(snapshots)]
    return drawn_from_rig.apply(poses.apply(points.to(poses.translation.device))).detach().cpu().numpy()


def _exaggerated(content: ReportContent, factor: float) -> CameraRig:
    """Factory cameras, moved by `factor` times their change."""
    if content.laid is None:
        return content.factory
    factory = content.factory.to(torch.float64)
    step = content.laid.local(factory).detach()
    step[..., :6] *= factor
    return factory.retract(step)


def _exaggerations(content: ReportContent, length: float) -> tuple[list[int], int]:
    """Factors to choose from, and the one to start with: changes that can be seen but do not tear the rig apart."""
    if content.change is None or len(content.cameras) == 1:
        return [1], 0
    angle = float(np.linalg.norm(content.change[:, :3], axis=1).max())
    shift = float(np.linalg.norm(content.change[:, 3:6], axis=1).max())
    factors = [k for k in EXAGGERATIONS if k == 1 or (k * angle < 1.0 and k * shift < 4 * length)]
    start = max(i for i, k in enumerate(factors) if k == 1 or (k * angle < 0.35 and k * shift < 1.2 * length))
    return factors, start


def _frustum_length(rig: CameraRig, points: Array | None) -> float:
    """Depth of the drawn frustums, mm: in proportion to the distance between neighbouring cameras."""
    centres = rig.positions.cpu().numpy()
    if len(centres) > 1:
        distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
        np.fill_diagonal(distance, np.inf)
        return max(0.7 * float(np.median(distance.min(axis=1))), 1.0)
    if points is not None:
        return 0.2 * float(np.linalg.norm(points.reshape(-1, 3).mean(axis=0) - centres[0]))
    return 0.2 * (rig.working_distance or 500.0)


def _frustums(rig: CameraRig, length: float) -> Array:
    """Line through the corners of each camera's view at depth `length`, nan between strokes: (K, 3) mm in the rig."""
    low = -0.5 - rig.principal_point  # (C, 2) px
    high = rig.image_size - 0.5 - rig.principal_point
    focal = rig.focal_length.clamp_min(1.0)
    left, top = (low / focal * length).unbind(-1)
    right, bottom = (high / focal * length).unbind(-1)
    zero, depth, gap = torch.zeros_like(left), torch.full_like(left, length), torch.full_like(left, torch.nan)
    roof = top + 0.25 * (top - bottom)
    middle = (left + right) / 2
    corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
    a, b, c, d = (torch.stack((x, y, depth), -1) for x, y in corners)
    apex, lift = torch.stack((zero, zero, zero), -1), torch.stack((gap, gap, gap), -1)
    up = torch.stack((middle, (top + roof) / 2, depth), -1)  # a small roof shows which side is up
    stroke = torch.stack((a, up, b, lift, a, b, c, d, a, apex, b, lift, c, apex, d, lift), dim=1)  # (C, K, 3)
    rotation = rig.cam_from_rig.rotation
    points = stroke @ rotation + rig.positions[:, None]
    return points.flatten(0, 1).detach().cpu().numpy()


def _joined(segments: Array) -> Array:
    """Segments (C, 2, 3) as one line with gaps: (3 C, 3)."""
    gap = np.full((len(segments), 1, 3), np.nan)
    return np.concatenate((segments, gap), axis=1).reshape(-1, 3)


def _columns(points: Array) -> list[list[float | None]]:
    """Coordinates for plotly, to 0.01 mm; gaps are None."""
    return [[None if np.isnan(v) else round(float(v), 2) for v in column] for column in points.T]


def _xyz(points: Array) -> Figure:
    return dict(zip("xyz", _columns(points), strict=True))


def _lines(name: str, points: Array, colour: str, width: int) -> Figure:
    line = {"color": colour, "width": width}
    return {"type": "scatter3d", "mode": "lines", "name": name, "line": line, "hoverinfo": "skip", **_xyz(points)}


def _labels(centres: Array, names: list[str], length: float) -> Figure:
    away = centres - np.array([0.0, 0.0, 0.35 * length])
    font = {"size": 11, "color": "var(--ink)"}
    return {
        "type": "scatter3d", "mode": "text", "name": "camera names", "text": names, "textfont": font,
        "showlegend": False, "hoverinfo": "skip", **_xyz(away),
    }  # fmt: skip


def _cloud(content: ReportContent, points: Array) -> Figure:
    snapshots, fiducials = drawn_fiducials(content)
    names = [escape(content.detections.snapshot_names[s], quote=False) for s in snapshots]
    hover = [f"fiducial {f}, snapshot {name}" for name in names for f in fiducials]
    colour = np.repeat(np.arange(len(snapshots)), len(fiducials)).tolist()
    marker = {"size": 2.6 if len(hover) < 1500 else 1.6, "color": colour, "colorscale": CLOUD_COLOURS, "opacity": 0.9}
    return {
        "type": "scatter3d", "mode": "markers", "name": "fiducials, by snapshot", "marker": marker, "hovertext": hover,
        "hoverinfo": "text", **_xyz(points.reshape(-1, 3)),
    }  # fmt: skip


def _axes(length: float) -> Figure:
    """Axes of the rig frame."""
    ends = np.zeros((3, 2, 3))
    ends[np.arange(3), 1, np.arange(3)] = length
    trace = _lines("rig axes", _joined(ends), "var(--muted)", 3)
    label = [text for axis in ("x", "y", "z") for text in ("", axis, "")]
    font = {"size": 11, "color": "var(--muted)"}
    return {**trace, "showlegend": False, "mode": "lines+text", "text": label, "textfont": font}


def _layout(meta: Figure, *, has_object: bool) -> Figure:
    axis = {
        "color": "var(--muted)", "gridcolor": "var(--line)", "zerolinecolor": "var(--line)", "showbackground": False,
        "showspikes": False, "tickfont": {"size": 10},
    }  # fmt: skip
    eye = {"x": -1.45, "y": -0.7, "z": -0.75} if has_object else {"x": -1.2, "y": -1.1, "z": -1.7}
    return {
        "height": 560, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}, "meta": meta,
        "legend": {"orientation": "h", "x": 0, "y": 1, "font": {"size": 12}, "bgcolor": "rgba(0,0,0,0)"},
        "scene": {
            "domain": {"y": [0, 0.94]}, "aspectmode": "data", "dragmode": "orbit",
            "camera": {"eye": eye, "up": {"x": 0, "y": -1, "z": 0}},
            **{f"{name}axis": {**axis, "title": {"text": f"{name} (mm)", "font": {"size": 11}}} for name in "xyz"},
        },
    }  # fmt: skip

"""One overlay a camera: a frame, the blobs found in it, and where both rigs predict them, as plotly figures."""

from __future__ import annotations

import base64
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.report.content import Array, ReportContent
from imgcal.report.scene import Figure

WIDTHS = (1000, 800, 640, 480, 320, 200)  # px, of a frame in the page: the first whose frames fit together
LARGEST_FRAMES = 4_000_000  # bytes of all frames in the page
LARGEST_OVERLAY = 600  # blobs drawn in one camera
OVERLAYS_WITH_ALL = 16  # with more cameras, blobs drawn in one camera become fewer in proportion

LAYERS = ("labelled", "unlabelled", "before", "after")
SYMBOLS = {
    "labelled": ("circle-open", "#22c55e", 13, "detected"),
    "unlabelled": ("diamond-open", "#e0409a", 11, "detected, unlabelled or not used"),
    "before": ("x-thin-open", "#ff8c1a", 9, "predicted before"),
    "after": ("cross-thin-open", "#3b9dff", 9, "predicted after"),
}
"""Marker, colour, size and words of each layer; the colours hold on black and on white frames."""


def overlay_figures(content: ReportContent) -> list[Figure]:
    """Build the overlay of each camera; pixels are those of the full frame."""
    pictures = picture_uris(content.frames) if content.frames else [None] * len(content.cameras)
    return [_overlay(content, camera, picture) for camera, picture in enumerate(pictures)]


def picture_uris(frames: tuple[NDArray[np.uint8] | NDArray[np.uint16] | None, ...]) -> list[str | None]:
    """Compress frames to data URIs, as wide as the page's size allows, grey levels stretched for the eye."""
    files: list[bytes | None] = []
    for width in WIDTHS:
        files = [None if frame is None else _jpeg(frame, width) for frame in frames]
        if sum(len(file) for file in files if file) <= LARGEST_FRAMES:
            break
    return [None if file is None else "data:image/jpeg;base64," + base64.b64encode(file).decode() for file in files]


def blobs_drawn(content: ReportContent) -> int:
    """Blobs drawn in one overlay, at most."""
    return min(LARGEST_OVERLAY, max(50, LARGEST_OVERLAY * OVERLAYS_WITH_ALL // len(content.cameras)))


def _jpeg(frame: NDArray[np.uint8] | NDArray[np.uint16], width: int) -> bytes:
    height = max(round(frame.shape[0] * width / frame.shape[1]), 1)
    grey = frame.astype(np.float32)
    if width < frame.shape[1]:
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    low, high = np.quantile(grey, (0.01, 0.9995))
    stretched = np.clip((grey - low) / max(high - low, 1e-6), 0, 1) * 255
    return cv2.imencode(".jpg", stretched.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def _overlay(content: ReportContent, camera: int, picture: str | None) -> Figure:
    width, height = (int(x) for x in content.image_size[camera])
    d = content.detections
    rows = np.flatnonzero((d.camera == camera) & (d.snapshot == content.frame_snapshot))[: blobs_drawn(content)]
    used = content.used[rows] if content.used.any() else content.labels[rows] >= 0
    data = [
        _marks("labelled", d.uv[rows[used]], _words(content, rows[used])),
        _marks("unlabelled", d.uv[rows[~used]], _words(content, rows[~used])),
    ]
    for layer, predicted in (("before", content.predicted_before), ("after", content.predicted_after)):
        if predicted is None:
            continue
        shown = rows[np.isfinite(predicted[rows]).all(axis=1)]
        size = np.linalg.norm(predicted[shown] - d.uv[shown], axis=1)
        words = [f"fiducial {content.labels[r]}, {layer}: {s:.2f} px off" for r, s in zip(shown, size, strict=True)]
        if layer == "before":
            data.append(_links(d.uv[shown], predicted[shown]))
        data.append(_marks(layer, predicted[shown], words))
    return {"data": data, "layout": _layout(width, height, picture, d.uv[rows[used]])}


def _words(content: ReportContent, rows: NDArray[np.int64]) -> list[str]:
    label = content.labels[rows]
    return [f"fiducial {f}" if f >= 0 else "unlabelled" for f in label]


def _marks(layer: str, uv: Array, words: list[str]) -> Figure:
    symbol, colour, size, name = SYMBOLS[layer]
    marker = {"symbol": symbol, "size": size, "color": colour, "line": {"color": colour, "width": 1.8}}
    return {
        "type": "scatter", "mode": "markers", "name": name, "meta": layer, "marker": marker, "text": words,
        "hoverinfo": "text+x+y", "x": uv[:, 0].round(2).tolist(), "y": uv[:, 1].round(2).tolist(),
    }  # fmt: skip


def _links(observed: Array, predicted: Array) -> Figure:
    """Lines from each blob to where the factory rig predicts it."""
    columns: list[list[float | None]] = [
        [v for a, b in zip(observed[:, i], predicted[:, i], strict=True) for v in (round(a, 2), round(b, 2), None)]
        for i in (0, 1)
    ]
    return {
        "type": "scatter", "mode": "lines", "meta": "before", "hoverinfo": "skip", "x": columns[0], "y": columns[1],
        "line": {"color": SYMBOLS["before"][1], "width": 1},
    }  # fmt: skip


def _layout(width: int, height: int, picture: str | None, uv: Array) -> Figure:
    """Axes in full-resolution pixels; `meta.near` is the part around the object, for looking closer."""
    near = [-0.5, width - 0.5, -0.5, height - 0.5]
    if len(uv):
        low, high = uv.min(axis=0), uv.max(axis=0)
        half = 0.6 * max(*(high - low), 60.0 * height / width, (high - low)[1] * width / height) + 10
        centre = (low + high) / 2
        near = [centre[0] - half, centre[0] + half, centre[1] - half * height / width, centre[1] + half * height / width]
    axis = {"showgrid": False, "zeroline": False, "color": "var(--muted)", "tickfont": {"size": 10}, "ticks": "outside", "ticklen": 3}
    outline = {"type": "rect", "x0": -0.5, "y0": -0.5, "x1": width - 0.5, "y1": height - 0.5, "line": {"color": "var(--line)", "width": 1}}
    layout: Figure = {
        "margin": {"l": 34, "r": 4, "t": 4, "b": 22}, "showlegend": False, "hovermode": "closest", "dragmode": "zoom",
        "xaxis": {**axis, "range": [-0.5, width - 0.5], "constrain": "domain"},
        "yaxis": {**axis, "range": [height - 0.5, -0.5], "scaleanchor": "x", "constrain": "domain"},
        "shapes": [outline],
        "meta": {"near": [round(float(v), 1) for v in near], "aspect": round(height / width, 4)},
    }  # fmt: skip
    if picture is not None:
        layout["images"] = [{
            "source": picture, "xref": "x", "yref": "y", "x": -0.5, "y": -0.5, "sizex": width, "sizey": height,
            "sizing": "stretch", "layer": "below", "yanchor": "top", "xanchor": "left",
        }]  # fmt: skip
    return layout


def legend_name(layer: str) -> str:
    """Words for a layer, escaped."""
    return escape(SYMBOLS[layer][3])

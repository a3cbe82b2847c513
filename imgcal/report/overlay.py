"""One overlay a camera: a frame, the blobs found in it, and where both rigs predict them, as plotly figures."""

from __future__ import annotations

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.report.content import Array, ReportContent
from imgcal.report.scene import Figure

WIDTHS = (1000, 800, 640, 480, 320, 200)  # px, of a frame in the page: the first whose frames fit together
LARGEST_FRAMES = 4_000_000  # bytes of all frames in the page
GAMMA = 0.6  # below 1 lifts the dark ground of infrared frames
BRIGHT_PIXELS = 20  # may be white in a stretched frame
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
    grey: NDArray[np.floating] = frame.astype(np.float32)
    if width < frame.shape[1]:
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    # A few blobs of some pixels each are all that is bright: a quantile would clip them or drown them in noise.
    low = float(np.quantile(grey, 0.02))
    high = float(np.sort(grey, axis=None)[-BRIGHT_PIXELS:].min())
    share = np.clip((grey - low) / max(high - low, 0.15 * high, 1.0), 0, 1)
    stretched = 255 * share**GAMMA
    return cv2.imencode(".jpg", stretched.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def _overlay(content: ReportContent, camera: int, picture: str | None) -> Figure:
    width, height = (int(x) for x in content.image_size[camera])
    d = content.detections
    rows = np.flatnonzero((d.camera == camera) & (d.snapshot == content.frame_snapshot))[: blobs_drawn(content)]
    used = content.used[rows] if content.used.any() else content.labels[rows] >= 0
    scale = min(max((60 / max(len(rows), 1)) ** 0.5, 0.45), 1.0)
    data = [
        _marks("labelled", d.uv[rows[used]], _words(content, rows[used]), scale),
        _marks("unlabelled", d.uv[rows[~used]], _words(content, rows[~used]), scale),
    ]
    for layer, predicted in (("before", content.predicted_before), ("after", content.predicted_after)):
        if predicted is None:
            continue
        shown = rows[np.isfinite(predicted[rows]).all(axis=1)]
        size = np.linalg.norm(predicted[shown] - d.uv[shown], axis=1)
        words = [f"fiducial {content.labels[r]}, {layer}: {s:.2f} px off" for r, s in zip(shown, size, strict=True)]
        if layer == "before":
            data.append(_links(d.uv[shown], predicted[shown]))
        data.append(_marks(layer, predicted[shown], words, scale))
    return {"data": data, "layout": _layout(width, height, picture, d.uv[rows[used]])}


def _words(content: ReportContent, rows: NDArray[np.int64]) -> list[str]:
    label = content.labels[rows]
    return [f"fiducial {f}" if f >= 0 else "unlabelled" for f in label]


def _marks(layer: str, uv: Array, words: list[str], scale: float) -> Figure:
    symbol, colour, size, name = SYMBOLS[layer]
    line = {"color": colour, "width": 1.8}
    marker = {"symbol": symbol, "size": round(size * scale, 1), "color": colour, "line": line}
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
        (left, top), (right, bottom) = uv.min(axis=0), uv.max(axis=0)
        half_width = 0.6 * max(right - left, (bottom - top) * width / height) + 20
        half_height = half_width * height / width
        u, v = (left + right) / 2, (top + bottom) / 2
        near = [u - half_width, u + half_width, v - half_height, v + half_height]
    axis = {
        "showgrid": False, "zeroline": False, "color": "var(--muted)", "tickfont": {"size": 10}, "ticks": "outside",
        "ticklen": 3,
    }  # fmt: skip
    edge = {"color": "var(--line)", "width": 1}
    outline = {"type": "rect", "x0": -0.5, "y0": -0.5, "x1": width - 0.5, "y1": height - 0.5, "line": edge}
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

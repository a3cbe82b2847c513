"""One overlay a camera: a frame, the blobs found in it, and where both rigs predict them, as a drawing.

Marks keep their size on the screen however far a drawing is enlarged: the style sheet scales the symbols of `SYMBOLS`
by --k, pixels of the frame in one of the screen.
"""

from __future__ import annotations

import base64
from concurrent.futures import ThreadPoolExecutor
from html import escape

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from imgcal.report import svg
from imgcal.report.content import Array, ReportContent

Frame = NDArray[np.uint8] | NDArray[np.uint16]

WIDTHS = (1000, 800, 640, 480, 320, 200)  # px, of a frame in the page: the first whose frames fit together
LARGEST_FRAMES = 1_500_000  # bytes of all frames in the page
QUALITY = 65  # of WebP
GAMMA = 0.6  # below 1 lifts the dark ground of infrared frames
BRIGHT_PIXELS = 20  # may be white in a stretched frame
LARGEST_OVERLAY = 600  # blobs drawn in one camera
OVERLAYS_WITH_ALL = 16  # with more cameras, blobs drawn in one camera become fewer in proportion
USUAL_WIDTH = 560  # px on the screen

SYMBOLS = {
    "labelled": ("M-6 0a6 6 0 1 0 12 0a6 6 0 1 0-12 0", "detected"),
    "unlabelled": ("M0-6l6 6l-6 6l-6-6z", "detected, unlabelled or not used"),
    "before": ("M-4.5-4.5l9 9M4.5-4.5l-9 9", "predicted before"),
    "after": ("M0-5.5v11M-5.5 0h11", "predicted after"),
}
"""Layers: path around (0, 0), and words. Their colours, in the style sheet, hold on black and on white frames."""


def overlays(content: ReportContent) -> list[Markup]:
    """Draw the overlay of each camera; coordinates are pixels of the full frame."""
    pictures = picture_uris(content.frames) if content.frames else [None] * len(content.cameras)
    return [_overlay(content, camera, picture) for camera, picture in enumerate(pictures)]


def picture_uris(frames: tuple[Frame | None, ...]) -> list[str | None]:
    """Compress frames to data URIs, as wide as the page's size allows, grey levels stretched for the eye."""
    there = [frame for frame in frames if frame is not None]
    some = there[:: max(len(there) // 3, 1)]
    with ThreadPoolExecutor() as pool:
        for width in WIDTHS:
            tried = [len(_webp(frame, width)) for frame in some]
            if np.mean(tried or [0]) * len(there) <= LARGEST_FRAMES:
                break
        files = list(pool.map(lambda frame: None if frame is None else _webp(frame, width), frames))
    return [None if file is None else "data:image/webp;base64," + base64.b64encode(file).decode() for file in files]


def count_drawn_blobs(content: ReportContent) -> int:
    """Blobs drawn in one overlay, at most."""
    return min(LARGEST_OVERLAY, max(50, LARGEST_OVERLAY * OVERLAYS_WITH_ALL // len(content.cameras)))


def _webp(frame: Frame, width: int) -> bytes:
    height = max(round(frame.shape[0] * width / frame.shape[1]), 1)
    grey: NDArray[np.floating] = frame.astype(np.float32)
    if width < frame.shape[1]:
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    # A few blobs of some pixels each are all that is bright: a quantile would clip them or drown them in noise.
    ranks = int(0.02 * grey.size), max(grey.size - BRIGHT_PIXELS, 0)
    low, high = (float(value) for value in np.partition(grey, ranks, axis=None)[list(ranks)])
    share = np.clip((grey - low) / max(high - low, 0.15 * high, 1.0), 0, 1)
    stretched = 255 * share**GAMMA
    return cv2.imencode(".webp", stretched.astype(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, QUALITY])[1].tobytes()


def _overlay(content: ReportContent, camera: int, picture: str | None) -> Markup:
    width, height = (int(x) for x in content.image_size[camera])
    d = content.detections
    rows = np.flatnonzero((d.camera == camera) & content.pictured)[: count_drawn_blobs(content)]
    used = content.used[rows] if content.used.any() else content.labels[rows] >= 0
    parts = [f'<rect class="edge" x="-0.5" y="-0.5" width="{width}" height="{height}"/>']
    if picture is not None:
        parts.append(
            f'<image href="{picture}" x="-0.5" y="-0.5" width="{width}" height="{height}" preserveAspectRatio="none"/>'
        )
    parts.append(_marks("labelled", d.uv[rows[used]], _titles(content, rows[used])))
    parts.append(_marks("unlabelled", d.uv[rows[~used]], _titles(content, rows[~used])))
    for layer, predicted in (("before", content.predicted_before), ("after", content.predicted_after)):
        if predicted is None:
            continue
        shown = rows[np.isfinite(predicted[rows]).all(axis=1)]
        size = np.linalg.norm(predicted[shown] - d.uv[shown], axis=1)
        words = [
            f"fiducial {content.labels[r]}, {layer}: {svg.pixels(s)} px off" for r, s in zip(shown, size, strict=True)
        ]
        links = _links(d.uv[shown], predicted[shown]) if layer == "before" else ""
        parts.append(_marks(layer, predicted[shown], words, links))
    near = " ".join(svg.number(x) for x in _close_up(d.uv[rows[used]], width, height))
    crowded = " crowded" if len(rows) > 150 else ""
    return Markup(
        f'<svg class="overlay{crowded}" viewBox="-0.5 -0.5 {width} {height}" data-near="{near}" '
        f'style="--k:{width / USUAL_WIDTH:.3g}" role="img" aria-label="Overlay of {escape(content.cameras[camera])}">'
        f"{''.join(parts)}</svg>"
    )


def _titles(content: ReportContent, rows: NDArray[np.int64]) -> list[str]:
    return [f"fiducial {f}" if f >= 0 else "unlabelled" for f in content.labels[rows]]


def _marks(layer: str, uv: Array, words: list[str], links: str = "") -> str:
    uses = (
        f'<use href="#mark-{layer}" x="{u:.2f}" y="{v:.2f}"><title>{word}, at ({u:.2f}, {v:.2f})</title></use>'
        for (u, v), word in zip(uv, words, strict=True)
    )
    return f'<g class="{layer}">{links}{"".join(uses)}</g>'


def _links(observed: Array, predicted: Array) -> str:
    """Lines from each blob to where the factory rig predicts it."""
    steps = (f"M{a[0]:.2f} {a[1]:.2f}L{b[0]:.2f} {b[1]:.2f}" for a, b in zip(observed, predicted, strict=True))
    return f'<path d="{"".join(steps)}"/>'


def _close_up(uv: Array, width: int, height: int) -> tuple[float, float, float, float]:
    """The part around the object, for looking closer: left, top, width, height, in the proportions of the frame."""
    if not len(uv):
        return -0.5, -0.5, width, height
    (left, top), (right, bottom) = uv.min(axis=0), uv.max(axis=0)
    half = 0.6 * max(right - left, (bottom - top) * width / height) + 20
    u, v = (left + right) / 2, (top + bottom) / 2
    return u - half, v - half * height / width, 2 * half, 2 * half * height / width

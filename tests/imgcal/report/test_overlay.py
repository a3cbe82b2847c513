"""Overlays: full-resolution pixels over a small picture."""

from __future__ import annotations

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from imgcal.report import ReportContent
from imgcal.report.overlay import overlays, picture_uris


def _layer(drawing: str, layer: str) -> np.ndarray:
    marks = re.findall(rf'<use href="#mark-{layer}" x="([-\d.]+)" y="([-\d.]+)">', drawing)
    return np.array(marks, dtype=float).reshape(-1, 2)


def _decode(uri: str | None) -> np.ndarray:
    assert uri is not None
    data = base64.b64decode(uri.removeprefix("data:image/webp;base64,"))
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def test_layers_hold_the_blobs_of_the_snapshot(content: ReportContent) -> None:
    d = content.detections
    assert content.predicted_after is not None
    for camera, drawing in enumerate(overlays(content)):
        rows = (d.camera == camera) & (d.snapshot == 0)
        np.testing.assert_allclose(_layer(drawing, "labelled"), d.uv[rows & content.used], atol=0.006)
        np.testing.assert_allclose(_layer(drawing, "unlabelled"), d.uv[rows & ~content.used], atol=0.006)
        np.testing.assert_allclose(_layer(drawing, "after"), content.predicted_after[rows & content.used], atol=0.006)
        assert ' x="-0.5" y="-0.5" width="2048" height="1088" preserveAspectRatio="none"/>' in drawing
        assert 'viewBox="-0.5 -0.5 2048 1088"' in drawing


def test_every_row_of_the_pictured_snapshot_is_drawn(content: ReportContent) -> None:
    d = content.detections
    two_objects = replace(content, frame_snapshots=(0, 1))
    for camera, drawing in enumerate(overlays(two_objects)):
        rows = (d.camera == camera) & (d.snapshot <= 1) & content.used
        np.testing.assert_allclose(_layer(drawing, "labelled"), d.uv[rows], atol=0.006)


def test_refused_overlay_has_detections_alone(refused_content: ReportContent) -> None:
    for drawing in overlays(refused_content):
        assert re.findall('<g class="(.*?)">', drawing) == ["labelled", "unlabelled"]
        assert len(_layer(drawing, "labelled")) == 0


def test_missing_frames_leave_the_overlay_plain(content: ReportContent) -> None:
    drawings = overlays(replace(content, frames=(None, *content.frames[1:])))
    assert "<image" not in drawings[0]
    assert "<image" in drawings[1]
    assert _layer(drawings[0], "labelled").shape == _layer(overlays(content)[0], "labelled").shape


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 200), (np.uint16, 4000), (np.uint16, 60000)])
def test_pictures_are_small_and_stretched(dtype: type, top: int) -> None:
    frame = np.full((600, 1500), top // 20, dtype)
    frame[300:310, 750:760] = top
    picture = _decode(picture_uris((frame, None))[0])
    assert picture.shape == (400, 1000)
    assert picture[200:206, 501:506].max() > 240
    assert picture[:100].max() < 60
    assert np.unravel_index(picture.argmax(), picture.shape) == pytest.approx((203, 503), abs=4)


def test_small_and_flat_frames(content: ReportContent) -> None:
    small, flat = picture_uris((np.arange(120, dtype=np.uint8).reshape(10, 12), np.full((10, 12), 7, np.uint8)))
    assert _decode(small).shape == (10, 12)
    assert _decode(flat).max() < 30
    assert picture_uris((None,)) == [None]

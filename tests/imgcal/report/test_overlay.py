"""Overlays: full-resolution pixels over a small picture."""

from __future__ import annotations

import base64
from dataclasses import replace

import cv2
import numpy as np
import pytest

from imgcal.report import ReportContent
from imgcal.report.overlay import overlay_figures, picture_uris
from imgcal.report.scene import Figure


def _layer(figure: Figure, layer: str) -> np.ndarray:
    trace = next(t for t in figure["data"] if t["meta"] == layer and t["mode"] == "markers")
    return np.array([trace["x"], trace["y"]]).T


def _decode(uri: str | None) -> np.ndarray:
    assert uri is not None
    data = base64.b64decode(uri.removeprefix("data:image/jpeg;base64,"))
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def test_layers_hold_the_blobs_of_the_snapshot(content: ReportContent) -> None:
    d = content.detections
    assert content.predicted_after is not None
    for camera, figure in enumerate(overlay_figures(content)):
        rows = (d.camera == camera) & (d.snapshot == 0)
        np.testing.assert_allclose(_layer(figure, "labelled"), d.uv[rows & content.used], atol=0.006)
        np.testing.assert_allclose(_layer(figure, "unlabelled"), d.uv[rows & ~content.used], atol=0.006)
        np.testing.assert_allclose(_layer(figure, "after"), content.predicted_after[rows & content.used], atol=0.006)
        image = figure["layout"]["images"][0]
        assert (image["x"], image["y"], image["sizex"], image["sizey"]) == (-0.5, -0.5, 2048, 1088)


def test_refused_overlay_has_detections_alone(refused_content: ReportContent) -> None:
    for figure in overlay_figures(refused_content):
        assert {trace["meta"] for trace in figure["data"]} == {"labelled", "unlabelled"}
        assert len(_layer(figure, "labelled")) == 0


def test_missing_frames_leave_the_overlay_plain(content: ReportContent) -> None:
    figures = overlay_figures(replace(content, frames=(None, *content.frames[1:])))
    assert "images" not in figures[0]["layout"]
    assert "images" in figures[1]["layout"]
    assert _layer(figures[0], "labelled").shape == _layer(overlay_figures(content)[0], "labelled").shape


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

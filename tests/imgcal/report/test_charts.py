"""Static charts: what is counted and drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imgcal.report import ReportContent, charts, svg


@pytest.mark.parametrize(("low", "high"), [(-43.0, 43.0), (0.0, 0.05), (0.0, 1.0), (17.0, -17.0), (-5, 5), (0, 437)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    ticks = svg.ticks(low, high)
    assert 3 <= len(ticks) <= 11
    assert min(low, high) <= min(ticks)
    assert max(ticks) <= max(low, high)
    np.testing.assert_allclose(np.diff(ticks), ticks[1] - ticks[0])


@pytest.mark.parametrize(
    ("value", "expected"),
    [(123.4, "123"), (16.53, "16.5"), (3.392, "3.39"), (0.0457, "0.046"), (0.00123, "0.0012"), (0.0, "0.000")],
)
def test_pixels(value: float, expected: str) -> None:
    assert svg.pixels(value) == expected


def test_scatter_draws_what_is_inside_and_counts_the_rest() -> None:
    residual = np.array([[0.0, 0.0], [0.5, -0.5], [3.0, 0.0]])
    drawn = str(charts.residual_scatter(residual, 1.0, "after"))
    assert drawn.count("h0") == 2
    assert "1 outside" in drawn
    assert "M198 160h0" in drawn  # no error lies in the centre
    assert "M273 85h0" in drawn  # v points down


def test_histogram_has_the_area_of_the_normal() -> None:
    whitened = np.random.default_rng(0).normal(size=(2000, 2))
    drawn = str(charts.whitened_histogram(whitened))
    heights = [float(part.split('"')[0]) for part in drawn.split('height="')[1:]]
    curve = drawn.split('class="curve" d="M')[1].split('"')[0].split("L")
    peak = 310 - min(float(point.split()[1]) for point in curve)  # the unit normal's 0.399
    assert sum(heights) / peak * 0.3989 * 0.25 == pytest.approx(1, rel=0.01)


def test_coverage_counts_fields(content: ReportContent) -> None:
    d = content.detections
    middle = (np.arange(8) + 0.5) * 2048 / 8 - 0.5
    uv = d.uv.copy()
    rows = np.flatnonzero((d.camera == 2) & content.used)
    uv[rows] = np.stack((middle[np.arange(len(rows)) % 8], np.full(len(rows), 500.0)), axis=1)
    prior_std = replace(content, detections=replace(d, uv=uv))
    assert charts.covered_share(prior_std, 2) == 8 / 64
    panel = str(charts.coverage_panel(prior_std, 2, charts.coverage_limits(prior_std)))
    assert panel.count("h0") == int((d.camera == 2).sum())


def test_selection_is_repeatable_sorted_and_bounded() -> None:
    rows = np.arange(1000) * 3
    chosen = charts.sample(rows, 100)
    assert len(np.unique(chosen)) == 100
    assert (np.diff(chosen) > 0).all()
    assert set(chosen) <= set(rows)
    np.testing.assert_array_equal(chosen, charts.sample(rows, 100))
    np.testing.assert_array_equal(charts.sample(rows, 1000), rows)


def test_bad_fiducial_stands_out(content: ReportContent) -> None:
    assert content.predicted_after is not None
    predicted = content.predicted_after + 0.5 * (content.labels == 5)[:, None]
    drawn = str(charts.rms_by_fiducial(replace(content, predicted_after=predicted)))
    assert drawn.count("bar high") == 1
    assert "fiducial 5: " in drawn.split("bar high")[1].split("</rect>")[0]
    assert "bar high" not in str(charts.rms_by_fiducial(content))


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.0042, "4.2 ms"), (0.523, "523 ms"), (12.34, "12.3 s"), (250.0, "250 s")]
)
def test_duration(seconds: float, words: str) -> None:
    assert charts.duration(seconds) == words

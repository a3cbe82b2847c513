import numpy as np
import pytest

from imgcal.live_page.page_state import SPANS, Timelines, camera_changes, camera_sigmas


def test_a_day_takes_no_more_than_its_points():
    lines = Timelines()
    for second in range(0, 100_000, 1):
        lines.add(float(second), np.full((2, 4), second), np.full((2, 4), np.nan))
    content = lines.content()
    fine, coarse = content["fine"], content["coarse"]
    assert len(fine["time"]) == len(coarse["time"]) == 600
    assert fine["time"][-1] == 99_999 and fine["time"][0] == 99_400
    assert np.diff(coarse["time"]).min() >= SPANS["coarse"][0] and coarse["time"][0] < 100_000 - 86_000
    assert np.shape(fine["value"]) == (2, 4, 600) and fine["sigma"][0][0][0] is None


def test_a_clock_that_is_set_back_begins_anew():
    lines = Timelines()
    for time in (100.0, 101.0, 50.0):
        lines.add(time, np.zeros((1, 4)), np.zeros((1, 4)))
    assert lines.content()["fine"]["time"] == [50.0]


def test_values_have_their_units():
    change = np.zeros((1, 15))
    change[0, :8] = 0.0, np.deg2rad(0.3), np.deg2rad(0.4), 3.0, 0.0, 4.0, 16.0, 16.0
    assert camera_changes(change, np.full((1, 2), 1600.0))[0] == pytest.approx([0.5, 5.0, 1.0])
    std = np.zeros((1, 15))
    std[0, :8] = *[np.deg2rad(0.1)] * 3, 2.0, 2.0, 2.0, 8.0, 8.0
    assert camera_sigmas(std, np.full((1, 2), 1600.0))[0, :3] == pytest.approx([0.1, 2.0, 0.5])

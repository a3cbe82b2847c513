"""The verdict mentions blobs besides the object, and a moved object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imgcal.report import ReportContent
from imgcal.report.verdict import judge, unexplained_sentences


def test_nothing_is_said_where_all_is_explained(content: ReportContent) -> None:
    assert unexplained_sentences(replace(content, unexplained=np.zeros(10, dtype=np.int64))) == []


def test_a_move_makes_the_verdict_cautious(content: ReportContent) -> None:
    verdict = judge(replace(content, moves=("camera cam04 moved before snapshot 00012 (rotation 0.3 +- 0.01 deg)",)))
    assert verdict.level == "caution"
    assert "camera cam04 moved before snapshot 00012" in verdict.reservations[0]


def test_a_camera_that_sees_the_object_elsewhere_is_named(content: ReportContent) -> None:
    astray = np.zeros(10, dtype=np.int64)
    astray[2] = 20
    ((said, helps),) = unexplained_sentences(replace(content, unexplained=astray))
    assert said.startswith("cam03: 20 blobs") and "overlay of cam03" in helps


def test_cameras_full_of_reflections_are_named(content: ReportContent) -> None:
    assert content.predicted_after is not None
    predicted = content.predicted_after.copy()
    own = np.flatnonzero(content.detections.camera == 6)
    predicted[own[5:]] = np.nan
    said = [said for said, _ in unexplained_sentences(replace(content, predicted_after=predicted))]
    assert len(said) == (len(own) - 5 > 10)
    assert all("in cam07" in line for line in said)


def test_a_camera_that_stopped_fitting_makes_the_verdict_cautious(content: ReportContent) -> None:
    said = "camera cam04 stopped fitting at snapshot 00007: bumped, or mislabelled; the calibration holds before it"
    verdict = judge(replace(content, doubtful=(said,)))
    assert verdict.level == "caution" and said[1:] in verdict.reservations[0]
    assert any("Capture some more snapshots" in step for step in verdict.next_steps)


def test_rests_are_told_and_cameras_that_do_not_expose_together_are_a_reservation(content):
    verdict = judge(
        replace(
            content,
            timing=("the cameras expose at different times", "others jitter"),
            rests="2 snapshots show it at rest",
        )
    )
    assert verdict.level == "caution"
    assert {"The cameras expose at different times.", "Others jitter."} <= set(verdict.reservations)
    assert "2 snapshots show it at rest." in verdict.found
    assert "Trigger the cameras together, or hold the object still for each snapshot." in verdict.next_steps

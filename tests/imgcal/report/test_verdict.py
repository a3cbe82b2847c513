"""Verdicts in plain words: what makes a result trusted, doubted or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import Gauge
from imgcal.report import ReportContent, SnapshotSummary
from imgcal.report.verdict import judge


def test_sound_result_is_trusted(content: ReportContent) -> None:
    verdict = judge(content)
    assert verdict.level == "good"
    assert verdict.reservations == ()
    assert 4 <= len(verdict.figures) <= 6
    assert "10 of 10 cameras moved since the factory calibration" in " ".join(verdict.found)


def test_the_bumped_camera_is_named_even_if_it_is_the_first(content: ReportContent) -> None:
    step = torch.zeros(10, 15, dtype=torch.float64)
    step[0, 1] = 0.01
    rig = content.factory.retract(step)
    bumped = replace(content, recalibrated=rig, gauge=Gauge.from_majority(rig, content.factory))
    told = " ".join(judge(bumped).found)
    assert "1 of 10 cameras moved since the factory calibration, most of all cam01 (0.57°" in told
    relative = replace(bumped, gauge=Gauge.from_camera(2, 10))
    assert "1 of 9 cameras moved relative to cam03, most of all cam01 (0.57°" in " ".join(judge(relative).found)


@pytest.mark.parametrize(
    ("chi2", "words"), [(9.0, "3.0 times as large as the noise"), (0.2, "smaller than the stated noise")]
)
def test_residuals_that_do_not_fit_the_noise(content: ReportContent, chi2: float, words: str) -> None:
    verdict = judge(replace(content, chi2_per_dof=chi2))
    assert verdict.level == "caution"
    assert words in verdict.reservations[0]


def test_camera_that_saw_nothing_is_named(content: ReportContent) -> None:
    assert content.predicted_after is not None
    blind = content.predicted_after.copy()
    blind[content.detections.camera == 6] = np.nan
    verdict = judge(replace(content, predicted_after=blind))
    assert verdict.level == "caution"
    assert any("No usable observations in cam07" in line for line in verdict.reservations)


def test_rejected_snapshots_and_weak_data_are_said(content: ReportContent) -> None:
    snapshots = tuple(SnapshotSummary(str(i), 80, 0, "blurred" if i < 2 else "") for i in range(6))
    assert any("2 of 6 snapshots" in line for line in judge(replace(content, snapshots=snapshots)).reservations)
    weak = replace(content, prior_std=content.std)
    assert any("100 % of the parameters are not determined" in line for line in judge(weak).reservations)


def test_error_that_rose_is_said(content: ReportContent) -> None:
    verdict = judge(replace(content, rms_before=0.01))
    assert "The error did not fall." in verdict.reservations


def test_no_motion_is_said(content: ReportContent) -> None:
    assert content.std is not None
    still = replace(content, recalibrated=content.factory)
    assert "No camera moved measurably" in " ".join(judge(still).found)


def test_ambiguous_identity_is_explained(content: ReportContent) -> None:
    assert "absolute orientation is unknown" in " ".join(judge(replace(content, identity="ambiguous")).found)


def test_refusal_says_why_and_what_helps(refused_content: ReportContent, empty_content: ReportContent) -> None:
    verdict = judge(refused_content)
    assert verdict.level == "refused"
    assert verdict.found[0] == refused_content.reason
    assert any("could not be labelled" in step for step in verdict.next_steps)
    assert 4 <= len(verdict.figures) <= 6
    assert any("No blob was found" in step for step in judge(empty_content).next_steps)


def test_single_camera_has_no_neighbours(single_content: ReportContent) -> None:
    verdict = judge(single_content)
    assert "One camera" in " ".join(verdict.found)
    assert "cameras moved" not in {figure.name for figure in verdict.figures}


def test_what_is_not_known_is_said_in_a_good_verdict(content: ReportContent) -> None:
    known = judge(content)
    assert known.level == "good" and known.unknown == () and "where the object was seen" not in known.headline
    words, advice = "Not determined by these data: k3.", "Move the object by +100 mm in x."
    partly = judge(replace(content, unknown=(words,), advice=advice))
    assert partly.level == "good" and partly.unknown == (words,)
    assert partly.headline.startswith("Recalibrated where the object was seen") and advice in partly.next_steps


def test_a_refusal_that_is_not_about_identity_says_nothing_of_labels(refused_content: ReportContent) -> None:
    by_prior = replace(refused_content, reason="estimation: camera cam01: position x would differ by 300 mm")
    verdict = judge(by_prior)
    assert not any("label" in step for step in verdict.next_steps)
    assert not any("labelled" in figure.name for figure in verdict.figures)


def test_advice_of_a_refusal_is_about_its_own_reason(refused_content: ReportContent) -> None:
    unread = tuple(replace(snapshot, reason="") for snapshot in refused_content.snapshots)
    for reason in (
        "object: all cameras have moved together",
        "estimation: fiducial 3 (row of the object file): 40 of 50",
    ):
        verdict = judge(replace(refused_content, reason=reason, snapshots=unread))
        assert "object" in verdict.next_steps[0] and not any("factory" in step for step in verdict.next_steps)
    verdict = judge(replace(refused_content, reason="estimation: no minimum after 40 iterations", snapshots=unread))
    assert any("factory" in step for step in verdict.next_steps)
    figure = next(figure for figure in verdict.figures if "snapshots" in figure.name)
    assert (figure.value, figure.name) == (str(len(unread)), "snapshots")  # none of them was accepted, or rejected

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.report import ReportContent, render
from imgcal.report.accuracy import advice, camera_map, length, limits, more_snapshots, sentences, volume_slice
from imgcal.report.verdict import judge


def with_bad(content: ReportContent, cameras: tuple[int, ...], factor: float) -> ReportContent:
    """Make some cameras' predicted errors that many times as large."""
    assert content.predicted is not None
    px = content.predicted.px.clone()
    px[list(cameras)] *= factor
    return replace(content, predicted=replace(content.predicted, px=px))


def test_one_plain_sentence(content):
    (words,) = sentences(content)
    assert re.fullmatch(
        r"Median predicted error [\d.]+ mm; 95 % of the volume below [\d.]+ mm; in the images [\d.]+ px\.", words
    )
    assert advice(content) == ()


def test_exceptions_are_named_with_what_helps(content):
    bad = with_bad(content, (6,), 2.5)
    (words,) = sentences(bad)
    assert re.search(r", except through cam07 \([\d.]+ px\)\.$", words)
    # Six snapshots, a variance six times too large: 31 more would do.
    assert advice(bad) == ("Take 50 more snapshots in the view of cam07.",)
    assert "without" not in words
    spoilt = replace(bad, predicted=replace(bad.predicted, mm=3 * bad.predicted.mm))
    assert re.search(r"mm; [\d.]+ mm without cam07; in the images", sentences(spoilt)[0])
    verdict = judge(bad)
    assert words in verdict.found and advice(bad)[0] in verdict.next_steps


def test_all_exceptions_are_named(content):
    (words,) = sentences(with_bad(content, (1, 3, 5, 7), 40))
    assert words.count("px)") == 4


def test_a_camera_that_saw_nothing_is_brought_the_object(content):
    bad = with_bad(content, (6,), 100)
    blind = content.detections.camera == 6
    assert bad.predicted_after is not None
    unseen = np.where(blind[:, None], np.nan, bad.predicted_after)
    assert advice(replace(bad, predicted_after=unseen)) == ("Take 10 more snapshots in the view of cam07.",)


def test_a_volume_that_is_hardly_seen_says_so(content):
    mm = content.predicted.mm.clone()
    mm[:3] = torch.nan
    words = sentences(replace(content, predicted=replace(content.predicted, mm=mm)))
    assert words[-1] == "43 % of the volume is seen by fewer than two cameras."


def test_one_camera_knows_no_mm(single_content):
    (words,) = sentences(single_content)
    assert re.fullmatch(r"Median predicted error in the images [\d.]+ px\.", words)
    assert "how far a pixel is off" in render(single_content)


def test_nothing_is_said_of_a_refused_run(refused_content):
    assert sentences(refused_content) == () and advice(refused_content) == ()
    assert "nothing can be predicted" in render(refused_content)


@pytest.mark.parametrize(
    ("seen", "ratio", "expected"), [(0, 99, 30), (1, 2, 5), (5, 2, 20), (5, 9, 30), (30, 1.4, 30), (60, 2, 100)]
)
def test_number_of_snapshots(seen, ratio, expected):
    assert more_snapshots(seen, 30, ratio) == expected


def test_classes_are_round_and_the_median_is_in_the_second():
    classes = limits(np.array([np.nan, 0.003, 0.04, 7.0]))
    np.testing.assert_allclose(classes, [0.02, 0.05, 0.1, 0.2, 0.5])
    assert classes[0] < 0.04 <= classes[1]


def test_every_cell_of_a_map_is_drawn_once(content):
    predicted = content.predicted
    markup = camera_map(predicted, 2, content.image_size[2], limits(predicted.px.numpy()))
    boxes = re.findall(r"M[\d.]+ [\d.]+h([\d.]+)v([\d.]+)", markup)
    area = sum(float(width) * float(height) for width, height in boxes)
    assert area == pytest.approx(240 * 240 / 2048 * 1088, rel=0.02)
    assert 'class="cell c1 "' in markup and "pale" in markup
    assert len(markup) < 12_000


def test_a_camera_that_looks_elsewhere_says_so(content):
    predicted = replace(content.predicted)
    predicted.maps.px[1] = torch.nan
    markup = camera_map(predicted, 1, content.image_size[1], np.ones(5))
    assert "sees nothing of the volume" in markup


def test_the_slice_shows_where_the_error_changes(content):
    predicted = content.predicted
    height = torch.linspace(1, 50, predicted.mm.shape[2], dtype=torch.float64)
    steep = replace(predicted, mm=height.expand(predicted.mm.shape))
    markup, words = volume_slice(steep, np.array([1.0, 2, 5, 10, 20]))
    assert "z (mm)" in markup
    assert re.fullmatch(r"Slice at [xy] = -?\d+ mm in the rig's frame", words)


def test_lengths():
    assert [length(x) for x in (0.00284, 0.314, 12.3, 250.0)] == ["0.0028 mm", "0.31 mm", "12 mm", "250 mm"]

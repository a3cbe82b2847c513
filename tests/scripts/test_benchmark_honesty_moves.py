import pytest

from scripts.benchmarks import honesty_moves
from scripts.benchmarks.honesty_moves import DEGREES, IMAGES, PAGE, RESULT, SHARES, STEADY, bumped, steady, wrong_image
from scripts.output import read_json


@pytest.mark.parametrize("kind", honesty_moves.SCENES)
def test_faults_are_named_and_steady_rigs_left_alone(kind):
    assert bumped(kind, 0.1, 0.5, 0) == "found"
    assert wrong_image(kind, "v", 0) == "found"
    assert not steady(kind, "heavy tails", 3)


def test_the_committed_result_is_whole_and_shown():
    result = read_json(RESULT)
    kinds = len(honesty_moves.SCENES)
    assert set(result["steady"]) == set(STEADY)
    assert len(result["moves"]) == kinds * len(DEGREES) * len(SHARES)
    assert len(result["images"]) == kinds * len(IMAGES)
    page = PAGE.read_text("utf-8")
    assert honesty_moves.steady_table(result) in page
    assert all(honesty_moves.faults_table(result, part) in page for part in ("moves", "images"))


def test_nothing_wrong_was_accepted_and_steady_rigs_were_left_alone():
    result = read_json(RESULT)
    assert all(row["accepted"] == 0 for row in result["images"].values())
    usual = [row for name, row in result["steady"].items() if not name.endswith("one way")]
    assert sum(row["alarms"] for row in usual) <= 0.001 * sum(row["captures"] for row in usual)
    # A third of a pixel in two of twenty snapshots of a wand is not to be seen.
    plain = [row for name, row in result["moves"].items() if "0.02 deg" not in name]
    assert sum(row["accepted"] for row in plain) <= 0.02 * sum(sum(row.values()) for row in plain)

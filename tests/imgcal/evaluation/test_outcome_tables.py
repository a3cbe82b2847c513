import json

from imgcal.evaluation import Outcome, Scene, detector_tables, detector_values
from imgcal.io import load_object, read_rig
from imgcal.synthesis import FrameModel


def outcome(name, seed, difficulty, status, px=None):
    labels = {"labels": 10, "right_labels": 9} if px else {}
    return Outcome(name, seed, difficulty, 0, status, "why: so", 0.1, 10, px, px, px, visible=20, **labels)


OUTCOMES = (
    *(outcome("plain", None, "easy", "calibrated", px) for px in (0.1, 0.2, 0.9)),
    outcome("plain", None, "easy", "refused"),
    *(outcome("plain", None, "hard", status, px) for status, px in (("wrong", 7.0), ("refused", None))),
    *(outcome("net", 0, "easy", "calibrated", 0.1) for _ in range(2)),
    outcome("net", 1, "easy", "calibrated", 0.3),
    outcome("net", 1, "easy", "refused"),
    outcome("solo", 3, "easy", "calibrated", 0.5),
)


def test_what_each_detector_made_of_each_difficulty():
    shares, held_out, labels, took = detector_tables(OUTCOMES)
    assert (
        shares.header == ("detector", "seeds", "easy", "hard") and "wrong: more than 1 px and 5 times" in shares.title
    )
    assert shares.rows[0] == ("plain", "–", "75 / 25 / 0", "0 / 50 / 50")
    assert shares.rows[1] == ("net", "2 seeds", "75 ± 35 / 25 ± 35 / 0 ± 0", "–")
    assert shares.rows[2][:2] == ("solo", "one seed")
    assert [row[2:] for row in held_out.rows] == [("0.2", "–"), ("0.2", "–"), ("0.5", "–")]  # wrong ones do not count
    assert labels.rows[0][2:] == ("90.0 / 45", "90.0 / 45")
    assert took.rows[0][2] == "10"


def test_values_are_plain_and_count_reasons():
    scene = Scene(read_rig("T4"), load_object("cube8"), {"easy": FrameModel(), "hard": FrameModel()})
    values = json.loads(json.dumps(detector_values(OUTCOMES, scene, {"seed": 3}), allow_nan=False))
    assert values["reasons"] == {"plain": {"why": 2}, "net": {"why": 1}}
    assert len(values["outcomes"]) == len(OUTCOMES) and values["outcomes"][0]["held_out_px"] == 0.1
    assert values["difficulties"] == ["easy", "hard"] and values["seed"] == 3

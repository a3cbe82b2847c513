from imgcal.types import MovedCamera


def test_a_move_in_words_and_values():
    moved = MovedCamera("cam04", "00012", "rotation", 0.1004, 0.0021)
    assert str(moved) == "camera cam04 moved before snapshot 00012 (rotation 0.1 +- 0.002 deg)"
    assert moved.as_values() == {
        "camera": "cam04", "snapshot": "00012", "kind": "rotation", "size": 0.1004, "sigma": 0.0021, "unit": "deg",
    }  # fmt: skip
    assert str(MovedCamera("cam04", "00012", "unknown")) == "camera cam04 moved before snapshot 00012"

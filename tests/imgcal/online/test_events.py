import json
from pathlib import Path

from imgcal.online import EVENT_KINDS, Event


def test_an_event_is_one_line_with_its_times_in_words() -> None:
    event = Event(
        1.5, 90, "moved", "cam07", 1.25, "rotation", 0.3, 0.01, "deg", 412.0, "cam07 turned\n0.3 degrees"
    )  # fmt: skip
    line = event.to_json()
    assert "\n" not in line
    assert json.loads(line) == {
        "event": "moved",
        "camera": "cam07",
        "snapshot": "00090",
        "time": "1970-01-01T00:00:01.500+00:00",
        "since": "1970-01-01T00:00:01.250+00:00",
        "kind": "rotation",
        "size": 0.3,
        "sigma": 0.01,
        "unit": "deg",
        "evidence": 412.0,
        "message": "cam07 turned\n0.3 degrees",
    }


def test_a_number_that_is_none_is_null():
    event = Event(1.5, 1, "moved", "cam01", since=float("nan"), size=float("inf"), sigma=float("-inf"), evidence=2.0)
    line = json.loads(event.to_json())
    assert (line["since"], line["size"], line["sigma"], line["evidence"]) == (None, None, None, 2.0)
    assert json.loads(Event(float("nan"), 1, "moved").to_json())["time"] is None


def test_the_documents_name_every_event():
    text = (Path(__file__).parents[3] / "docs" / "live.md").read_text()
    told = text.partition("| event | means |")[2].partition("`keeper.save(path)`")[0]
    assert [kind for kind in EVENT_KINDS if f"`{kind}`" not in told] == []

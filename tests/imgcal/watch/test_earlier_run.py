import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from imgcal.errors import InputError
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.watch import ADAPTED, ADAPTED_CARD, LEARNING, BlobTable, EarlierRun, Folder, Known, Progress
from tests.imgcal.watch.states import OBJECT, RIG

SOURCE = "/data/capture"


@dataclass
class Recording:
    """A source of which nothing is read."""

    live: bool = False

    def items(self):
        raise AssertionError("begun")


def table(*names, rate=30.0):
    blobs = true_detections(simulate_truth(RIG, OBJECT, len(names), torch.Generator().manual_seed(0), None))
    return BlobTable(replace(blobs, snapshot_names=names), rate)


def leave(folder, **progress):
    """Write what an earlier run leaves: 9 s into `SOURCE`, after snapshot 10 and 300 bytes of events."""
    entry = {"time": 9.0, "name": "10", "logged": 300, "source": SOURCE} | progress
    (folder / "state.json").write_text(json.dumps({"progress": entry}))
    return folder / "state.json"


@pytest.mark.parametrize("source", [Recording(), Recording(live=True), Folder(Path("capture"), RIG), table("10")])
def test_nothing_applies_where_nothing_was_left(source, tmp_path):
    assert EarlierRun.find(tmp_path, source, SOURCE) == EarlierRun()


@pytest.mark.parametrize("source", [Recording(), Recording(live=True), Folder(Path("capture"), RIG), table("10")])
def test_a_state_without_a_position_is_resumed_and_all_is_read(source, tmp_path):
    (tmp_path / "state.json").write_text('{"progress": null}')
    assert EarlierRun.find(tmp_path, source, SOURCE) == EarlierRun(tmp_path / "state.json")


@pytest.mark.parametrize("noted", [SOURCE, None])
@pytest.mark.parametrize(
    ("source", "keep_all", "expected"),
    [
        (Recording(), False, EarlierRun(known=Known(9.0, "10"), logged=300)),
        (Recording(live=True), False, EarlierRun()),
        (Recording(live=True), True, EarlierRun(known=Known(9.0, "10"), logged=300)),
        (Folder(Path("capture"), RIG), False, EarlierRun(after="10", logged=300)),
        (Folder(Path("capture"), RIG), True, EarlierRun(after="10", logged=300)),
        (table("9", "10", "11"), False, EarlierRun(known=Known(9.0, "10"), logged=300)),
        (table("a", "b"), False, EarlierRun(known=Known(9.0), logged=300)),
    ],
)
def test_the_same_source_continues_after_the_last_snapshot(source, keep_all, expected, noted, tmp_path):
    state = leave(tmp_path, source=noted)
    assert EarlierRun.find(tmp_path, source, SOURCE, keep_all) == replace(expected, state=state)


@pytest.mark.parametrize(
    ("source", "keep_all", "expected"),
    [
        (Recording(), False, EarlierRun(known=Known(9.0, another=True))),
        (Recording(live=True), False, EarlierRun()),
        (Recording(live=True), True, EarlierRun(known=Known(9.0, another=True))),
        (Folder(Path("capture"), RIG), False, EarlierRun()),
        (table("9", "10", "11"), False, EarlierRun(known=Known(9.0, another=True))),
    ],
)
def test_another_source_is_read_in_full_and_no_event_is_removed(source, keep_all, expected, tmp_path):
    state = leave(tmp_path)
    assert EarlierRun.find(tmp_path, source, "/data/other", keep_all) == replace(expected, state=state)


def test_a_state_of_a_version_that_noted_no_events_keeps_them_all(tmp_path):
    state = leave(tmp_path, logged=None)
    assert EarlierRun.find(tmp_path, Recording(), SOURCE) == EarlierRun(state, Known(9.0, "10"))


def test_a_table_at_another_rate_is_refused_unless_it_is_another_table(tmp_path):
    leave(tmp_path, rate=30.0)
    assert EarlierRun.find(tmp_path, table("10"), SOURCE).known == Known(9.0, "10")
    assert EarlierRun.find(tmp_path, table("10", rate=60.0), "/data/other").known == Known(9.0, another=True)
    with pytest.raises(InputError, match=r"--rate: found 60, expected 30 as in .*state\.json"):
        EarlierRun.find(tmp_path, table("10", rate=60.0), SOURCE)


def test_adapted_networks_are_found_whatever_the_source(tmp_path):
    (tmp_path / LEARNING / ADAPTED).mkdir(parents=True)
    (tmp_path / LEARNING / ADAPTED / ADAPTED_CARD).touch()
    found = EarlierRun.find(tmp_path, Recording(), SOURCE)
    assert found == EarlierRun(networks=found.networks) and found.networks is not None


@pytest.mark.parametrize(
    "text",
    ["", "{}", "[1]", '{"progress": {"time": "x", "name": null}}', '{"progress": {"time": 1, "name": 2}}', "[" * 5000],
)
def test_progress_that_is_none_of_ours(text, tmp_path):
    (tmp_path / "state.json").write_text(text)
    for load in (Progress.load, lambda folder: EarlierRun.find(folder, Recording(), SOURCE)):
        with pytest.raises(InputError, match=r"state\.json: found"):
            load(tmp_path)

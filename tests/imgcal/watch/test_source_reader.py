import threading
import time

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.io import read_rig
from imgcal.watch import CameraBlobs, Exposure, Known, SourceReader, Timing, Unreadable
from imgcal.watch import source_reader as module

PAIR = read_rig("T4").select([0, 1])
NOTHING = CameraBlobs.of([])


class Given:
    """A source that gives what it was given."""

    def __init__(self, items, live=False):
        self.live, self._items = live, items
        self.closed = False

    def items(self):
        try:
            yield from self._items
        finally:
            self.closed = True


def snapshots(count, first=0):
    return [Exposure(name, k / 60, NOTHING) for k in range(first, first + count) for name in PAIR.camera_names]


def taken(intake):
    found = []
    while not intake.ended:
        snapshot = intake.next(1.0)
        found += [] if snapshot is None else [snapshot]
    return found


def test_a_recording_waits_and_nothing_of_it_is_dropped():
    source = Given(snapshots(100))
    with SourceReader(source, PAIR) as intake:
        time.sleep(0.1)
        assert intake.waiting == module.MOST_WAITING
        found = taken(intake)
    assert [s.time for s in found] == [k / 60 for k in range(100)]
    assert intake.dropped == 0 and source.closed


def test_frames_among_blobs_are_told_and_not_silently_left_out():
    frame = np.zeros(PAIR.image_size[1].tolist()[::-1], np.uint8)
    given = snapshots(3)
    given[3] = Exposure(given[3].camera, given[3].time, frame)
    with SourceReader(Given(given), PAIR) as intake:
        found = taken(intake)
    assert [len(one.exposures) for one in found] == [2, 1, 2] and dict(intake.unreadable) == {"cam02": 1}
    assert list(intake.reasons) == ["cam02: found a frame, expected blobs as in the first exposure"]


@pytest.mark.parametrize("keep_all", [False, True])
def test_of_a_live_source_the_oldest_are_dropped_and_counted(keep_all):
    with SourceReader(Given(snapshots(100), live=True), PAIR, keep_all=keep_all) as intake:
        time.sleep(0.2)
        found = taken(intake)
    first = 0 if keep_all else 100 - module.MOST_WAITING
    assert [s.time for s in found] == [k / 60 for k in range(first, 100)]
    assert intake.dropped == first


def test_frames_that_wait_are_bounded_in_memory(monkeypatch):
    width, height = PAIR.image_size[0].tolist()
    monkeypatch.setattr(module, "MOST_BYTES", 5 * width * height)
    frame = np.zeros((height, width), np.uint8)
    items = [Exposure(name, k / 60, frame) for k in range(10) for name in PAIR.camera_names]
    with SourceReader(Given(items, live=True), PAIR) as intake:
        time.sleep(0.2)
        assert len(taken(intake)) == 2 and intake.dropped == 8


@pytest.mark.parametrize("limit", [1, 5])  # frames: also a single snapshot may be too large
def test_a_recording_of_large_frames_waits_too(monkeypatch, limit):
    width, height = PAIR.image_size[0].tolist()
    monkeypatch.setattr(module, "MOST_BYTES", limit * width * height)
    frame = np.zeros((height, width), np.uint8)
    items = [Exposure(name, k / 60, frame) for k in range(10) for name in PAIR.camera_names]
    with SourceReader(Given(items), PAIR) as intake:
        time.sleep(0.2)
        assert intake.waiting == max(limit // 2, 1)
        assert [s.time for s in taken(intake)] == [k / 60 for k in range(10)] and intake.dropped == 0


def test_what_cannot_be_read_is_counted_and_does_not_end_it():
    items = [
        Unreadable("junk\nand more"), Exposure("cam99", 0.0, NOTHING), Exposure("cam01", float("nan"), NOTHING),
        Unreadable("torn", "cam02"), *snapshots(1),
    ]  # fmt: skip
    with SourceReader(Given(items), PAIR) as intake:
        assert len(taken(intake)) == 1
    assert dict(intake.unreadable) == {"": 2, "cam01": 1, "cam02": 1}
    assert list(intake.reasons)[-1] == "torn" and "cam99" in intake.reasons[0]


def test_a_source_that_fails_says_so_after_what_came_before():
    def failing():
        yield from snapshots(2)
        raise InputError("video.avi: truncated")

    with SourceReader(Given(failing()), PAIR) as intake:
        assert [intake.next(1.0).time for _ in range(2)] == [0.0, 1 / 60]
        with pytest.raises(InputError, match="truncated"):
            intake.next(1.0)


def test_incomplete_snapshots_do_not_wait_for_more_to_come():
    go_on = threading.Event()

    def quiet():
        yield Exposure("cam01", 1.0, NOTHING)
        while not go_on.is_set():
            time.sleep(0.01)
            yield None

    with SourceReader(Given(quiet(), live=True), PAIR, Timing(patience=0.1)) as intake:
        started = time.monotonic()
        assert set(intake.next(5.0).exposures) == {"cam01"}
        assert 0.05 < time.monotonic() - started < 4.5
        assert intake.next(0.01) is None and not intake.ended
        go_on.set()


def test_leaving_ends_a_source_that_would_go_on_for_ever():
    def endless():
        k = 0
        while True:
            k += 1
            yield from snapshots(1, k)

    source = Given(endless())
    with SourceReader(source, PAIR) as intake:
        intake.next(1.0)
    assert source.closed and not intake._thread.is_alive()


@pytest.mark.parametrize(
    ("known", "new", "before"),
    [
        (Known(2.0), ["c"], 2),
        (Known(99.0, "b"), ["c"], 2),  # other times, as after another rate: names tell
        (Known(0.5, another=True), ["z", "b", "c"], 0),
    ],
)
def test_what_an_earlier_run_has_worked_on_is_left_out(known, new, before):
    items = [Exposure(c, t, NOTHING, n) for t, n in ((1.0, "z"), (2.0, "b"), (3.0, "c")) for c in PAIR.camera_names]
    with SourceReader(Given(items, live=False), PAIR, known=known) as intake:
        found = taken(intake)
    assert [snapshot.name for snapshot in found] == new and intake.known_before == before


def blobs_at(time, uv, name=None):
    return [Exposure(camera, time, CameraBlobs.of(uv), name) for camera in PAIR.camera_names]


def first_of(*items):
    """Digest of the first snapshot of a recording that shows anything."""
    with SourceReader(Given(items), PAIR) as intake:
        taken(intake)
    return intake.first


@pytest.mark.parametrize("begin", [[], blobs_at(0.5, [])])  # a recording may begin before the object comes
def test_a_recording_is_known_by_what_it_shows_first(begin):
    items = [*begin, *blobs_at(1.0, [[5.0, 6.0]]), *blobs_at(2.0, [[7.0, 8.0]])]
    first = first_of(*items)
    assert first is not None and first == first_of(*items[:-2]) == first_of(*blobs_at(9.0, [[5.0, 6.0]], "elsewhere"))
    assert first != first_of(*items[-2:]) and first != first_of(items[-4]) and first_of(*blobs_at(1.0, [])) is None
    with SourceReader(Given(items), PAIR, known=Known(1.0, first=first)) as intake:
        assert intake.wait_until_open().resumes
        assert [snapshot.time for snapshot in taken(intake)] == [2.0]
    with SourceReader(Given(items), PAIR, known=Known(0.75, first=first + 1)) as intake:
        assert not intake.wait_until_open().resumes
        assert [snapshot.time for snapshot in taken(intake)] == [1.0, 2.0] and intake.known_before == len(begin) // 2
    with (
        pytest.raises(InputError, match="begins at 1 s, expected one after 3 s; --fresh starts over"),
        SourceReader(Given(items), PAIR, known=Known(3.0, first=first + 1)) as intake,
    ):
        intake.wait_until_open()


def test_why_the_same_recording_cannot_go_on_is_told_before_anything_is_written():
    items = blobs_at(1.0, [[5.0, 6.0]])
    known = Known(0.5, first=first_of(*items), mismatch="another rate")
    with pytest.raises(InputError, match="another rate"), SourceReader(Given(items), PAIR, known=known) as intake:
        intake.wait_until_open()


def test_a_recording_whose_clocks_are_set_back_is_gone_on_with_where_it_was():
    times = [100.0, 101.0, 102.0, 50.0, 51.0, 52.0]
    items = [one for number, time in enumerate(times) for one in blobs_at(time, [[5.0 + number, 6.0]])]
    with SourceReader(Given(items), PAIR) as intake:
        found = taken(intake)
    assert [snapshot.time for snapshot in found] == times
    for number, last in enumerate(found):
        with SourceReader(Given(items), PAIR, known=Known(last.time, era=last.era)) as intake:
            assert [snapshot.time for snapshot in taken(intake)] == times[number + 1 :]


def test_another_recording_that_is_not_later_is_refused():
    items = [Exposure(camera, 1.0, NOTHING, "a") for camera in PAIR.camera_names]
    refused = pytest.raises(InputError, match="begins at 1 s, expected one after 5 s; --fresh starts over")
    with refused, SourceReader(Given(items, live=False), PAIR, known=Known(5.0, "a", another=True)) as intake:
        intake.next(5.0)

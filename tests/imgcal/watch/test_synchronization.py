import random
import tracemalloc

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.types import Detections
from imgcal.watch import CameraBlobs, Exposure, Synchronizer, Timing
from imgcal.watch.synchronization import LEAST_INTERVALS, MOST_PENDING, OUT_AFTER, REMEMBERED

NOTHING = CameraBlobs.of([])
ABC = ("a", "b", "c")


def at(camera, time, snapshot=None):
    return Exposure(camera, time, NOTHING, snapshot)


def cameras(snapshots):
    return ["".join(sorted(snapshot.exposures)) for snapshot in snapshots]


def test_a_snapshot_goes_on_when_all_have_given_theirs():
    sync = Synchronizer(ABC, Timing(tolerance=0.005))
    assert sync.add(at("b", 1.000)) == sync.add(at("a", 1.004)) == ()
    (snapshot,) = sync.add(at("c", 1.001))
    assert (snapshot.time, cameras([snapshot])) == (1.001, ["abc"])


def test_the_tolerance_is_between_the_earliest_and_the_latest():
    sync = Synchronizer(ABC, Timing(tolerance=0.005))
    for camera, time in (("a", 1.004), ("b", 1.0), ("c", 0.998)):
        assert sync.add(at(camera, time)) == ()
    assert cameras(sync.flush()) == ["c", "ab"]


def test_a_missing_camera_is_waited_for_by_the_time_stamps_of_the_others():
    sync = Synchronizer(ABC, Timing(patience=0.1))
    done = [s for k in range(20) for camera in "ab" for s in sync.add(at(camera, k / 60))]
    assert [s.time for s in done] == [k / 60 for k in range(len(done))]
    assert sync.waiting <= 7 and sync.counts["missing"]["c"] == len(done) > 10


def test_exposures_that_waited_for_a_reader_that_was_held_up_are_not_late():
    sync, now, done = Synchronizer(ABC, Timing(patience=0.1)), 0.0, []
    for k in range(30):
        now = max(now, k / 3)
        for camera in ABC:
            done += sync.add(at(camera, 1.7e9 + k / 3), now)
            now += 0.3 * (camera == "a" and k % 4 == 3)  # after the first exposure, while the others already wait
        done += sync.release_due(now)
    assert cameras(done) == ["abc"] * 30 and not sync.counts["late"].total() + sync.counts["missing"].total()


@pytest.mark.parametrize("name", [None, "1"])
def test_a_missing_camera_is_waited_for_by_this_clock_when_nothing_more_comes(name):
    sync = Synchronizer(ABC, Timing(patience=0.1))
    assert sync.add(at("a", 1.7e9, name), 5.0) + sync.add(at("b", 1.7e9, name), 5.01) == ()
    assert sync.release_due(5.05) == () and cameras(sync.release_due(5.2)) == ["ab"]


def test_nobody_waits_for_a_camera_that_is_out_and_one_that_is_back_is_waited_for():
    sync = Synchronizer(ABC, Timing(patience=0.1))
    for k in range(60):
        sync.add(at("a", k / 60))
        sync.add(at("b", k / 60))
    assert sync.waiting == 0
    sync.add(at("c", 1.0))
    sync.add(at("a", 1.0))
    assert sync.waiting == 1
    assert cameras(sync.add(at("b", 1.0))) == ["abc"]


def test_a_camera_that_always_comes_a_little_later_is_not_out_for_ever():
    sync = Synchronizer(ABC, Timing(patience=0.1))
    done = []
    for k in range(40):  # c is quiet at first, and then one snapshot behind the others
        for camera in "ab":
            done += sync.add(at(camera, k / 60))
        if k > 20:
            done += sync.add(at("c", (k - 1) / 60))
    assert cameras(done[-10:]) == ["abc"] * 10


def test_the_clock_of_this_machine_ends_the_waiting_when_nothing_more_comes():
    sync = Synchronizer(ABC, Timing(patience=0.1))
    sync.add(at("a", 5.0), now=100.0)
    assert sync.release_due(100.05) == ()
    assert cameras(sync.release_due(100.11)) == ["a"]


def test_late_duplicate_and_out_of_order_exposures_are_counted():
    sync = Synchronizer(ABC, Timing())
    for time in (0.0, 0.02):
        for camera in ABC:
            sync.add(at(camera, time))
    assert sync.add(at("a", 0.001)) == ()  # of the first one
    sync.add(at("a", 0.06))
    sync.add(at("a", 0.0601))
    sync.add(at("b", 0.06))
    assert sync.add(at("b", 0.04)) == ()  # before 0.06, which waits
    assert [s.time for s in sync.add(at("c", 0.06))] == []  # 0.04 goes first
    assert cameras(sync.flush()) == ["b", "abc"]
    counts = {kind: dict(counter) for kind, counter in sync.counts.items() if sum(counter.values())}
    assert counts["late"] == {"a": 1, "b": 0, "c": 0} == counts["duplicate"]
    assert counts["out_of_order"] == {"a": 1, "b": 1, "c": 0}
    assert "clock_off" not in counts


def test_snapshots_always_go_on_in_the_order_of_time_whatever_comes():
    draw = random.Random(3)
    sync, times = Synchronizer(ABC, Timing(patience=0.05)), []
    for k in range(3000):
        for camera in ABC:
            if draw.random() < 0.1:
                continue
            late = draw.choice((0, 0, 0, 1, 5))
            times += [s.time for s in sync.add(at(camera, (k - late) / 60 + draw.uniform(-0.002, 0.002)))]
    assert len(times) > 2000 and times == sorted(times)


def test_one_clock_that_leaps_is_left_out_and_does_not_hold_up_the_others():
    for leap in (-3600.0, 3600.0):
        sync, done = Synchronizer(ABC, Timing()), []
        for k in range(200):
            for camera in ABC:
                wrong = leap if camera == "b" and k >= 50 else 0.0
                done += sync.add(at(camera, 1000 + k / 60 + wrong))
        assert len(done) >= 200 - 8 and all(999 < s.time < 1005 for s in done), leap
        assert sync.counts["clock_off"]["b"] == 150 and sync.leaps == 0
        assert cameras(done[:50]) == ["abc"] * 50 and cameras(done[-5:]) == ["ac"] * 5


@pytest.mark.parametrize("leap", [-3600.0, 3600.0])
def test_clocks_that_leap_together_are_followed_and_nothing_is_lost(leap):
    sync = Synchronizer(ABC, Timing())
    done = [s for k in range(100) for c in ABC for s in sync.add(at(c, k / 60 + (leap if k >= 50 else 0.0)))]
    assert cameras(done) == ["abc"] * 100
    assert sync.leaps == 1 and sum(sync.counts["clock_off"].values()) == 0


def test_the_last_camera_that_is_left_may_have_another_clock():
    sync, done = Synchronizer(("a", "b"), Timing()), []
    for k in range(600):
        for camera in ("a", "b") if k < 50 else ("b",):
            done += sync.add(at(camera, k / 60 + (1e6 if k >= 50 else 0.0)))
    assert len(done) > 550 - 150 and done[-1].time > 1e6


def test_single_wrong_time_stamps_do_not_disturb_the_others():
    sync, done = Synchronizer(ABC, Timing()), []
    draw = random.Random(1)
    for k in range(1000):
        for camera in ABC:
            time = 100 + k / 60
            if camera == "a" and k % 10 == 0:
                time += draw.choice((-8.0, 8.0, 1e9))
            done += sync.add(at(camera, time), now=k / 60)
    assert cameras(done).count("abc") >= 850 and len(done) >= 950


def test_named_snapshots_go_by_their_names():
    sync = Synchronizer(("a", "b"), Timing(patience=0.1))
    assert sync.add(at("a", 5.0, "1"), now=1.0) == sync.add(at("a", 5.0, "2"), now=1.0) == ()
    done = sync.add(at("b", 9.0, "1"), now=1.01)
    assert [(s.name, s.time) for s in done] == [("1", 9.0)]
    assert [s.name for s in sync.release_due(1.2)] == ["2"]
    assert sync.add(at("b", 5.0, "2"), now=1.2) == () and sync.counts["late"]["b"] == 1


def test_memory_does_not_grow():
    sync = Synchronizer(ABC, Timing(patience=1.0))

    def run(first, last):
        for k in range(first, last):
            sync.add(at("a", float(k), f"{k:08d}"))
            assert sync.waiting <= MOST_PENDING + 1

    run(0, 2 * REMEMBERED)
    tracemalloc.start()
    run(2 * REMEMBERED, 3 * REMEMBERED)
    before = tracemalloc.get_traced_memory()[0]
    run(3 * REMEMBERED, 4 * REMEMBERED)
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 50_000
    assert OUT_AFTER < MOST_PENDING


def test_blobs_become_detections_and_frames_stay_frames():
    sync = Synchronizer(("a", "b"), Timing())
    sync.add(Exposure("b", 0.0, CameraBlobs.of([[1.0, 2.0], [3.0, 4.0]], 0.2)))
    (snapshot,) = sync.add(Exposure("a", 0.0, CameraBlobs.of([[5.0, 6.0]])))
    found = snapshot.source(("a", "b"))
    assert isinstance(found, Detections)
    assert found.camera.tolist() == [0, 1, 1] and found.sigma.tolist() == [0.1, 0.2, 0.2]
    assert found.uv.tolist() == [[5, 6], [1, 2], [3, 4]]
    assert snapshot.frames(("a", "b")) == {"a": None, "b": None} and snapshot.num_bytes == 0
    frame = np.zeros((2, 3), np.uint8)
    sync.add(Exposure("a", 1.0, frame))
    (snapshot,) = sync.flush()
    assert snapshot.source(("a", "b")) == {"a": frame, "b": None} and snapshot.num_bytes == 6


@pytest.mark.parametrize("values", [{"tolerance": -1.0}, {"patience": float("nan")}, {"patience": 60.0}])
def test_impossible_timings(values):
    with pytest.raises(InputError, match="expected 0 to 5 s"):
        Timing(**values)


@pytest.mark.parametrize("every", [4, 30, 120])
def test_a_camera_that_sends_less_often_is_waited_for_when_it_is_due_and_at_no_other_time(every):
    sync, done, waited = Synchronizer(ABC, Timing(patience=0.1)), [], []
    for k in range(20 * every):
        for camera in "abc" if k % every == 0 else "ab":  # it comes last
            done += sync.add(at(camera, k / 120))
        waited.append(sync.waiting)
    learnt = done[-8 * every :]
    assert cameras(learnt).count("abc") == 8 and sync.counts["late"]["c"] <= LEAST_INTERVALS
    assert np.mean([number > 0 for number in waited[-8 * every :]]) < 0.3
    assert sync.counts["missing"]["c"] < 20 * every / 2


def test_a_clock_that_runs_is_beside_the_others_until_a_whole_frame_has_passed():
    sync, done = Synchronizer(ABC, Timing()), []
    for k in range(600):
        for camera in ABC:
            done += sync.add(at(camera, k / 30 * (1 + 1.5e-3 * (camera == "b"))))
    lone = [snapshot.time for snapshot in done if cameras([snapshot]) == ["b"]]
    assert len(lone) <= 32 and max(lone) < 5 and sync.counts["out_of_tolerance"]["b"] > 300


def test_cameras_whose_stamps_go_with_no_other_are_named():
    sync, done = Synchronizer(ABC, Timing()), []
    for k in range(200):
        for camera in ABC:
            done += sync.add(at(camera, k / 30 + (0.012 if camera == "b" and 50 <= k < 150 else 0.0)))
        if k < 79 or 90 < k < 150 or k > 155:
            assert sync.alone == (("b",) if 90 < k < 150 else ())
    found = cameras(done)
    assert 29 <= found.count("b") <= 30 and found.count("b") + sync.counts["out_of_tolerance"]["b"] == 100
    assert found.count("ac") == 100 and found[-40:] == ["abc"] * 40


@pytest.mark.parametrize(
    "stamp, said",
    [
        (lambda k: k / 20, ""),
        (lambda k: 1.79e9, "a, b, c: most time stamps repeat an earlier one: give each exposure its own"),
        (lambda k: k // 20, "a, b, c: most time stamps repeat an earlier one: give each exposure its own"),
        (lambda k: 50.0 * k, "time stamps go on much faster than time passes: give them in seconds"),
        (lambda k: 8.3 * k, "time stamps go on much faster than time passes: give them in seconds"),
        (lambda k: k / 2, ""),  # a recording that is replayed ten times as fast
        (lambda k: k / 20 + 100.0 * (k > 40), ""),
    ],
)
def test_time_stamps_that_do_not_advance_or_are_not_in_seconds_are_named(stamp, said):
    sync = Synchronizer(ABC, Timing())
    for k in range(100):
        for camera in ABC:
            sync.add(at(camera, float(stamp(k))), now=7.0 + k / 120)
    assert sync.advice == said


@pytest.mark.parametrize("off, said", [(-5.0, "5 s behind"), (-0.4, "0.35 s behind"), (3600.0, "3600 s ahead")])
def test_a_camera_whose_exposures_cannot_be_used_is_named(off, said):
    sync, found = Synchronizer(ABC, Timing()), set()
    for k in range(200):
        for camera in ABC:
            sync.add(at(camera, 1.7e9 + k / 20 + off * (camera == "b" and 50 <= k < 150)), now=k / 20)
        found.add(sync.advice)
        assert (sync.advice == "") == (not 79 <= k < 150), k
    assert f"left out: time stamps of b {said}: set the clock, or wait longer (--patience)" in found


def test_exposures_that_are_sent_twice_are_no_fault_of_the_time_stamps():
    sync = Synchronizer(ABC, Timing())
    for k in range(100):
        for camera in "aabbcc":
            sync.add(at(camera, k / 20))
    assert sync.advice == ""


def test_a_camera_that_sends_more_often_than_others_is_not_beside_them():
    sync = Synchronizer(ABC, Timing())
    for k in range(1200):
        for camera in ABC if k % 120 == 0 else "a":
            sync.add(at(camera, k / 120))
        assert sync.alone == ()


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("rate", [20, 60, 150, 240, 300, 500, 1000])  # Hz
def test_nothing_is_lost_or_mixed_at_any_frame_rate(rate, live):
    draw, sync, done = random.Random(rate), Synchronizer(ABC, Timing()), []
    jitter = min(0.001, 0.1 / rate)  # s
    for k in range(300):
        for camera in draw.sample(ABC, 3):
            time = 1000 + k / rate + draw.uniform(-jitter, jitter)
            done += sync.add(at(camera, time), now=50 + k / rate + draw.uniform(0, 0.002) if live else 0.0)
    done += sync.flush()
    assert cameras(done) == ["abc"] * 300
    assert all(sum(sync.counts[kind].values()) == 0 for kind in ("missing", "late", "duplicate"))


def test_a_frame_that_is_missing_at_a_high_rate_is_not_replaced_by_the_next_one():
    sync, done, sent = Synchronizer(ABC, Timing()), [], 0
    for k in range(400):
        missing = {"b": k % 2 == 1, "c": k % 7 == 6}
        for camera in ABC:
            if missing.get(camera):
                continue
            sent += 1
            done += sync.add(at(camera, k / 240))
    done += sync.flush()
    moments = [{round(e.time * 240) for e in s.exposures.values()} for s in done]
    assert moments == [{k} for k in range(400)] and sum(len(s.exposures) for s in done) == sent


def test_a_slow_camera_joins_only_the_frames_of_a_fast_one_at_its_own_moment():
    sync, done = Synchronizer(ABC, Timing()), []
    for k in range(480):
        for camera in "cab" if k % 4 == 0 else "a":  # b and c at 60 Hz
            done += sync.add(at(camera, k / 240))
    done += sync.flush()
    assert cameras(done) == ["abc", "a", "a", "a"] * 120


def test_a_camera_whose_stamps_come_in_bursts_or_twice_leaves_the_others_together():
    sync, done = Synchronizer(ABC, Timing()), []
    for k in range(300):
        for camera in "ab":
            done += sync.add(at(camera, k / 60 + 0.003 * (camera == "b")))
            sync.add(at(camera, k / 60 + 0.003 * (camera == "b")))  # the network repeats it
        if k % 5 == 4:
            for late in range(5):
                done += sync.add(at("c", k / 60 + 0.008 + 0.0002 * late))
    done += sync.flush()
    assert sum("ab" in found for found in cameras(done)) == 300

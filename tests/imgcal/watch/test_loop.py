import errno
import json
import os
import shutil
import threading
import time
from types import SimpleNamespace

import pytest

from imgcal.online import RigKeeper
from imgcal.watch import CameraBlobs, Exposure, Hook, Poses, PoseSink, Progress, SourceReader, TimedSnapshot, Watch
from imgcal.watch import loop as module
from imgcal.watch.learning import Outcome
from tests.imgcal.watch.states import OBJECT, RIG, KeeperOfStates, event

NOTHING = CameraBlobs.of([])


def snapshot(time, name=None, lag=0.0):
    given = {camera: Exposure(camera, time + lag * (camera == "cam02"), NOTHING, name) for camera in RIG.camera_names}
    return TimedSnapshot(time, given, name)


class Snapshots:
    """A source of snapshots, at times that are given."""

    live = False

    def __init__(self, *times):
        self._times = times

    def items(self):
        for seconds in self._times:
            yield from snapshot(seconds).exposures.values()


class PageOfLists:
    def __init__(self):
        self.published, self.told, self.asked = [], [], []

    def publish(self, state, frames):
        self.published.append((state.snapshot, set(frames)))

    def tell(self, event):
        self.told.append(event)

    def commands(self):
        asked, self.asked = self.asked, []
        return [SimpleNamespace(name=name, camera=None, event=None) for name in asked]


def events_of(folder):
    return [json.loads(line)["event"] for line in (folder / "events.jsonl").read_text().split("\n")[:-1]]


def test_events_go_to_all_who_want_to_know_and_rigs_are_kept(tmp_path):
    keeper, page, told = KeeperOfStates(), PageOfLists(), []
    keeper.events = {1: [event(1), event(1, "camera_lost")]}
    with Watch(keeper, tmp_path, page=page, told=told.append) as loop:
        loop.publish_event(event(0, "restart"))
        for number in range(3):
            loop.process(snapshot(1.7e9 + number))
    assert events_of(tmp_path) == ["restart", "moved", "camera_lost"] == [e.kind for e in told]
    assert [e.kind for e in page.told] == ["restart"]
    assert page.published == [(n, set(RIG.camera_names)) for n in range(3)]
    assert [path.name for path in tmp_path.glob("history/*/*")] == ["221321.000.yaml"]
    assert (tmp_path / "rig.yaml").is_file() and json.loads((tmp_path / "state.json").read_text())["number"] == 3


def test_the_state_is_saved_once_a_second_with_how_far_the_source_is(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "SAVED_EVERY", 0.05)
    keeper = KeeperOfStates()

    class Slow(Snapshots):
        live = True

        def items(self):
            for item in super().items():
                time.sleep(0.01)
                yield item

    with Watch(keeper, tmp_path) as loop, SourceReader(Slow(*(k / 10 for k in range(10))), RIG) as intake:
        loop.run(intake, threading.Event())
    assert 3 <= len(keeper.saves) <= 10 and keeper.saves[-1] == 10
    assert Progress.load(tmp_path) == Progress(0.9, logged=(tmp_path / "events.jsonl").stat().st_size, snapshot=9)


def test_the_first_snapshot_is_saved_at_once(tmp_path):
    keeper = KeeperOfStates()
    with Watch(keeper, tmp_path) as loop, SourceReader(Snapshots(0.0, 0.1, 0.2), RIG) as intake:
        loop.run(intake, threading.Event())
        assert keeper.saves == [1]


def test_a_start_goes_on_after_the_last_snapshot_that_the_state_knows(tmp_path):
    keeper, saved = KeeperOfStates(), []
    with Watch(keeper, tmp_path, saved=saved.append) as loop:
        for number in range(2):
            loop.process(snapshot(float(number), str(number)))
        loop.save()
    assert Progress.load(tmp_path) == Progress(1.0, "1", logged=0, snapshot=1) == saved[-1]
    keeper.disk_full = True  # as where the process is killed before the state is written
    with Watch(keeper, tmp_path, saved=saved.append) as loop:
        loop.process(snapshot(2.0, "2"))
    assert Progress.load(tmp_path) == Progress(1.0, "1", logged=0, snapshot=1) == saved[-1]
    assert json.loads((tmp_path / "state.json").read_text())["number"] == 2


def test_nothing_is_written_where_nothing_is_known(tmp_path):
    with Watch(KeeperOfStates(), tmp_path) as loop:
        loop.save()
    assert [path.name for path in tmp_path.iterdir()] == ["events.jsonl"] and Progress.load(tmp_path) is None


def test_input_that_cannot_be_used_does_not_end_it(tmp_path):
    told = []
    with Watch(KeeperOfStates(fails=[0, 2]), tmp_path, problem=told.append) as loop:
        assert [loop.process(snapshot(float(k))) is None for k in range(4)] == [True, False, True, False]
    assert loop.tally.unusable == 2 and loop.tally.learnt == 2 and told == ["frames of two rigs"]


def test_what_cannot_be_written_is_counted_said_once_and_written_later(tmp_path):
    told = []
    (tmp_path / "state.json").mkdir()
    with Watch(KeeperOfStates(), tmp_path, problem=told.append) as loop:
        for number in range(3):
            loop.process(snapshot(float(number)))
            loop.save()
            time.sleep(0.2)
        loop.save()
        assert loop.tally.problems["state.json"] >= 2 and len(told) == 1 and "state.json" in told[0]
        shutil.rmtree(tmp_path / "state.json")
    assert json.loads((tmp_path / "state.json").read_text())["number"] == 3


def test_people_pause_go_on_and_accept_the_rig(tmp_path):
    keeper, page = KeeperOfStates(), PageOfLists()
    with Watch(keeper, tmp_path, page=page) as loop:
        for asked in ([], ["pause"], [], ["resume", "factory", "acknowledge"]):
            page.asked = list(asked)
            with SourceReader(Snapshots(float(len(keeper.sources))), RIG) as intake:
                loop.run(intake, threading.Event())
    assert len(keeper.sources) == 2 and loop.tally.paused == 2
    assert events_of(tmp_path) == ["factory"] == [e.kind for e in page.told]


def test_no_rig_is_accepted_before_there_is_a_snapshot(tmp_path):
    page, told = PageOfLists(), []
    page.asked = ["factory"]
    with RigKeeper(RIG, OBJECT) as keeper, Watch(keeper, tmp_path, page=page, problem=told.append) as loop:
        loop._apply_commands()
    assert events_of(tmp_path) == [] and len(told) == 1 and "no snapshot has come yet" in told[0]


def test_a_hook_that_fails_is_told_once(tmp_path):
    keeper, told, hook = KeeperOfStates(), [], Hook("false")
    keeper.events = {0: [event(0)], 1: [event(1)], 2: [event(2)]}
    with (
        Watch(keeper, tmp_path, hook, problem=told.append) as loop,
        SourceReader(Snapshots(0.0, 1.0, 2.0), RIG) as intake,
    ):
        loop.run(intake, threading.Event())
    assert hook.failed == 3 and told == ["--hook: false ended with exit code 1"]


def test_events_that_could_not_be_written_are_written_later_and_the_file_is_named(tmp_path, monkeypatch):
    keeper, told = KeeperOfStates(), []
    keeper.events = {0: [event(0)], 1: [event(1)]}
    with Watch(keeper, tmp_path, problem=told.append) as loop:
        with monkeypatch.context() as full:

            def refuse(*_):
                raise OSError(errno.ENOSPC, "No space left on device")

            full.setattr(os, "write", refuse)
            for number in range(2):
                loop.process(snapshot(float(number)))
        assert events_of(tmp_path) == [] and loop.tally.problems["events.jsonl"] == 2
        assert [line for line in told if "events" in line] == [f"{tmp_path / 'events.jsonl'}: No space left on device"]
        loop.save()
    assert events_of(tmp_path) == ["moved", "moved"]


def test_it_stops_when_told(tmp_path):
    stopped = threading.Event()

    class Endless(Snapshots):
        def items(self):
            k = 0
            while True:
                k += 1
                yield from snapshot(float(k)).exposures.values()

    keeper = KeeperOfStates()
    with Watch(keeper, tmp_path) as loop, SourceReader(Endless(), RIG) as intake:
        loop.run(intake, stopped, lambda: stopped.set() if len(keeper.sources) == 5 else None)
    assert len(keeper.sources) == 5 == keeper.saves[-1]


def test_time_stamps_of_cameras_are_compared_with_their_snapshots(tmp_path):
    with Watch(KeeperOfStates(), tmp_path) as loop:
        for number in range(300):
            loop.process(snapshot(float(number), lag=0.004))
    assert loop.tally.stamps == pytest.approx({"cam01": 0, "cam02": 0.004, "cam03": 0, "cam04": 0})


def test_poses_go_out_and_an_output_that_fails_is_told_once(tmp_path):
    class Broken(PoseSink):
        def send(self, record):
            raise OSError(f"no space for {record.snapshot}")

        def close(self):
            pass

    class Listed(Broken):
        def __init__(self):
            self.records = []

        def send(self, record):
            self.records.append((record.snapshot, record.status))

    told, good = [], Listed()
    with Poses("broken", Broken()) as broken, Poses("good", good) as fine:
        outputs = broken, fine
        with Watch(KeeperOfStates(), tmp_path, problem=told.append, poses=outputs) as loop:
            for number in range(3):
                loop.process(snapshot(number / 10))
            while broken.problem is None:
                time.sleep(0.01)
    assert good.records == [(number, "ok") for number in range(3)]
    assert told == ["broken: cannot be written: no space for 0"] and broken.lost == 3


class LearningOfLists:
    def __init__(self, *outcomes):
        self.offered, self._outcomes = [], list(outcomes)

    def offer(self, state, frames):
        self.offered.append((state.snapshot, set(frames)))

    def outcomes(self):
        found, self._outcomes = self._outcomes, []
        return found


def test_an_adapted_network_is_switched_in_and_what_came_of_a_training_is_an_event(tmp_path):
    keeper, page, told, used = KeeperOfStates(), PageOfLists(), [], []
    keeper.use_proposer = used.append
    learning = LearningOfLists(Outcome("no better and is dropped"), Outcome("runs", adopted=True, proposer="new"))
    with (
        Watch(keeper, tmp_path, page=page, told=told.append, learning=learning) as loop,
        SourceReader(Snapshots(1.0, 2.0), RIG) as intake,
    ):
        loop.run(intake, threading.Event())
    assert used == ["new"] and [offered[0] for offered in learning.offered] == [0, 1]
    assert [(e.kind, e.message) for e in told] == [("network", "no better and is dropped"), ("network", "runs")]
    assert page.told == told and events_of(tmp_path) == ["network", "network"]

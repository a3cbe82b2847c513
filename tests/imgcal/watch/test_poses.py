import json
import threading
import time
from dataclasses import replace

import pytest
import torch

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.online import ObjectPose
from imgcal.watch import PoseRecord, Poses, PoseSink
from imgcal.watch import poses as module
from imgcal.watch.poses import COLUMNS, UnwrittenError
from tests.imgcal.watch.states import some_state

TURN = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)


def record(number=0, status="ok", message="all 4 cameras are calibrated"):
    """Half a millimetre more a snapshot."""
    place = RigidTransform(rotation_from_vector(TURN), torch.tensor([1.0 + number / 2, 2.0, 1500.0]).double())
    covariance = torch.diag(torch.tensor([1e-6] * 3 + [0.01] * 3, dtype=torch.float64))
    pose = None if status == "no_object" else ObjectPose(place, covariance, 8, 4)
    return PoseRecord(1.7e9 + number / 60, number, pose, status, message)


class Sink(PoseSink):
    def __init__(self, fails=(), waits=None):
        self.records, self.closed, self.fails, self.waits = [], False, fails, waits

    def send(self, given):
        if self.waits is not None:
            self.waits.wait()
        if len(self.records) in self.fails:
            self.fails = ()
            raise OSError("no space left")
        self.records.append(given)

    def close(self):
        self.closed = True


def test_a_record_says_where_the_object_is_and_how_the_rig_is():
    state = some_state()
    found = PoseRecord.of(state)
    assert (found.status, found.pose.markers, found.pose.cameras) == ("ok", 8, 4)
    degraded = PoseRecord.of(replace(state, cameras={**state.cameras, "cam01": "lost"}))
    assert (degraded.status, degraded.pose.cameras, degraded.not_ok) == ("degraded", 3, 1)
    refused = PoseRecord.of(replace(state, rig_from_object=None, refused="nothing is seen"))
    assert (refused.status, refused.pose, refused.message) == ("no_object", None, "nothing is seen")


def test_lines_and_rows_say_the_same():
    entry, row = json.loads(record(3).to_json()), dict(zip(COLUMNS, record(3).to_row().split(","), strict=True))
    assert entry["time"] == float(row["time"]) == 1.7e9 + 3 / 60 and entry["snapshot"] == int(row["snapshot"]) == 3
    matrix = torch.tensor(entry["rig_from_object"], dtype=torch.float64)
    turn = torch.tensor([float(row[f"r{axis}_rad"]) for axis in "xyz"], dtype=torch.float64)
    assert torch.allclose(rotation_from_vector(turn), matrix[:3, :3], atol=1e-8)
    assert [float(row[f"t{axis}_mm"]) for axis in "xyz"] == matrix[:3, 3].tolist() == [2.5, 2.0, 1500.0]
    assert float(row["cov_44"]) == entry["covariance"][4][4] == 0.01 and entry["markers"] == int(row["markers"]) == 8
    nothing = dict(zip(COLUMNS, record(3, "no_object").to_row().split(","), strict=True))
    assert (nothing["status"], nothing["markers"], nothing["tx_mm"], nothing["cov_55"]) == ("no_object", "0", "", "")
    assert json.loads(record(3, "no_object").to_json())["rig_from_object"] is None


def test_what_a_sink_cannot_take_is_counted_and_the_next_pose_is_sent():
    sink = Sink(fails=[1])
    with Poses("poses.csv", sink) as poses:
        for number in range(4):
            poses.publish(replace(some_state(), snapshot=number))
    assert [one.snapshot for one in sink.records] == [0, 2, 3] and sink.closed
    assert (poses.failed, poses.dropped, poses.problem) == (1, 0, "poses.csv: cannot be written: no space left")


def test_poses_that_a_sink_held_and_lost_are_counted():
    class Holding(Sink):
        def send(self, given):
            raise UnwrittenError("no space left", 3)

        def close(self):
            raise UnwrittenError("no space left", 2)

    with Poses("trial.trc", Holding()) as poses:
        poses.publish(some_state())
    assert (poses.failed, poses.problem) == (5, "trial.trc: cannot be written: no space left")


def test_a_sink_that_hangs_holds_up_nobody():
    go_on = threading.Event()
    sink, state = Sink(waits=go_on), some_state()
    with Poses("slow", sink, most_waiting=3, end=0.1) as poses:
        for number in range(50):
            poses.publish(replace(state, snapshot=number))
    assert poses.lost >= 49 and poses.problem == "slow: poses were dropped: more than 3 were waiting"
    go_on.set()


def test_a_recording_waits_for_a_slow_sink():
    class Slow(Sink):
        def send(self, given):
            time.sleep(0.005)
            super().send(given)

    sink, state = Slow(), some_state()
    with Poses("poses.csv", sink, most_waiting=3, end=0.05) as poses:
        for number in range(40):
            poses.publish(replace(state, snapshot=number), wait=True)
    assert [one.snapshot for one in sink.records] == list(range(40)) and sink.closed
    assert poses.lost == 0 and poses.problem is None


def test_a_recording_does_not_wait_for_ever(monkeypatch):
    monkeypatch.setattr(module, "LONGEST_WAIT", 0.1)
    go_on = threading.Event()
    sink, state = Sink(waits=go_on), some_state()
    with Poses("hangs", sink, most_waiting=3, end=0.1) as poses:
        for number in range(500):  # it waits once, and not for every snapshot
            poses.publish(replace(state, snapshot=number), wait=True)
    assert poses.lost >= 499 and poses.problem == "hangs: poses were dropped: more than 3 were waiting"
    go_on.set()


@pytest.mark.parametrize(("status", "said"), [("ok", "+-0.17 mm, 0.099 deg"), ("no_object", "no pose")])
def test_how_surely_a_pose_is_known_is_said_for_people(status, said):
    assert record(0, status).accuracy() == said

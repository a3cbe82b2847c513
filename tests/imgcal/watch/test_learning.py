import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.detection import DetectionOptions
from imgcal.watch import learning as module
from imgcal.watch.learning import SUBJECTS, Learning, LearningPlan, LearningTask, Moment, Outcome, Spread, receive, send
from tests.imgcal.watch.states import OBJECT, RIG, some_state

FRAMES = {name: np.full((1088, 2048), 10, dtype=np.uint8) for name in RIG.camera_names}
ECHO = """
import os
from imgcal.watch import Outcome, receive, send
source, answers = os.fdopen(0, "rb", buffering=0), os.fdopen(1, "wb", buffering=0)
receive(source)
send(answers, None)
try:
    while True:
        moment = receive(source)
        send(answers, 1)
        cameras = [name for name, frame in moment.frames.items() if frame is not None]
        blobs = sorted(set(moment.blobs.camera.tolist()))
        send(answers, Outcome(f"{moment.number} {moment.held_out} {' '.join(cameras)} {blobs}"))
        send(answers, None)
except EOFError:
    pass
"""


def task(folder, **plan):
    return LearningTask(folder, OBJECT, DetectionOptions(), LearningPlan(**plan), SUBJECTS)


def outcomes(learning, count=1, patience=150.0):
    """Wait for so many outcomes, and until the process is ready again."""
    found, until = [], time.monotonic() + patience
    while time.monotonic() < until and (len(found) < count or learning._busy):
        found += learning.outcomes()
        time.sleep(0.01)
    assert len(found) == count
    return [outcome.message for outcome in found]


def wait(learning):
    until = time.monotonic() + 150
    while learning._busy and time.monotonic() < until:
        time.sleep(0.01)


@pytest.fixture(autouse=True)
def hurry(monkeypatch):
    """A busy machine would not let a process of low priority begin."""
    monkeypatch.setattr(module, "LOWEST", 0)


@pytest.fixture(scope="module")
def state():
    return some_state(time=3.0)


def moved(state, far):
    pose = state.rig_from_object
    return replace(state, rig_from_object=replace(pose, translation=pose.translation + torch.tensor([far, 0.0, 0.0])))


def test_a_held_out_stretch_never_touches_one_to_train_on():
    plan = LearningPlan()
    times = np.arange(0.0, 300.0, 0.1)
    parts = [plan.is_held_out(float(t)) for t in times]
    train, held_out = (times[[part is kind for part in parts]] for kind in (False, True))
    assert np.abs(train[:, None] - held_out).min() >= plan.gap - 1e-6
    assert 0.15 < len(held_out) / len(times) <= 0.2 and len(train) / len(times) > 0.7


def test_the_kept_snapshots_are_spread_and_bounded():
    spread, random = Spread(20, least=0.5), np.random.default_rng(1)
    crowded = np.concatenate((random.normal(0, 0.3, (300, 3)), random.uniform(-5, 5, (60, 3))))
    kept = set()
    for number, place in enumerate(crowded):
        added, displaced = spread.add(number, place)
        kept |= {number} if added else set()
        kept -= {displaced}
    places = crowded[sorted(kept)]
    apart = np.linalg.norm(places[:, None] - places, axis=-1)[np.triu_indices(len(places), 1)]
    assert len(kept) == len(spread) == 20 and apart.min() > 1.5
    assert min(kept) > 280  # at most a few of the crowd


def test_a_message_comes_out_of_a_pipe_as_it_went_in(state):
    moment = Moment(3, True, FRAMES | {"cam01": None}, state.detections, state.rig, state.rig_from_object, 1)
    reading, writing = (os.fdopen(end, mode, buffering=0) for end, mode in zip(os.pipe(), ("rb", "wb"), strict=True))
    with reading, writing:
        thread = threading.Thread(target=send, args=(writing, moment))
        thread.start()
        found = receive(reading)
        thread.join()
        writing.close()
        with pytest.raises(EOFError):
            receive(reading)
    assert (found.number, found.held_out, found.displaced, found.frames["cam01"]) == (3, True, 1, None)
    assert (found.frames["cam02"] == FRAMES["cam02"]).all() and (found.blobs.uv == state.detections.uv).all()
    assert torch.equal(found.rig.focal_length, state.rig.focal_length)


def test_snapshots_are_chosen_by_time_pose_and_health_of_cameras(state, tmp_path):
    with Learning(task(tmp_path), ECHO) as learning:
        wait(learning)
        learning.offer(replace(state, refused="no object"), FRAMES)
        learning.offer(replace(state, time=39.5), FRAMES)  # beside a held-out stretch
        learning.offer(state, FRAMES)
        assert outcomes(learning) == ["0 False cam01 cam02 cam03 cam04 [0, 1, 2, 3]"]
        learning.offer(replace(moved(state, 50.0), time=3.5), FRAMES)  # too soon
        learning.offer(replace(moved(state, 0.5), time=9.0), FRAMES)  # too near
        learning.offer(replace(moved(state, 0.5), time=44.0), FRAMES)  # too near one to train on
        assert not learning._busy
        lag = np.zeros_like(state.lag)
        lag[state.detections.camera == 1] = 0.8
        health = dict(state.cameras) | {"cam01": "lost", "cam03": "dirty"}
        learning.offer(replace(moved(state, 50.0), time=44.0, lag=lag, cameras=health), FRAMES)
        assert outcomes(learning) == ["1 True cam03 cam04 [2, 3]"]
        assert learning.summary == "learning: 2 snapshots, 2 trainings, 0 adopted"
    assert not list(tmp_path.iterdir())


def test_nothing_is_offered_while_a_process_of_low_priority_works(state, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "LOWEST", 19)
    with Learning(task(tmp_path), "import time; time.sleep(60)") as learning:
        learning.offer(state, FRAMES)
        assert len(learning._train) == 0
        # Priorities are compared within a session only.
        process = learning.process_id
        assert (os.getpriority(os.PRIO_PROCESS, process), os.getsid(process)) == (19, os.getsid(0))
        learning._process.kill()


def test_a_process_that_ends_is_reported_once_and_the_loop_goes_on(state, tmp_path):
    with Learning(task(tmp_path), "raise SystemExit(1)") as learning:
        until = time.monotonic() + 30
        while not (found := learning.outcomes()) and time.monotonic() < until:
            time.sleep(0.01)
        learning.offer(state, FRAMES)
        assert found == [Outcome("learning has ended: its process ended unexpectedly", failed=True)]
        assert learning.outcomes() == []


def test_a_process_that_does_not_end_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "LONGEST_END", 0.2)
    with Learning(task(tmp_path), "import time; time.sleep(600)") as learning:
        process = learning._process
    assert process.returncode is not None

"""`imgcal watch --learn` on real frames, each with noise of its own: wrong labels, and light that goes down."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import imgcal
from imgcal.cli import learning_process as module
from imgcal.cli.learning_process import Learner
from imgcal.detection import DetectionOptions
from imgcal.pipeline import load_proposer
from imgcal.watch import SUBJECTS, LearningPlan, LearningTask, Moment
from scripts.results.degraded_captures import task

LIGHT = (0.5, 0.5, 0.5, 0.5, 0.1, 0.1)  # of the original frames, by moment


@pytest.fixture(scope="module")
def cavity(captures):
    return task("cavity", captures)


@pytest.fixture(scope="module")
def moments(cavity):
    found = imgcal.calibrate(cavity.frames, cavity.rig, cavity.obj)
    labels, pose = found.labelled.detections, found.estimate.rig_from_object[0]
    made = []
    for number, light in enumerate(LIGHT):
        frames = {name: shown[0] for name, shown in cavity.degraded("dark", light, number).items()}
        made.append(Moment(number, True, frames, labels, found.rig, pose, None))
    return made


@pytest.fixture
def learner(cavity, tmp_path):
    """One that begins no training."""
    task = LearningTask(tmp_path, cavity.obj, DetectionOptions(), LearningPlan(least_frames=10**6), SUBJECTS)
    return Learner(task, [].append, threading.Event())


def exchange_labels(moment, share):
    """Give the markers of a share of the labelled blobs to each other."""
    fiducial = moment.blobs.fiducial.copy()
    rows = np.random.default_rng(moment.number).permutation(np.flatnonzero(fiducial >= 0))
    some = rows[: round(share * len(rows))]
    fiducial[some] = np.roll(fiducial[some], 1)
    return replace(moment, blobs=replace(moment.blobs, fiducial=fiducial))


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_a_snapshot_with_many_wrong_labels_is_not_learnt(share, learner, moments):
    learner.take(moments[0])
    assert list(learner._crops) == list(learner._held_out) == [0]
    wrong = replace(exchange_labels(moments[1], share), displaced=0)
    learner.take(wrong)
    assert not learner._crops and not learner._held_out


def test_a_network_that_is_worse_in_the_light_of_today_is_dropped(learner, moments, monkeypatch):
    """It is better in the light that most snapshots were kept in, and better on average."""
    shipped, proposals = load_proposer(), {}
    dim = np.mean([moment.frames["cam3"].mean() for moment in moments])

    def scores(bright_share, dim_share):
        def propose(snapshot):
            frame = snapshot.frames["cam3"]
            key = frame.tobytes()
            if key not in proposals:
                proposals[key] = shipped.propose(snapshot)
            found = proposals[key]
            share = dim_share if frame.mean() < dim else bright_share
            kept = np.random.default_rng(0).random(len(found.detections)) < share
            return replace(found, detections=found.detections.select(kept))

        return learner._scores(SimpleNamespace(propose=propose))

    for moment in moments:
        learner.take(moment)
    before, after = scores(0.6, 0.6), scores(1.0, 0.5)
    assert not after.is_better(before)
    assert scores(1.0, 0.6).is_better(before)
    monkeypatch.setattr(module, "LATEST", 1)  # without the rule
    assert after.is_better(before)

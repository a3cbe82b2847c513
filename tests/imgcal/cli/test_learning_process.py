import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from imgcal.association import Proposal, proposal_rows
from imgcal.cli import learning_process as module
from imgcal.cli.learning_process import Learner, Scores, ask
from imgcal.cli.main import main
from imgcal.detection import DetectionOptions
from imgcal.io import data_path, load_object, model_file, read_rig, save_detections
from imgcal.networks import load_infrared, load_measurer
from imgcal.pipeline import load_proposer
from imgcal.pipeline.learned_proposer import LearnedProposer
from imgcal.synthesis import (
    Difficulty,
    FrameModel,
    PhysicalDrift,
    simulate_frames,
    simulate_shots,
    simulate_truth,
    true_detections,
)
from imgcal.training import load_patches, load_splits
from imgcal.watch import SUBJECTS, LearningPlan, LearningTask, Moment, Outcome, adapted_networks

OBJECT = load_object("asymmetric8")
PLAN = LearningPlan(least_frames=8, least_held_out=3)


@pytest.fixture(scope="module")
def moments():
    """Two snapshots to train on, and three that are held out."""
    rig, generator = read_rig("T4").resized(torch.tensor([512, 272])), torch.Generator().manual_seed(4)
    truth = simulate_truth(rig, OBJECT, 5, generator, PhysicalDrift())
    blobs, frames = true_detections(truth), simulate_frames(truth, OBJECT, FrameModel(), generator)
    return [
        Moment(number, number > 1, shown, blobs.of_snapshots(number, number + 1), truth.rig, pose, None)
        for number, (shown, pose) in enumerate(zip(frames, truth.rig_from_object, strict=True))
    ]


@pytest.fixture(scope="module")
def ruined(tmp_path_factory):
    """A network that finds nothing."""
    network = load_infrared(model_file("ir-cnn"))
    with torch.no_grad():
        for weights in network.network.parameters():
            weights.zero_()
    path = tmp_path_factory.mktemp("ruined") / "model.safetensors"
    network.save(path)
    return str(path)


def learner(folder, monkeypatch, *, running, trained, ended=None):
    """Learns from moments; a training gives these networks."""
    said, asked = [], []

    def train_in(out, experiment, should_stop):
        asked.append((Path(out).name, experiment.frames, experiment.training.threads, experiment.training.device))
        Path(out).mkdir(parents=True)
        shutil.copy(model_file(trained[asked[-1][0]]), Path(out) / "model.safetensors")
        return SimpleNamespace(seconds=1.0)

    monkeypatch.setattr(module, "train_in", train_in)
    monkeypatch.setattr(module, "is_finished", lambda run, seconds: True)
    task = LearningTask(folder, OBJECT, DetectionOptions(), PLAN, running)
    return Learner(task, said.append, ended or threading.Event()), said, asked


def test_a_better_network_is_published_with_its_card(moments, ruined, tmp_path, monkeypatch):
    running = (ruined, "measurer-cnn")
    found, said, asked = learner(tmp_path, monkeypatch, running=running, trained={name: name for name in SUBJECTS})
    for moment in moments:
        found.take(moment)
    *taken, outcome = said
    assert taken == [1] * 5 and outcome.adopted and "runs from now on: right 100.0 %" in outcome.message
    dataset = tmp_path / "learning" / "dataset"
    assert asked == [(name, str(dataset), 1, "cpu") for name in SUBJECTS]
    networks = adapted_networks(tmp_path)
    assert networks == tuple(str(tmp_path / "learning" / "adapted" / name) for name in SUBJECTS)
    assert load_proposer(*networks).network.config == load_proposer().network.config
    card = (tmp_path / "learning" / "adapted" / "README.md").read_text()
    assert "| before | 0.0 | 0.0 | 0.00 | 0 of 3 |" in card
    assert re.search(r"\| adapted \| 100.0 \| 0.0 \| 0.[012]. \| 3 of 3 \|", card)
    assert sorted(path.name for path in (tmp_path / "learning").iterdir()) == ["adapted", "dataset"]
    # It is what the next candidate is compared with.
    found._adapt()
    assert not said[-1].adopted and "no better and is dropped" in said[-1].message


def test_a_worse_network_is_dropped(moments, ruined, tmp_path, monkeypatch):
    trained = {"ir-cnn": ruined, "measurer-cnn": "measurer-cnn"}
    found, said, _ = learner(tmp_path, monkeypatch, running=SUBJECTS, trained=trained)
    for moment in moments:
        found.take(moment)
    assert not said[-1].adopted and "no better and is dropped: right 0.0 %" in said[-1].message
    assert adapted_networks(tmp_path) is None
    assert [path.name for path in (tmp_path / "learning").iterdir()] == ["dataset"]


def test_the_next_training_waits_for_half_as_many_snapshots_more(moments, tmp_path, monkeypatch):
    found, _, _ = learner(tmp_path, monkeypatch, running=SUBJECTS, trained={})
    begun = []
    monkeypatch.setattr(found, "_adapt", lambda: begun.append(found._taken))
    for moment in (*moments[2:], *moments[:2]):
        found.take(moment)
    for number in range(5, 12):  # each in the place of the one before: as where as many are kept as may be
        found.take(replace(moments[0], number=number, displaced=1 if number == 5 else number - 1))
    assert begun == [2, 3, 5, 8] and len(found._crops) == 5


def test_the_dataset_is_that_of_harvest_and_keeps_the_parts_apart(moments, tmp_path, monkeypatch):
    found, _, _ = learner(tmp_path, monkeypatch, running=SUBJECTS, trained={name: name for name in SUBJECTS})
    monkeypatch.setattr(found, "_has_enough", lambda: False)
    found.write()
    assert not list(tmp_path.iterdir())  # nothing yet
    for moment in moments[:4]:
        found.take(moment)
    found.take(replace(moments[4], displaced=3))
    found.write()
    folder = tmp_path / "learning" / "dataset"
    for train, held_out in (load_splits(folder), load_patches(folder)):
        assert (set(train.snapshot.tolist()), set(held_out.snapshot.tolist())) == ({0, 1}, {2, 4})
    assert "Made by `imgcal watch --learn`" in (folder / "README.md").read_text()


def test_a_training_that_nobody_waits_for_leaves_nothing(moments, tmp_path, monkeypatch):
    ended = threading.Event()
    found, said, _ = learner(tmp_path, monkeypatch, running=SUBJECTS, trained=dict.fromkeys(SUBJECTS), ended=ended)

    def train_in(out, experiment, should_stop):
        Path(out).mkdir(parents=True)
        ended.set()
        return SimpleNamespace(seconds=1.0) if should_stop() else None

    monkeypatch.setattr(module, "train_in", train_in)
    monkeypatch.setattr(module, "is_finished", lambda run, seconds: False)
    with pytest.raises(module._EndedError):
        for moment in moments:
            found.take(moment)
    assert not any(isinstance(each, Outcome) for each in said)
    assert [path.name for path in (tmp_path / "learning").iterdir()] == ["dataset"]


def test_a_training_that_fails_is_reported(moments, tmp_path, monkeypatch):
    found, said, _ = learner(tmp_path, monkeypatch, running=SUBJECTS, trained={name: name for name in SUBJECTS})
    (tmp_path / "learning").mkdir()
    (tmp_path / "learning" / "candidate").mkdir()
    monkeypatch.setattr(module, "adaptation", lambda name, folder: ["training.steps=-1"])
    for moment in moments:
        found.take(moment)
    assert said[-1].failed and said[-1].message.startswith("the network was not adapted: ")
    assert not (tmp_path / "learning" / "candidate").exists()


def test_a_gain_must_be_larger_than_its_uncertainty():
    def scores(*right, claimed=8, off=0.2, decided=True):
        each = (8, right, claimed, np.array(right) * off**2, decided)
        return Scores(*(np.broadcast_to(value, len(right)) for value in each))

    assert scores(8, 8, 8, 8).is_better(scores(7, 6, 7, 7))
    assert not scores(8, 5, 8, 6).is_better(scores(7, 6, 7, 6))  # better on average
    assert not scores(8, 8, 8, 8).is_better(scores(8, 8, 8, 8))
    assert not scores(8, 8, 8, 8, decided=False).is_better(scores(7, 6, 7, 7))
    assert scores(6, 6, claimed=6).is_better(scores(6, 6, claimed=8))  # fewer wrong claims
    assert not scores(8, 8, off=2.0).is_better(scores(6, 6, off=1.0))  # a measurer that learnt wrong places
    assert scores(8, 8, off=1.1).is_better(scores(6, 6, off=1.0))
    assert scores(8, 8, off=3.0).is_better(scores(0, 0, claimed=0))
    # As right, and nearer to the markers.
    assert scores(8, 8, 8, 8, off=0.2).is_better(scores(8, 8, 8, 8, off=2.0))
    assert scores(8, 8, 8, 8, off=0.2).is_better(scores(8, 8, 7, 8, off=2.0))
    assert not scores(8, 8, 8, 8, off=0.9).is_better(scores(8, 8, 8, 8, off=1.0))
    assert not scores(8, 8, 8, 8, off=0.05).is_better(scores(8, 8, 8, 8, off=0.2))  # both are exact
    assert not scores(7, 7, 7, 7, off=0.2).is_better(scores(8, 8, 8, 8, off=2.0))
    assert not scores(8, 8, 8, 8, off=0.2, decided=False).is_better(scores(8, 8, 8, 8, off=2.0))
    once = scores(8, 8, 8, 8, off=np.array((2.0, 2.0, 2.0, 3.5)))
    assert not scores(8, 8, 8, 8, off=np.array((2.0, 2.1, 1.9, 0.5))).is_better(once)  # in one snapshot only
    # The light has changed: better before, worse now.
    assert not scores(8, 8, 8, 8, 8, 6).is_better(scores(5, 6, 5, 6, 8, 8))
    assert scores(8, 8, 8, 8, 7, 8).is_better(scores(5, 6, 5, 6, 7, 8))


def test_snapshots_with_wrong_labels_teach_nothing_and_judge_nothing(moments, tmp_path, monkeypatch):
    found, said, _ = learner(tmp_path, monkeypatch, running=SUBJECTS, trained={})
    random = np.random.default_rng(0)
    for moment in moments:
        fiducial = random.permutation(OBJECT.num_fiducials)[moment.blobs.fiducial]
        found.take(replace(moment, blobs=replace(moment.blobs, fiducial=fiducial)))
    assert said == [] and not found._crops and not found._held_out


def test_networks_are_asked_from_the_same_pose_nearby(moments, ruined):
    task = LearningTask(Path("out"), OBJECT, DetectionOptions(), PLAN, SUBJECTS)
    first, again = (module._believe(moments[2].rig_from_object, moments[2], task) for _ in range(2))
    assert torch.equal(first.rotation, again.rotation) and torch.equal(first.translation, again.translation)
    middle = OBJECT.points.mean(0, keepdim=True).double()
    off = (first.apply(middle) - moments[2].rig_from_object.apply(middle)).norm()
    far = (moments[2].rig.positions - moments[2].rig_from_object.apply(middle)).norm(dim=-1).mean()
    assert float(off / far) == pytest.approx(0.01, abs=1e-6)
    *counts, squared, decided = ask(load_proposer(), moments[2], task)
    assert counts == [32, 32, 32] and decided and 0 < squared < 32 * 0.3**2
    assert ask(load_proposer(ruined), moments[2], task) == (32, 0, 0, 0.0, False)


def test_claims_of_markers_that_nobody_can_see_gain_nothing():
    rig, generator = read_rig("T4").resized(torch.tensor([512, 272])), torch.Generator().manual_seed(4)
    truth = simulate_truth(rig, OBJECT, 4, generator, PhysicalDrift())
    shots = list(simulate_shots(truth, OBJECT, FrameModel(difficulty=Difficulty(hidden=0.4)), generator))
    task = LearningTask(Path("out"), OBJECT, DetectionOptions(), PLAN, SUBJECTS)
    blobs, rows = true_detections(truth), {"honest": [], "boastful": []}
    for number, (shot, pose) in enumerate(zip(shots, truth.rig_from_object, strict=True)):
        seen = (shot.seen > 0).numpy()
        found = blobs.of_snapshots(number, number + 1)
        found = found.select(seen[found.camera, found.fiducial])
        moment = Moment(number, True, shot.frames, found, truth.rig, pose, None)
        for name, claimed in (("honest", seen), ("boastful", np.ones_like(seen))):
            size, radius = np.full(seen.shape, 0.2), np.full(seen.shape, 5.0)
            claims = proposal_rows(truth.uv[number].numpy(), size, claimed, radius, found)
            proposer = SimpleNamespace(propose=lambda _, claims=claims, pose=pose: Proposal(claims, pose, 1e3))
            rows[name].append(ask(proposer, moment, task))
        assert rows["honest"][-1][:3] == (seen.sum(),) * 3 and seen.sum() < seen.size
    honest, boastful = (Scores(*(np.array(column) for column in zip(*each, strict=True))) for each in rows.values())
    assert not boastful.is_better(honest) and boastful.shares() == honest.shares() == (100.0, 0.0)


def test_a_network_whose_encoder_is_shuffled_is_dropped(moments, ruined, tmp_path, monkeypatch):
    def load(network, measurer):
        proposer = load_proposer(network, measurer)
        if network != "ir-cnn":  # the adapted one
            search = proposer.network.search
            monkeypatch.setattr(proposer.network, "search", lambda maps, *more: search(maps.roll(1, 0), *more))
        return proposer

    trained = {name: name for name in SUBJECTS}
    found, said, _ = learner(tmp_path, monkeypatch, running=SUBJECTS, trained=trained)
    monkeypatch.setattr(module, "load_proposer", load)
    for moment in moments:
        found.take(moment)
    right, before = (
        float(share) for share in re.findall(r"right ([0-9.]+) %.*?before: ([0-9.]+)", said[-1].message)[0]
    )
    assert not said[-1].adopted and "no better and is dropped" in said[-1].message and right < 80 < before
    assert adapted_networks(tmp_path) is None


def test_labels_that_do_not_fit_the_rig_are_not_learnt(moments, tmp_path, monkeypatch):
    found, said, asked = learner(tmp_path, monkeypatch, running=SUBJECTS, trained={name: name for name in SUBJECTS})
    for moment in moments:
        order = np.random.default_rng(moment.number).permutation(8)
        wrong = replace(moment.blobs, fiducial=order[moment.blobs.fiducial])
        found.take(replace(moment, blobs=wrong))
    assert not said and not asked and not list(tmp_path.iterdir())


DYING = """
import os, pickle, signal, sys, time
from imgcal.watch import Learning, learning
learning.LOWEST = 0  # a busy machine would not let it begin
moments, task = pickle.loads(sys.stdin.buffer.read())
with Learning(task, "from imgcal.cli.learning_process import main; main()") as process:
    for moment in moments:
        while process._busy:
            time.sleep(0.05)
        process._waiting, process._busy = moment, True
        with process._changed:
            process._changed.notify()
    folder = task.folder / "learning" / "candidate" / "ir-cnn" / "resolved.yaml"
    while not folder.exists():
        time.sleep(0.05)
    print(process.process_id, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_watch_leaves_no_process_and_no_half_file(moments, tmp_path):
    plan = replace(PLAN, changes=("training.steps=100000",))
    task = LearningTask(tmp_path, OBJECT, DetectionOptions(), plan, SUBJECTS)
    done = subprocess.run(
        [sys.executable, "-c", DYING], input=pickle.dumps((moments, task)), capture_output=True, timeout=500,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
    )  # fmt: skip
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    process, until = int(done.stdout), time.monotonic() + 120
    while _runs(process) and time.monotonic() < until:
        time.sleep(0.1)
    assert not _runs(process)
    assert [path.name for path in (tmp_path / "learning").iterdir()] == ["dataset"]
    assert not list(tmp_path.rglob(".*"))
    load_splits(tmp_path / "learning" / "dataset")


def _runs(process):
    """Whether a process does: one that has ended and waits to be collected does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def watch(workplace, out, *more):
    given = ["watch", str(workplace.capture), "--rig", str(workplace.capture / "truth" / "rig.yaml")]
    given += ["--object", str(workplace.object), "--out", str(out), "--until-idle", "0.5"]
    return main([*given, *more])


def test_frames_are_learnt_from_only_when_asked(workplace, tmp_path, capsys):
    for path in (workplace.capture / "frames").glob("*/*"):
        os.utime(path, (1e9 + 2 * int(path.stem),) * 2)  # 1e9 is at the beginning of a stretch to train on
    assert watch(workplace, tmp_path / "plain", "--detector", "learned") == 0
    assert "learning" not in capsys.readouterr().out
    assert not (tmp_path / "plain" / "learning").exists()
    assert watch(workplace, tmp_path / "out", "--detector", "learned", "--learn") == 0
    said = capsys.readouterr().out
    assert f"learning from the frames of this rig: {tmp_path}/out/learning" in said
    assert "| learning: " in said and " 0 trainings, 0 adopted" in said


def test_adapted_networks_run_again_after_a_restart(workplace, tmp_path, monkeypatch, capsys):
    made = tmp_path / "out" / "learning" / "adapted"
    for name in SUBJECTS:
        (made / name).mkdir(parents=True)
        shutil.copy(data_path("models", f"{name}.safetensors"), made / name / "model.safetensors")
    (made / "README.md").write_text("card")
    used = []
    monkeypatch.setattr("imgcal.online.RigKeeper.use_proposer", lambda self, proposer: used.append(proposer.name))
    assert watch(workplace, tmp_path / "out", "--detector", "learned", "--learn") == 0
    assert used == ["learned"]
    assert watch(workplace, tmp_path / "out", "--detector", "learned", "--learn", "--fresh") == 0
    (kept,) = made.parent.glob("adapted-*")
    assert used == ["learned"] and (kept / "README.md").is_file()
    assert watch(workplace, tmp_path / "out", "--detector", "learned", "--learn") == 0
    assert used == ["learned"] and not made.exists()  # those of the run that was reset


def test_what_cannot_learn_is_one_line(workplace, moments, tmp_path, capsys):
    out = tmp_path / "out"
    assert watch(workplace, out, "--learn") == 2
    said = "--learn: found --detector classical, expected --detector learned: it adapts the network that this runs"
    assert capsys.readouterr().err == f"imgcal: {said}\n"
    given = ["--rig", "T4", "--out", str(out), "--detector", "learned", "--learn"]
    assert main(["watch", str(workplace.capture), *given, "--object", "lights"]) == 2
    assert "--learn: found lights, expected one object" in capsys.readouterr().err
    save_detections(moments[0].blobs, tmp_path / "blobs.csv")
    assert main(["watch", str(tmp_path / "blobs.csv"), *given, "--object", "asymmetric8"]) == 2
    assert "--learn: found blobs without frames (" in capsys.readouterr().err
    assert not out.exists() or not list(out.iterdir())


def test_a_network_of_your_own_runs_with_its_own_measurer(workplace, tmp_path, monkeypatch, capsys):
    own = tmp_path / "measurer"
    own.mkdir()
    measurer = load_measurer(model_file("measurer-cnn"))
    with torch.no_grad():
        next(measurer.network.parameters()).mul_(0.99)
    measurer.save(own / "model.safetensors")
    expected = load_measurer(own / "model.safetensors").network.state_dict()
    asked = []
    propose = LearnedProposer.propose
    monkeypatch.setattr(
        LearnedProposer, "propose", lambda self, snapshot: asked.append(self) or propose(self, snapshot)
    )
    networks = ["--detector", str(model_file("ir-cnn")), "--measurer", str(own)]
    assert watch(workplace, tmp_path / "out", *networks) == 0
    assert asked and all(torch.equal(each, expected[name]) for name, each in asked[0].measurer.state_dict().items())
    capsys.readouterr()
    for detector in ("classical", "auto", "both"):
        assert watch(workplace, tmp_path / "out", "--detector", detector, "--measurer", str(own)) == 2
        said = f"--measurer: found --detector {detector}, expected --detector learned or a network of your own"
        assert capsys.readouterr().err == f"imgcal: {said}\n"
    assert watch(workplace, tmp_path / "out", "--detector", "learned", "--measurer", "measurer-vitt") == 2
    assert "measurer: found 'measurer-vitt'" in capsys.readouterr().err
    assert watch(workplace, tmp_path / "out", "--detector", "learned", "--learn", "--measurer", str(own)) == 2
    assert "--learn: found --measurer " in capsys.readouterr().err

"""Trainings in processes of their own: one that is killed, and one that consists of two."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import torch

from imgcal.cli.training_folder import RESULT, STATE
from imgcal.io import read_metrics, read_tensors, read_texts
from tests.imgcal.training.toy import EXPERIMENT, train

ROOT = Path(__file__).parents[3]
TOY = "tests.imgcal.training.toy"
KILLED = """
import os, signal, sys
from imgcal.cli.main import main
from imgcal.cli.training_folder import STATE
from imgcal.networks import factory
from tests.imgcal.training.toy import Toy
factory.build = Toy
replace, saved = os.replace, []
def die(source, target):  # when the fourth state is written beside the third, whose place it has not taken yet
    saved.append(target)
    if [os.path.basename(each) for each in saved].count(STATE) == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)
os.replace = die
main(sys.argv[1:])
"""


def environment(**more):
    return {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
        "PYTHONPATH": str(ROOT),
        **more,
    }


def weights(folder):
    return read_tensors(folder / RESULT, "imgcal-network/1")[0]


def state_step(folder):
    return json.loads(read_texts(folder / STATE, "imgcal-training/1")["values"])["step"]


def test_killed_and_resumed_is_bit_for_bit_uninterrupted(experiment, tmp_path):
    steps, save_every = 60, 10
    changes = [f"training.steps={steps}", f"training.save_every={save_every}"]
    torch.set_num_threads(1)
    train(experiment(*changes), tmp_path / "whole")
    arguments = ["train", str(tmp_path / "toy.yaml"), "--out", str(tmp_path / "killed"), "--set", *changes]
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, *arguments], env=environment(), cwd=ROOT, capture_output=True, timeout=120
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert state_step(tmp_path / "killed") == 3 * save_every
    resumed = train(experiment(*changes), tmp_path / "killed", resume=True)
    assert resumed.step == steps
    whole, killed = weights(tmp_path / "whole"), weights(tmp_path / "killed")
    assert whole.keys() == killed.keys()
    assert all(torch.equal(whole[name], killed[name]) for name in whole)


def launch(folder, *arguments):
    """Train the toy with two processes of torchrun; return what they print."""
    (folder / "toy.yaml").write_text(EXPERIMENT)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", TOY]
    command = [*launcher, "train", str(folder / "toy.yaml"), *map(str, arguments)]
    run = subprocess.run(command, env=environment(), cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stderr


def test_two_processes_of_torchrun_share_a_batch_and_resume(tmp_path):
    changes = ["schedule.kind=constant", "training.device=auto", "training.accumulate=2", "training.patience=9"]
    said = launch(tmp_path, "--out", tmp_path / "whole", "--set", *changes)
    assert said.count("2 x cpu") == said.count("60 steps") == 1  # only the main process speaks
    rows = read_metrics(tmp_path / "whole" / "metrics.jsonl")
    losses = [row["loss"] for row in rows if "loss" in row]
    assert len(losses) == 6 and losses[-1] < losses[0]
    state, _ = read_tensors(tmp_path / "whole" / STATE, "imgcal-training/1")
    assert state["random/data"].shape[0] == 2
    assert not torch.equal(*state["random/data"])  # each process draws its own rigs
    assert state_step(tmp_path / "whole-20") == 20
    launch(tmp_path, "--out", tmp_path / "whole-20", "--resume", "--set", *changes)
    whole, parts = weights(tmp_path / "whole"), weights(tmp_path / "whole-20")
    assert all(torch.equal(whole[name], parts[name]) for name in whole)

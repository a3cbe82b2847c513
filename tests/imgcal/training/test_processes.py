"""Trainings in processes of their own: one that is killed, and one that consists of two."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch

from imgcal.cli.training_folder import RESULT, STATE
from imgcal.io import read_metrics, read_tensors, read_texts
from tests.imgcal.training.toy import EXPERIMENT, train

ROOT = Path(__file__).parents[3]
TOY = "tests.imgcal.training.toy"


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
    steps, save_every = 400, 10
    changes = [f"training.steps={steps}", f"training.save_every={save_every}"]
    torch.set_num_threads(1)
    train(experiment(*changes), tmp_path / "whole")
    file = tmp_path / "toy.yaml"
    command = [sys.executable, "-m", TOY, "train", str(file), "--out", str(tmp_path / "killed"), "--set", *changes]
    process = subprocess.Popen(command, env=environment(), cwd=ROOT, stderr=subprocess.PIPE)
    state = tmp_path / "killed" / STATE
    while process.poll() is None and not (state.exists() and state_step(tmp_path / "killed") >= 3 * save_every):
        time.sleep(0.002)
    process.kill()
    _, errors = process.communicate()
    assert process.returncode == -signal.SIGKILL, errors.decode()
    assert 3 * save_every <= state_step(tmp_path / "killed") < steps
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
    launch(tmp_path, "--out", tmp_path / "parts", "--set", *changes, "training.steps=30")
    launch(tmp_path, "--out", tmp_path / "parts", "--resume", "--set", *changes)
    whole, parts = weights(tmp_path / "whole"), weights(tmp_path / "parts")
    assert all(torch.equal(whole[name], parts[name]) for name in whole)

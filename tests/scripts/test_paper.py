"""The paper's own networks are trained in chunks, at full size and at sizes for a CPU; here at toy size."""

import os
import subprocess
from pathlib import Path

import pytest

from imgcal.errors import InputError
from imgcal.io import model_file, read_metrics
from imgcal.networks import load_checkpoint
from scripts.results import paper

SCRIPTS = Path(__file__).parents[2] / "scripts" / "results"
TOY = ["table1-row08-paper", "ablation-row6", "--size", "toy", "--seeds", "2"]


def test_every_row_of_the_paper_has_a_size_for_everybody():
    assert len(paper.ROWS) == 13 + 6
    for row in paper.ROWS:
        full, reduced = (paper.sized(row, paper.Options(size=size), seed=2) for size in ("full", "reduced"))
        assert full.training.seed == reduced.training.seed == 2
        assert full.training.compile and full.training.precision == "bf16"
        assert full.training.steps >= 150_000 and full.loss.paper.reprojection_from == 10_000
        assert reduced.name == f"{row}-reduced" and reduced.rig == full.rig and reduced.drift == full.drift
        assert reduced.loss.kind == full.loss.kind == "paper" and reduced.paper == full.paper
        assert reduced.loss.paper.lambda_scale == full.loss.paper.lambda_scale
    assert not paper.sized("ablation-row3", paper.Options(), 1).network.change["camera_identity"]
    assert paper.sized("table1-row13-paper", paper.Options(size="full"), 1).training.channels_last


def test_chunks_train_what_is_not_done(tmp_path, capsys):
    runs = ["--runs", str(tmp_path / "runs")]
    paper.main([*TOY, *runs, "--minutes", "0"])
    assert capsys.readouterr().err.count("not done: ") == 4 and not (tmp_path / "runs").exists()
    paper.main([*TOY, *runs])
    assert "not done" not in capsys.readouterr().err
    folders = sorted(folder.name for folder in (tmp_path / "runs").iterdir())
    assert folders == [f"{row}-toy-seed{seed}" for row in ("ablation-row6", "table1-row08-paper") for seed in (1, 2)]
    first = tmp_path / "runs" / folders[0]
    assert read_metrics(first / "metrics.jsonl")[-1]["step"] == 4
    assert load_checkpoint(model_file(first)).experiment.name == "ablation-row6-toy"
    before = (first / "model.safetensors").stat().st_mtime_ns
    paper.main([*TOY, *runs])
    assert (first / "model.safetensors").stat().st_mtime_ns == before
    with pytest.raises(InputError, match="found table1-row99, expected some of ablation-row1, "):
        paper.main(["table1-row99"])


def test_a_chunk_that_ends_goes_on_in_the_next(tmp_path, monkeypatch):
    options = paper.Options(rows=("table1-row08-paper",), size="toy", runs=tmp_path / "runs", minutes=1.0)
    times = iter([0.0, 0.0, 1.0, 2.0, *[61.0] * 20])
    monkeypatch.setattr(paper, "monotonic", lambda: next(times))
    assert paper.train(options) == ["table1-row08-paper-toy-seed1"]
    monkeypatch.setattr(paper, "monotonic", lambda: 0.0)
    assert paper.train(options) == []
    steps = [row["step"] for row in read_metrics(tmp_path / "runs" / "table1-row08-paper-toy-seed1" / "metrics.jsonl")]
    assert steps[-1] == 4


@pytest.mark.parametrize("name", ["gpu", "train"])
def test_the_commands_are_bash_that_can_be_read(name):
    path = SCRIPTS / name
    assert os.access(path, os.X_OK)
    assert subprocess.run(["bash", "-n", str(path)], capture_output=True).returncode == 0

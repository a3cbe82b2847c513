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
    assert capsys.readouterr().err.count("unfinished: ") == 4 and not (tmp_path / "runs").exists()
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


@pytest.fixture
def told(tmp_path):
    """Run a script whose Python only says what it is asked, and makes folders of runs; returns what it said."""
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python"
    python.write_text('#!/bin/bash\necho "$@"\n[[ $* =~ --out\\ ([^ ]*) ]] && mkdir -p "${BASH_REMATCH[1]}" || true\n')
    python.chmod(0o755)
    environment = {**os.environ, "IMGCAL_VENV": str(tmp_path), "IMGCAL_EXTRAS": "none"}
    stamp = subprocess.run(["sha256sum", "pyproject.toml"], cwd=SCRIPTS.parents[1], capture_output=True, check=True)
    (tmp_path / "imgcal-none.sha256").write_bytes(stamp.stdout)

    def run(name, *arguments):
        made = subprocess.run([SCRIPTS / name, *arguments], env=environment, capture_output=True, text=True)
        assert made.returncode in (0, 2), made.stderr
        return made.stdout.splitlines() if made.returncode == 0 else made.stderr

    return run


def test_what_is_named_is_trained_after_all_that_it_starts_from(told, tmp_path):
    runs = str(tmp_path / "runs")
    lines = told("train", "--seeds", "2", runs, "shipped-vit-cube8", "comparison-vit-pooled")
    names = [line.split()[3] for line in lines]
    chain = ["shipped-points-asymmetric8", "shipped-points-cube8", "positions-vit"]
    assert names == [name for name in [*chain, "shipped-vit-cube8", "comparison-vit-pooled"] for _ in range(2)]
    vit = lines[7]
    assert f"--out {runs}/shipped-vit-cube8-seed2 --set" in vit and "training.seed=2" in vit
    starts = [f"{runs}/{name}-seed2" for name in ("positions-vit", "shipped-points-cube8")]
    assert f"training.init_from=[{','.join(starts)},]" in vit
    assert told("train", "--seeds", "2", runs, "comparison-vit-pooled") == []  # done
    assert "found nothing, expected some of" in told("train", runs, "nothing")


def test_scripts_for_small_and_large(told):
    assert told("train", "--reduced", "--minutes", "3") == [
        "-m scripts.results.paper --size reduced --seeds 3 --minutes 3"
    ]
    assert told("gpu", "ablation-row1") == ["-m scripts.results.paper --size full --minutes 8 ablation-row1"]
    assert told("gpu", "--evaluate", "out/runs")[-1].startswith("-m scripts.results.table out/runs --device ")

"""`imgcal compare --captures`: detectors on simulated captures."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from imgcal.cli.compare import contender
from imgcal.cli.main import main
from imgcal.evaluation import detectors


def test_detectors_are_compared_on_captures(tmp_path, capsys):
    out = tmp_path / "result"
    scene = ["--rig", "T4", "--difficulty", "clean", "--snapshots", "2", "--seed", "3"]
    assert main(["compare", "classical", "--captures", "1", *scene, "--out", str(out)]) == 0
    values = json.loads((out / "captures.json").read_text())
    [outcome] = values["outcomes"]
    assert (values["rig"], values["object"], values["seed"]) == ("T4", "asymmetric8", 3)
    assert (outcome["difficulty"], outcome["capture"], outcome["frames"]) == ("clean", 300_000, 8)
    assert outcome["status"] == "calibrated" and outcome["held_out_px"] < 0.5
    printed = capsys.readouterr().out
    assert "| classical |     – | 100 / 0 / 0 |" in printed and (out / "captures.md").read_text() == printed


def test_captures_that_are_done_are_not_done_again(tmp_path, capsys, monkeypatch):
    out, judged = tmp_path / "result", []
    scene = ["--rig", "T4", "--difficulty", "clean", "--snapshots", "1", "--captures", "2", "--cores", "1"]
    real = detectors.judge

    def judge(*given):
        judged.append(given[-1])
        if len(judged) == 2:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(detectors, "judge", judge)
    assert main(["compare", "classical", *scene, "--out", str(out)]) == 130
    assert main(["compare", "classical", *scene, "--out", str(out)]) == 0
    assert judged == [0, 1, 1]
    assert [one["capture"] for one in json.loads((out / "captures.json").read_text())["outcomes"]] == [0, 1]
    assert not (out / ".work").exists()


def test_sigterm_beside_worker_processes_is_one_line():
    pytest.importorskip("ray", reason="no ray (extra fleet)")
    command = [sys.executable, "-m", "imgcal", "compare", "points-O10-cube8", "vit-O10-cube8", "--cores", "2"]
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr is not None
    started = next(line for line in process.stderr if "for this machine" not in line)
    expected = "evaluating points-O10-cube8, vit-O10-cube8, "
    assert started.startswith(expected) and started.endswith("on 3 trials of 20,000 random rigs (--trials, --count)\n")
    process.send_signal(signal.SIGTERM)
    printed, error = process.communicate(timeout=120)
    said = [line for line in error.splitlines() if "for this machine" not in line]
    assert (process.returncode, printed) == (130, "")
    assert said == ["imgcal: terminated"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--captures", "1", "--difficulty", "cleen"], "--difficulty: found 'cleen', expected some of clean, "),
        (["--captures", "-1"], "--captures: found -1, expected 1 to 100000"),
        (["--captures", "1", "--cores", "0"], "--cores: found 0"),
        (["--captures", "1", "--rig", "none.yaml"], "none.yaml"),
        (
            ["--captures", "1", "--kappa", "0.01"],
            "--kappa: cannot be used with --captures; it is for comparing networks",
        ),
        (["--captures", "1", "--sweep-count", "5"], "--sweep-count: cannot be used with --captures"),
        (["--captures", "1", "--trust", "a:B"], "--trust: cannot be used with --captures"),
        (["--captures", "1", "--baselines"], "--baselines: cannot be used with --captures"),
        (
            ["matched", "--difficulty", "clean"],
            "--difficulty: cannot be used without --captures; it is for comparing detectors",
        ),
        (["matched", "--snapshots", "2"], "--snapshots: cannot be used without --captures"),
        (["matched"], "found classical, which is a detector, expected networks; detectors are compared on captured"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(arguments, expected, capsys):
    assert main(["compare", "classical", *arguments]) == 2
    error = capsys.readouterr().err
    assert expected in error and len(error.splitlines()) == 1


def test_an_unknown_detector_is_said_before_any_capture_is_made(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(detectors, "draw_capture", None)
    (tmp_path / "damaged.safetensors").write_bytes(b"nothing")
    cases = {
        "nosuch": "detector: found 'nosuch', expected classical, ",
        str(tmp_path / "damaged.safetensors"): "damaged",
    }
    for named, expected in cases.items():
        assert (
            main(["compare", "classical", named, "--captures", "1", "--cores", "1", "--out", str(tmp_path / "o")]) == 2
        )
        error = capsys.readouterr().err
        assert expected in error and len(error.splitlines()) == 1
    assert not (tmp_path / "o").exists()


def test_runs_that_differ_in_the_seed_have_one_name(tmp_path):
    assert contender(Path("matched")).name == contender(Path("matched")).detector == "matched"
    assert contender(Path("matched")).seed is None and contender(Path("learned")).seed == 0  # the shipped one: one seed
    for run in ("ir-cnn-seed0", "ir-cnn-seed12"):
        (tmp_path / run).mkdir()
        (tmp_path / run / "model.safetensors").touch()
    first, second = (contender(tmp_path / run) for run in ("ir-cnn-seed0", "ir-cnn-seed12"))
    assert (first.name, first.seed, second.name, second.seed) == ("ir-cnn", 0, "ir-cnn", 12)
    file = contender(tmp_path / "ir-cnn-seed0" / "model.safetensors")
    assert (file.name, file.seed) == ("ir-cnn", 0)

import json
import math
import signal
import subprocess
import sys

import pytest
import torch

from imgcal.cli.main import main
from imgcal.evaluation import QUICK_BASELINES
from imgcal.fleet import StoredResults
from imgcal.io import load_object, read_rig
from imgcal.networks import Checkpoint, build_network, save_checkpoint
from imgcal.training import load_experiment
from tests.imgcal.cli.calibrating import one_line
from tests.imgcal.fleet.conftest import engine  # noqa: F401  one Ray for the file

pytestmark = pytest.mark.usefixtures("few_timings")

EXPERIMENT = """
format: imgcal-experiment/1
name: tiny
rig: T4
object: asymmetric8
poses: {theta_deg: [0, 0], phi_deg: [0, 0], alpha_deg: [0, 10]}
drift: {kappa_intrinsics: 0.003, kappa_extrinsics: 0.003}
network: {preset: points, change: {trunk: {width: 16, depth: 1, later_depth: 1, heads: 2}}}
training: {steps: 1}
"""
FEW = ("--count", "6", "--trials", "2")


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Two untrained networks, one of them as a training run leaves it."""
    folder = tmp_path_factory.mktemp("models")
    (folder / "tiny.yaml").write_text(EXPERIMENT)
    experiment = load_experiment(folder / "tiny.yaml")
    paths = [folder / "first.safetensors", folder / "second" / "model.safetensors"]
    paths[1].parent.mkdir()
    for seed, path in enumerate(paths):
        subject = (read_rig("T4"), load_object("asymmetric8"))
        network = build_network(experiment, *subject, torch.Generator().manual_seed(seed))
        save_checkpoint(path, Checkpoint(network, *subject, experiment, {}))
    (paths[1].parent / "metrics.jsonl").write_text('{"step": 1, "re_px": 5.0}\n{"step": 2, "validation_re_px": 4.0}\n')
    return [paths[0], paths[1].parent]


def test_evaluate_takes_rig_object_poses_and_drift_from_the_model(models, tmp_path, capsys):
    out = tmp_path / "result"
    assert main(["evaluate", str(models[0]), *FEW, "--no-baselines", "--out", str(out)]) == 0
    values = json.loads((out / "evaluation.json").read_text())
    assert (values["rig"], values["object"], values["count"], values["trials"]) == ("T4", "asymmetric8", 6, 2)
    assert values["poses_deg"] == {"theta": [0, 0], "phi": [0, 0], "alpha": [0, pytest.approx(10)]}
    assert values["drift"] == {"kind": "relative", "kappa_intrinsics": 0.003, "kappa_extrinsics": 0.003}
    assert list(values["methods"]) == ["first", *QUICK_BASELINES]
    model = values["methods"]["first"]
    assert model["alone"]["re_px"]["rigs"] == model["refined"]["re_px"]["rigs"] == 12
    assert model["model"]["bytes"] == models[0].stat().st_size
    printed = capsys.readouterr()
    assert "| first " in printed.out
    assert "evaluation.json" in printed.err


def test_what_is_asked_for_goes_before_what_the_model_says(models, tmp_path):
    out = tmp_path / "result"
    wanted = ["--kappa", "0.001", "--phi", "0", "20", "--noise", "0.2", "--missing", "0.1", "--swapped", "0.1"]
    arguments = ["evaluate", str(models[0]), *FEW, *wanted, "--false", "0.05", "--no-baselines", "--out", str(out)]
    assert main([*arguments, "--rig", "T4", "--object", "asymmetric8"]) == 0
    values = json.loads((out / "evaluation.json").read_text())
    assert values["drift"]["kappa_intrinsics"] == 0.001
    assert values["poses_deg"]["phi"] == pytest.approx([0, 20])
    assert values["corruption"] == {"noise": 0.2, "missing": 0.1, "swapped": 0.1, "false": 0.05}
    assert values["reference"]["cramer_rao_ratio"]["re"] is not None


def test_baselines_alone_need_rig_and_object(capsys):
    few = ["--count", "2", "--trials", "1"]
    assert main(["evaluate", "--rig", "T4", "--object", "asymmetric8", "--phi", "0", "30", *few]) == 0
    assert "scipy bundle adjustment" in capsys.readouterr().out
    assert main(["evaluate", "--rig", "T4", *few]) == 2
    assert "--object" in capsys.readouterr().err
    assert main(["evaluate", "--no-baselines", *few]) == 2
    assert "--object" in capsys.readouterr().err


KILLED = """
import os, signal, sys
from imgcal.cli.main import main
from imgcal.fleet import StoredResults
put, done = StoredResults.put, []
def die(self, item, result):
    put(self, item, result)
    done.append(item)
    if len(done) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
StoredResults.put = die
main(sys.argv[1:])
"""


@pytest.mark.usefixtures("engine")
def test_a_killed_evaluation_goes_on_with_the_same_numbers(models, tmp_path, monkeypatch):
    few = ["evaluate", str(models[0]), "--count", "4", "--trials", "5", "--no-baselines"]
    out = ["--out", str(tmp_path / "killed")]
    killed = subprocess.run([sys.executable, "-c", KILLED, *few, *out, "--cores", "1"], timeout=240)
    assert killed.returncode == -signal.SIGKILL
    kept = list((tmp_path / "killed" / ".work").iterdir())
    assert len(kept) == 2 and not (tmp_path / "killed" / "evaluation.json").exists()
    done, put = [], StoredResults.put
    monkeypatch.setattr(StoredResults, "put", lambda self, item, result: (done.append(item), put(self, item, result)))
    assert main([*few, *out, "--cores", "2"]) == 0
    assert len(done) == 3 and not (tmp_path / "killed" / ".work").exists()
    assert main([*few, "--out", str(tmp_path / "whole"), "--cores", "1"]) == 0
    one, other = (json.loads((tmp_path / name / "evaluation.json").read_text()) for name in ("killed", "whole"))
    # Processes that compile at the same time inline differently, and so round differently.
    for method in one["methods"]:
        for stage in ("alone", "refined"):
            mine, theirs = (numbers(each["methods"][method].get(stage)) for each in (one, other))
            assert mine == pytest.approx(theirs, rel=1e-4, nan_ok=True)
    assert numbers(one["reference"]) == pytest.approx(numbers(other["reference"]), rel=1e-4, nan_ok=True)


def numbers(value):
    """All numbers of a JSON value by their path; None counts as not a number."""
    if isinstance(value, dict | list):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        return {f"{key}.{path}": one for key, part in parts for path, one in numbers(part).items()}
    return {} if isinstance(value, str) else {"": math.nan if value is None else float(value)}


def test_sweeps_are_drawn(models, tmp_path):
    out = tmp_path / "result"
    arguments = ["evaluate", str(models[0]), "--count", "2", "--trials", "1", "--no-baselines", "--out", str(out)]
    assert main([*arguments, "--sweep", "missing", "--sweep-count", "2"]) == 0
    assert (out / "error-missing.png").exists()
    assert list(json.loads((out / "evaluation.json").read_text())["sweeps"]) == ["missing"]


def test_compare_puts_networks_side_by_side(models, tmp_path, capsys):
    out = tmp_path / "comparison"
    assert main(["compare", *map(str, models), *FEW, "--out", str(out)]) == 0
    values = json.loads((out / "evaluation.json").read_text())
    assert list(values["methods"]) == ["first", "second", *QUICK_BASELINES]
    assert values["seeds"] == {}  # of the same experiment and seed
    for name in ("first", "second"):
        row = values["methods"][name]
        assert row["latency_ms"]["refined_p50"] > row["latency_ms"]["alone_p50"] > 0
        assert row["model"]["parameters"] > 0
    assert {"latency.png", "training.png"} <= {path.name for path in out.iterdir()}
    assert "| second " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--rig", "O6"], "O6"),
        (["--object", "cube8"], "cube8"),
        (["--kappa", "3"], "kappa"),
        (["--missing", "2"], "missing"),
        (["--missing", "1"], "missing: found 1, expected a smaller share"),
        (["--count", "0"], "count"),
        (["--cores", "0"], "--cores: found 0"),
        (["--phi", "20", "10"], "--phi"),
        (["--level", "5"], "--level: found 5, expected 0 to 4"),
        (["--level", "1", "--noise", "0.2"], "--level: cannot be used with --noise"),
    ],
)
def test_what_cannot_be_evaluated_is_refused_in_one_line(models, tmp_path, capsys, arguments, expected):
    out = tmp_path / "result"
    assert main(["evaluate", str(models[0]), "--count", "2", "--out", str(out), *arguments]) == 2
    assert expected in one_line(capsys)
    assert not out.exists()


def test_what_cannot_be_compared_is_refused(models, tmp_path, capsys):
    out = ["--out", str(tmp_path / "result"), *FEW]
    assert main(["compare", str(models[0]), *out]) == 2
    assert "two" in capsys.readouterr().err
    assert main(["compare", str(models[0]), str(models[0]), *out]) == 2
    assert "once" in capsys.readouterr().err
    assert main(["compare", str(models[0]), str(tmp_path / "none.safetensors"), *out]) == 2
    assert "none.safetensors" in capsys.readouterr().err

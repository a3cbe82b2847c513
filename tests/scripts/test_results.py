"""The scripts of results run, on next to nothing: an untrained network, a few rigs."""

import json
import math
from importlib import import_module
from pathlib import Path

import pytest
import torch

from imgcal.errors import InputError
from imgcal.networks import Checkpoint, build_network, save_checkpoint
from imgcal.training import changed, load_experiment

FOLDER = Path(__file__).parents[2] / "scripts" / "results"
PAGE = Path(__file__).parents[2] / "docs" / "results.md"
SMALL = "network={preset: points, change: {trunk: {width: 16, heads: 2, depth: 1, later_depth: 1, passes: 2}}}"
# Where an untrained network, which predicts the factory rig and a level object, is nearly right.
LEVEL = "poses={theta_deg: [0, 0], phi_deg: [0, 0], alpha_deg: [269, 271]}"
FEW = ["--count", "5", "--image-count", "3", "--trials", "2", "--extra", "4", "--sweep-count", "2"]


def script(name):
    return import_module(f"scripts.results.{name}")


@pytest.fixture
def trained(tmp_path):
    """Pretend that an experiment was trained; returns its file."""

    def make(name, *changes):
        experiment = changed(load_experiment(name), *changes)
        rig, obj = experiment.load_rig(), experiment.load_object()
        torch.manual_seed(1)
        run = tmp_path / "runs" / name
        run.mkdir(parents=True)
        rows = [{"step": step, "re_px": 90.0 / step, "seconds": 60.0 * step} for step in range(1, 131)]
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        network = build_network(experiment, rig, obj, torch.Generator().manual_seed(0))
        checkpoint = Checkpoint(network, rig, obj, experiment, {"step": 130, "seconds": 7800.0})
        save_checkpoint(run / "model.safetensors", checkpoint)
        return run / "model.safetensors"

    return make


def table_arguments(folder, *more):
    page = folder / "results.md"
    if not page.exists():
        page.write_text(PAGE.read_text("utf-8"), "utf-8")
    folders = ["--models", str(folder / "models"), "--page", str(page), "--results", str(folder / "results")]
    return [str(folder / "runs"), *folders, *FEW, *more]


def test_table_evaluates_what_is_new_and_keeps_the_rest(trained, tmp_path, monkeypatch):
    table = script("table")
    trained("table1-row08", SMALL, LEVEL)
    table.main(table_arguments(tmp_path, "--sweep", "table1-row08"))
    result = json.loads((tmp_path / "results" / "table1-row08.json").read_text())
    exact = result["exact"]
    assert exact["network"]["rigs"] == 2 * 5
    assert exact["network + refinement"]["mean"] < 0.05 < exact["network"]["mean"]
    assert result["noise"]["network + refinement"]["times_cramer_rao"]["re"] < 3
    assert len(result["history"]) <= 60
    assert result["history"][-1] == pytest.approx([130.0, 90.0 / 130], rel=1e-4)
    page = (tmp_path / "results.md").read_text()
    [row] = [line for line in page.splitlines() if line.startswith("| 8 | points, overhead, O6")][:1]
    assert f"{exact['network']['mean']:.3g}" in row and "3.08" in row and " 1 " in row
    assert "| 7 | points, overhead, O6 cube8, kappa 0 / 0 % | 1.12 | 0.2 | not trained yet" in page
    for name in ("training.png", "sweep.png"):
        assert 1000 < (tmp_path / "results" / name).stat().st_size < 60_000

    def never(*arguments):
        raise AssertionError("evaluated again")

    monkeypatch.setattr(table, "measure", never)
    monkeypatch.setattr(table, "swept", never)
    table.main(table_arguments(tmp_path, "--sweep", "table1-row08"))
    assert (tmp_path / "results.md").read_text() == page


def test_table_of_a_shipped_model(trained, tmp_path):
    file = trained("shipped-points-asymmetric8", SMALL, LEVEL)
    (tmp_path / "models").mkdir()
    shipped = tmp_path / "models" / "points-O10-asymmetric8.safetensors"
    file.rename(shipped)
    script("table").main(table_arguments(tmp_path))
    result = json.loads((tmp_path / "results" / "shipped-points-asymmetric8.json").read_text())
    assert result["shipped"] and result["bytes"] == shipped.stat().st_size
    robust = result["robustness"]
    assert robust["network + refinement"]["median"] < robust["factory, pose fitted"]["median"]
    assert result["latency_ms"]["alone_p50"] > 0
    page = (tmp_path / "results.md").read_text()
    assert "| shipped-points-asymmetric8 | 0.0" in page  # parameters, in millions
    assert "| shipped-cnn-cube8 | not trained yet" in page


def test_two_runs_of_one_experiment_are_refused(trained, tmp_path):
    file = trained("table1-row08", SMALL, LEVEL)
    (tmp_path / "runs" / "again").mkdir()
    (tmp_path / "runs" / "again" / "model.safetensors").write_bytes(file.read_bytes())
    with pytest.raises(InputError, match="another run of table1-row08"):
        script("table").main(table_arguments(tmp_path))


def test_page_without_markers_is_refused(tmp_path):
    (tmp_path / "results.md").write_text("# Results\n")
    with pytest.raises(InputError, match="no markers of `table 1`"):
        script("table").main(table_arguments(tmp_path))


def test_committed_page_has_all_markers():
    table = script("table")
    filled = import_module("scripts.output").replaced(PAGE.read_text("utf-8"), table.sections([], {}), PAGE)
    assert "not trained yet" not in filled[filled.index("begin table 1 -->") : filled.index("end table 1 -->")]


def test_runtime(tmp_path):
    arguments = ["--images", "3", "5", "--iterations", "1", "3", "--iteration-images", "3", "--cameras", "2", "5"]
    script("runtime").main([*arguments, "--repeats", "1", "--out", str(tmp_path)])
    result = json.loads((tmp_path / "runtime.json").read_text())
    assert [row["n"] for row in result["ours_cpu"]] == [2, 5]
    assert all(row["rms_px"] < 1 for row in result["opencv_images"])
    assert (tmp_path / "runtime.png").stat().st_size < 60_000


def test_ring_is_the_reference_ring():
    from imgcal.io import load_rig

    made, reference = script("runtime").ring(10), load_rig("O10")
    torch.testing.assert_close(made.positions, reference.positions, atol=1e-3, rtol=0)
    torch.testing.assert_close(made.cam_from_rig.rotation, reference.cam_from_rig.rotation, atol=1e-5, rtol=0)


def test_bundle_adjustment(trained, tmp_path):
    file = trained("table1-row09", SMALL)
    arguments = ["--trials", "4", "--plain-trials", "2", "--model", str(file), "--out", str(tmp_path)]
    script("bundle_adjustment").main(arguments)
    columns = json.loads((tmp_path / "bundle_adjustment.json").read_text())["columns"]
    means = {name: column["mean_px"] for name, column in columns.items()}
    assert means["MAP, 25 iterations"] < means["MAP, 1 iteration"] < means["left alone, true pose"]
    assert means["plain BA, 25 iterations"] < means["plain BA, 1 iteration"] < means["left alone, true pose"]
    assert columns["network + MAP"]["trials"] == 4 and columns["network"]["seconds_p50"] > 0
    assert columns["plain BA, 1 iteration"]["trials"] == 2


def test_plain_bundle_adjustment_starts_at_the_projection_of_the_rig():
    from imgcal.io import load_object, load_rig
    from imgcal.synthesis.rigs import synthesize

    module, obj = script("bundle_adjustment"), load_object("cube8")
    made = synthesize(load_rig("T4"), obj, 1, torch.Generator().manual_seed(2))
    numbers = module.numbers_of(made.rig.from_object(made.rig_from_object)[0])
    torch.testing.assert_close(
        torch.from_numpy(module._projected(numbers, obj.points.numpy())), made.projection.uv[0], atol=1e-6, rtol=0
    )


def test_losses(tmp_path):
    network = "network={preset: paper-points, change: {width: 16, depth: 1, head_widths: [8]}}"
    sets = ["--set", network, "training.batch_size=8", "optimizer={lr: 1.0e-3, ema: null}"]
    script("losses").main(["--minutes", "0.02", *sets, "--every", "5", "--rigs", "6", "--out", str(tmp_path)])
    result = json.loads((tmp_path / "losses.json").read_text())
    assert result["steps"][0] == 0 and all(len(values) == len(result["steps"]) for values in result["losses"].values())
    assert all(math.isfinite(values[-1]) for values in result["losses"].values())
    assert result["truth"]["focal ratio"] > 0
    assert result["losses"]["parameter RMSE"][-1] < result["losses"]["parameter RMSE"][0]


def test_cameras(trained, tmp_path, capsys):
    out = tmp_path / "made" / "cameras.html"
    script("cameras").main(["--count", "2", "--rig", "T4", "--object", "cube8", "--out", str(out)])
    text = out.read_text("utf-8")
    assert "plotly" in text and "first cameras, true" in text
    script("cameras").main(["--model", str(trained("table1-row08", SMALL, LEVEL)), "--refined", "--out", str(out)])
    assert "O6, cube8: table1-row08 + refinement, RE 0.0" in capsys.readouterr().out


def test_scripts_say_what_is_wrong_in_one_line(tmp_path, capsys, monkeypatch):
    output = import_module("scripts.output")

    def fail():
        raise InputError("--count: found 0,\nexpected at least 1")

    with pytest.raises(SystemExit) as stop:
        output.command(fail)
    assert stop.value.code == 2
    assert capsys.readouterr().err == "--count: found 0, expected at least 1\n"
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(InputError, match="no readable JSON"):
        output.read_json(tmp_path / "broken.json")

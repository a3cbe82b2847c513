"""The scripts of results run, on next to nothing: an untrained network, a few rigs."""

import json
import math
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest
import torch

from imgcal.errors import InputError
from imgcal.networks import Checkpoint, build_network, save_checkpoint
from imgcal.training import change_experiment, load_experiment

FOLDER = Path(__file__).parents[2] / "scripts" / "results"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "tables.md"
SMALL = "network={preset: points, change: {trunk: {width: 16, heads: 2, depth: 1, later_depth: 1, passes: 2}}}"
# Where an untrained network, which predicts the factory rig and a level object, is nearly right.
LEVEL = "poses={theta_deg: [0, 0], phi_deg: [0, 0], alpha_deg: [269, 271]}"
FEW = ["--count", "5", "--image-count", "3", "--trials", "2", "--extra", "4", "--sweep-count", "2"]


def script(name):
    return import_module(f"scripts.results.{name}")


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Pretend that an experiment was trained; returns its file."""

    def make(name, *changes, folder=None):
        experiment = change_experiment(load_experiment(name), *changes)
        rig, obj = experiment.load_rig(), experiment.load_object()
        torch.manual_seed(1)
        run = tmp_path / "runs" / (folder or name)
        run.mkdir(parents=True)
        rows = [{"step": step, "re_px": 90.0 / step, "seconds": 60.0 * step} for step in range(1, 131)]
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        network = build_network(experiment, rig, obj, torch.Generator().manual_seed(0))
        checkpoint = Checkpoint(network, rig, obj, experiment, {"step": 130, "seconds": 7800.0})
        save_checkpoint(run / "model.safetensors", checkpoint)
        return run / "model.safetensors"

    measuring = script("measuring")
    monkeypatch.setattr(measuring, "latency", partial(measuring.latency, repeats=2))
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
    result = json.loads((tmp_path / "results" / "table1-row08-seed1.json").read_text())
    exact = result["exact"]
    assert exact["network, one pass"]["rigs"] == exact["network"]["rigs"]
    assert exact["2 LM steps from the factory"]["mean"] < exact["1 LM step from the factory"]["mean"] < 1
    assert exact["network"]["rigs"] == 2 * 5
    assert exact["network + refinement"]["mean"] < 0.05 < exact["network"]["mean"]
    assert result["noise"]["network + refinement"]["times_cramer_rao"]["re"] < 3
    assert len(result["history"]) <= 60
    assert result["history"][-1] == pytest.approx([130.0, 90.0 / 130], rel=1e-4)
    page = (tmp_path / "results.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| 8 | points (trunk")]
    assert f"| 3.08 | **{exact['network, one pass']['mean']:.3g}" in rows[0] and "| one seed |" in rows[0]
    assert f"{exact['network']['mean']:.3g} ±" in rows[0]
    assert "Not trained yet: table1-row01, " in page
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
    result = json.loads((tmp_path / "results" / "shipped-points-asymmetric8-seed1.json").read_text())
    assert result["encoder"] is None and result["seed"] == 1
    assert result["shipped"] and result["bytes"] == shipped.stat().st_size
    robust = result["robustness"]
    assert robust["network + refinement"]["median"] < robust["factory, pose fitted"]["median"]
    assert result["latency_ms"]["alone_p50"] > 0
    page = (tmp_path / "results.md").read_text()
    assert "| shipped-points-asymmetric8 | " in page and f" | {result['parameters'] / 1e6:.2f} M | " in page
    assert "Not trained yet: shipped-cnn-asymmetric8, shipped-cnn-cube8" in page and "one seed, shipped" in page


def test_seeds_of_one_experiment_make_one_line(trained, tmp_path):
    table, pages = script("table"), script("pages")
    trained("table1-row08", SMALL, LEVEL)
    again = trained("table1-row08", SMALL, LEVEL, "training.seed=7", folder="table1-row08-seed7")
    table.main(table_arguments(tmp_path, "--sweep", "none"))
    results = [json.loads((tmp_path / "results" / f"table1-row08-seed{seed}.json").read_text()) for seed in (1, 7)]
    assert "| 2 seeds |" in (tmp_path / "results.md").read_text()
    for result, mean in zip(results, (1.0, 3.0), strict=True):
        result["exact"]["network"]["mean"] = mean
    assert pages.mean(results, "network") == "2 ± 1"
    assert pages.seeds(results) == "2 seeds" and pages.seeds(results[:1]) == "one seed"
    earlier = {key: value for key, value in results[0].items() if key != "seed"}
    assert pages.seeds([earlier]) == "one seed, measured earlier, model not kept"
    used = [result | {"encoder": {"used": result["seed"] == 7, "rise": 4.0}} for result in results]
    assert pages.encoder(used) == "used by 1 of 2" and pages.encoder(used[:1]) == "**not used**"
    again.unlink()


def test_headline_is_made_of_a_shipped_model(trained, tmp_path, monkeypatch):
    places = script("headline").PLACES
    assert [place.paper for place in places[:3]] == [9.93, 11.53, 14.21]
    monkeypatch.setattr(script("headline"), "PLACES", places[:2])
    file = trained("shipped-points-cube8", SMALL, LEVEL)
    (tmp_path / "models").mkdir()
    file.rename(tmp_path / "models" / "points-O10-cube8.safetensors")
    script("table").main(table_arguments(tmp_path, "--sweep", "none"))
    result = json.loads((tmp_path / "results" / "headline.json").read_text())
    assert len(result["places"]) == 2 and result["rigs"] == 3 * 5
    for place in result["places"]:
        columns = place["columns"]
        assert columns["3 LM steps from the factory"]["mean"] < 0.1 < columns["factory, pose by PnP"]["mean"]
    page = (tmp_path / "results.md").read_text()
    assert "| paper's network | 9.93 | 11.53 |" in page and "| network, one pass | " in page
    assert "| rotation, RMS error (deg) | " in page


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
    from imgcal.io import read_rig

    made, reference = script("runtime").ring(10), read_rig("O10")
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
    from imgcal.io import load_object, read_rig
    from imgcal.synthesis import synthesize

    module, obj = script("bundle_adjustment"), load_object("cube8")
    made = synthesize(read_rig("T4"), obj, 1, torch.Generator().manual_seed(2))
    numbers = module.numbers_of(made.rig.from_object(made.rig_from_object)[0])
    torch.testing.assert_close(
        torch.from_numpy(module._projected(numbers, obj.points.numpy())), made.projection.uv[0], atol=1e-6, rtol=0
    )


def test_first_guess(tmp_path, monkeypatch):
    module = script("first_guess")
    for name, values in (("KAPPAS", (0.05,)), ("EXCHANGED", (0.0,)), ("SNAPSHOTS", (4,))):
        monkeypatch.setattr(module, name, values)
    module.main(["--captures", "1", "--out", str(tmp_path / "first_guess.json")])
    [row] = json.loads((tmp_path / "first_guess.json").read_text())["rows"]
    assert row["none"]["calibrated"] == row["guess"]["calibrated"] == row["used"] == row["alike"] == 1
    assert row["guess"]["px"] == pytest.approx(row["none"]["px"], rel=0.01)


def test_detectors_are_tuned_on_other_captures_than_they_are_compared_on(tmp_path, monkeypatch):
    module = script("detectors")
    tried = {"blind to all": (module.DetectionOptions(threshold=60_000), module.BLIND)}
    monkeypatch.setattr(module, "VARIANTS", tried | {"default": module.VARIANTS["default"]})
    few = ["--captures", "1", "--snapshots", "2", "--difficulty", "clean", "--rig", "T4", "--cores", "1"]
    for step in ("tune", "compare"):
        module.main([step, *few, "--results", str(tmp_path)])
    assert json.loads((tmp_path / "detectors-tuning.json").read_text())["chosen"]["clean"]["variant"] == "default"
    place = tmp_path / "detectors.json"
    result = json.loads(place.read_text())
    assert [row["contender"] for row in result["outcomes"]] == ["classical", "classical, tuned"]
    assert {row["status"] for row in result["outcomes"]} == {"calibrated"} and module.TEST != module.VALIDATION
    result["outcomes"][0]["contender"] = "measured before"
    place.write_text(json.dumps(result))
    module.main(["compare", *few, "--results", str(tmp_path)])
    names = [row["contender"] for row in json.loads(place.read_text())["outcomes"]]
    assert names == ["measured before", "classical", "classical, tuned"]


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
    assert "RigView" in text and "2 cam04" in text and "T4, cube8: factory, pose fitted" in text
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


def test_networks_for_other_tasks_are_left_out(trained, tmp_path):
    from imgcal.io import data_path

    trained("table1-row08", SMALL, LEVEL)
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "ir-cnn.safetensors").write_bytes(data_path("models", "ir-cnn.safetensors").read_bytes())
    (tmp_path / "models" / "broken.safetensors").write_text("nothing")
    measuring = script("measuring")
    with pytest.raises(InputError, match=r"broken.safetensors"):
        measuring.find(tmp_path / "runs", tmp_path / "models")
    (tmp_path / "models" / "broken.safetensors").unlink()
    assert [source.experiment for source in measuring.find(tmp_path / "runs", tmp_path / "models")] == ["table1-row08"]

import json
import re
import sys
from dataclasses import replace

import numpy as np

from imgcal.cli.main import main
from imgcal.io import load_detections, read_rig, save_detections, save_rig
from tests.imgcal.lensed import lensed


def score(workplace, source, rig, capsys):
    assert main(["score", str(source), "--rig", str(rig), "--object", str(workplace.object)]) == 0
    return json.loads(capsys.readouterr().out)


def test_truth_scores_zero_and_factory_does_not(workplace, capsys):
    table = workplace.capture / "truth" / "detections.csv"
    perfect = score(workplace, table, workplace.capture / "truth" / "rig.yaml", capsys)
    factory = score(workplace, table, workplace.rig, capsys)
    assert list(perfect) == [
        "median_px", "p95_px", "rms_px", "outliers", "rms_px_with_outliers", "points", "snapshots_used",
        "snapshots_rejected", "per_camera",
    ]  # fmt: skip
    assert perfect["rms_px"] < 1e-6 < 0.1 < factory["rms_px"]
    assert factory["median_px"] <= factory["p95_px"]
    assert perfect["snapshots_used"] == 3 and perfect["snapshots_rejected"] == 0
    assert {camera: values["points"] for camera, values in perfect["per_camera"].items()} == {
        f"cam0{i}": 24 for i in (1, 2, 3, 4)
    }


def test_a_terminal_shows_a_table(workplace, capsys, monkeypatch):
    given = [str(workplace.capture / "truth" / "detections.csv"), "--rig", str(workplace.rig)]
    given += ["--object", str(workplace.object)]
    monkeypatch.setattr(type(sys.stdout), "isatty", lambda stream: True)
    assert main(["score", *given, "--json"]) == 0
    expected = json.loads(capsys.readouterr().out)
    assert main(["score", *given]) == 0
    said = capsys.readouterr().out
    cells = [re.findall(r"[\w.]+", line) for line in said.splitlines()]
    rows = {row[0]: row[1:] for row in cells if len(row) == 5 and re.match("cam0|all", row[0])}
    assert list(rows) == ["cam01", "cam02", "cam03", "cam04", "all"]
    assert rows["all"] == [f"{expected['median_px']:.3g}", f"{expected['rms_px']:.3g}", "96", str(expected["outliers"])]
    assert rows["cam02"][2] == "24" and "3 snapshots used, 0 rejected" in said


def test_a_rig_of_mixed_lenses_is_simulated_scored_and_calibrated(workplace, tmp_path, capsys):
    rig, capture, out = tmp_path / "mixed.yaml", tmp_path / "capture", tmp_path / "out"
    save_rig(lensed(read_rig(workplace.rig), "mixed"), rig)
    known = ["--rig", str(rig), "--object", str(workplace.object)]
    how = ["--snapshots", "4", "--seed", "5", "--kappa", "0.01", "--no-clutter"]
    assert main(["simulate", *known, "--out", str(capture), *how]) == 0
    table = capture / "truth" / "detections.csv"
    capsys.readouterr()
    perfect = score(workplace, table, capture / "truth" / "rig.yaml", capsys)
    assert perfect["rms_px"] < 1e-6 < 0.1 < score(workplace, table, rig, capsys)["rms_px"]
    assert main(["calibrate", str(table), *known, "--out", str(out)]) == 0
    capsys.readouterr()
    assert score(workplace, table, out / "rig.yaml", capsys)["rms_px"] < 0.01
    # Values of a camera have the names that its own lens gives them.
    undetermined = json.loads((out / "result.json").read_text())["knowledge"]["undetermined"]
    lenses = dict(zip(read_rig(rig).camera_names, read_rig(rig).lens_models, strict=True))
    assert all(lenses[camera] == "rational" for name in ("k5", "k6") for camera in undetermined.get(name, ()))
    assert all(lenses[camera] != "equidistant" for name in ("p1", "p2") for camera in undetermined.get(name, ()))
    assert undetermined and not any("/" in name or name == "-" for name in undetermined)
    page = (out / "report.html").read_text()
    assert "cam01 k3: " in page and "cam02 k3: " in page and "cam03 k6: " in page and "of its lens" in page


def test_noise_is_measured_as_opencv_does(workplace, tmp_path, capsys):
    blobs = load_detections(workplace.capture / "truth" / "detections.csv")
    blobs.uv[:] += np.random.default_rng(0).normal(scale=0.2, size=blobs.uv.shape)
    save_detections(blobs, tmp_path / "noisy.csv")
    found = score(workplace, tmp_path / "noisy.csv", workplace.capture / "truth" / "rig.yaml", capsys)
    # RMS length of a 2D residual, less what the three poses took: 96 points, 18 parameters of 192 equations.
    expected = 0.2 * np.sqrt(2 * (192 - 18) / 192)
    assert abs(found["rms_px"] / expected - 1) < 0.15


def test_outliers_are_counted_and_do_not_decide(workplace, tmp_path, capsys):
    truth = load_detections(workplace.capture / "truth" / "detections.csv")
    noise = np.random.default_rng(0).normal(scale=0.02, size=truth.uv.shape)
    hidden = np.arange(len(truth)) % 30 == 0
    blobs = replace(truth, uv=truth.uv + noise + 2.0 * hidden[:, None])
    save_detections(blobs, tmp_path / "hidden.csv")
    found = score(workplace, tmp_path / "hidden.csv", workplace.capture / "truth" / "rig.yaml", capsys)
    assert found["outliers"] == hidden.sum() == sum(camera["outliers"] for camera in found["per_camera"].values())
    assert found["rms_px"] < 0.08 and found["median_px"] < 0.06
    assert found["rms_px_with_outliers"] > 0.3

    off = replace(truth, uv=truth.uv + noise + 5.0 * (truth.camera == 1)[:, None])
    save_detections(off, tmp_path / "off.csv")
    found = score(workplace, tmp_path / "off.csv", workplace.capture / "truth" / "rig.yaml", capsys)
    assert found["outliers"] == 0 and found["rms_px"] > 1  # a camera that is off as a whole is not put aside


def test_frames_are_scored_too(workplace, capsys):
    found = score(workplace, workplace.capture, workplace.capture / "truth" / "rig.yaml", capsys)
    assert found["rms_px"] < 0.05

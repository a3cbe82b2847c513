import json

import numpy as np

from imgcal.cli.main import main
from imgcal.io import load_detections, save_detections


def score(workplace, source, rig, capsys):
    assert main(["score", str(source), "--rig", str(rig), "--object", str(workplace.object)]) == 0
    return json.loads(capsys.readouterr().out)


def test_truth_scores_zero_and_factory_does_not(workplace, capsys):
    table = workplace.capture / "truth" / "detections.csv"
    perfect = score(workplace, table, workplace.capture / "truth" / "rig.yaml", capsys)
    factory = score(workplace, table, workplace.rig, capsys)
    assert set(perfect) == {"rms_px", "median_px", "p95_px", "snapshots_used", "snapshots_rejected", "per_camera"}
    assert perfect["rms_px"] < 1e-6 < 0.1 < factory["rms_px"]
    assert factory["median_px"] <= factory["p95_px"]
    assert perfect["snapshots_used"] == 3 and perfect["snapshots_rejected"] == 0
    assert {camera: values["points"] for camera, values in perfect["per_camera"].items()} == {
        f"cam0{i}": 24 for i in (1, 2, 3, 4)
    }


def test_noise_is_measured_as_opencv_does(workplace, tmp_path, capsys):
    blobs = load_detections(workplace.capture / "truth" / "detections.csv")
    blobs.uv[:] += np.random.default_rng(0).normal(scale=0.2, size=blobs.uv.shape)
    save_detections(blobs, tmp_path / "noisy.csv")
    found = score(workplace, tmp_path / "noisy.csv", workplace.capture / "truth" / "rig.yaml", capsys)
    # RMS length of a 2D residual, less what the three poses took: 96 points, 18 parameters of 192 equations.
    expected = 0.2 * np.sqrt(2 * (192 - 18) / 192)
    assert abs(found["rms_px"] / expected - 1) < 0.15


def test_frames_are_scored_too(workplace, capsys):
    found = score(workplace, workplace.capture, workplace.capture / "truth" / "rig.yaml", capsys)
    assert found["rms_px"] < 0.05

import json

import pytest
import torch

from imgcal.cli.main import main
from imgcal.io import load_object, load_rig_covariance, read_rig, save_cameras, save_detections
from imgcal.synthesis import PhysicalDrift, arrange_rig, simulate_volume, true_detections
from tests.imgcal.cli.calibrating import one_line


@pytest.fixture(scope="module")
def wand_capture(tmp_path_factory):
    """Labelled blobs of a wand in a small room, and a file of cameras of which little is known."""
    folder = tmp_path_factory.mktemp("wand")
    rig = arrange_rig("ring", 3, 2500.0, height=1200.0, target=(0.0, 0.0, 700.0))
    truth = simulate_volume(rig, load_object("wand4"), 40, torch.Generator().manual_seed(0), PhysicalDrift())
    save_detections(true_detections(truth), folder / "blobs.csv")
    save_cameras(dict.fromkeys(rig.camera_names, (1280, 1024)), 60.0, folder / "cameras.yaml")
    return folder


def test_without_a_factory_calibration(wand_capture, tmp_path, capsys):
    arguments = ["calibrate", str(wand_capture / "blobs.csv"), "--object", "wand4", "--out", str(tmp_path / "out")]
    assert main([*arguments, "--cameras", str(wand_capture / "cameras.yaml")]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["from_scratch"] and result["rms_px_before"] is None and result["rms_px_after"] < 0.05
    printed = capsys.readouterr().out
    assert "without a factory calibration" in printed and "since the factory" not in printed
    assert result["motion"] is None and "k3" in result["knowledge"]["undetermined"]
    rig = read_rig(tmp_path / "out" / "rig.yaml")
    assert rig.volume is not None and rig.prior is None and load_rig_covariance(tmp_path / "out" / "rig.yaml")
    assert "There was no factory calibration" in (tmp_path / "out" / "report.html").read_text()
    again = [*arguments[:-1], str(tmp_path / "again"), "--rig", str(tmp_path / "out" / "rig.yaml"), "--no-report"]
    assert main(again) == 0  # what came out is a factory calibration for what comes next


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ([], "missing --rig (a factory calibration) or --cameras"),
        (["--rig", "T4", "--cameras", "cameras.yaml"], "found both --rig and --cameras"),
        (["--cameras", "absent.yaml"], "absent.yaml"),
        (["--cameras", "cameras.yaml", "--first-guess", "points"], "--first-guess"),
        (["--cameras", "cameras.yaml", "--detector", "matched"], "--detector"),
    ],
)
def test_a_factory_calibration_or_none(more, expected, wand_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(wand_capture)
    assert main(["calibrate", "blobs.csv", "--object", "wand4", "--out", str(tmp_path / "out"), *more]) == 2
    assert expected in one_line(capsys) and not (tmp_path / "out").exists()

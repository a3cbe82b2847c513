"""What `calibrate` writes about a printed board, and which of its files belongs to frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.cli.main import main
from imgcal.io import load_object, save_detections, save_object
from imgcal.synthesis import simulate_board, true_detections


def test_a_board_whose_corners_are_off_still_gets_its_file(tmp_path, capsys):
    rig, obj, random = imgcal.load_rig("T4"), imgcal.load_object("charuco"), np.random.default_rng(3)
    off = torch.from_numpy(0.05 * random.standard_normal(obj.points.shape))
    printed = replace(obj, points=obj.points + off)
    seen = true_detections(simulate_board(rig, printed, 12, torch.Generator().manual_seed(3), None))
    noisy = replace(seen, uv=seen.uv + 0.02 * random.standard_normal(seen.uv.shape), sigma=np.full(len(seen), 0.02))
    save_detections(noisy, tmp_path / "corners.csv")
    out = tmp_path / "out"
    given = ["--rig", "T4", "--object", "charuco", "--out", str(out), "--no-report"]
    assert main(["calibrate", str(tmp_path / "corners.csv"), *given]) == 0
    said = capsys.readouterr().out
    assert f"object  {out / 'object.csv'}" in said and f"board   {out / 'board.yaml'}" in said
    found = load_object(out / "board.yaml").board
    assert found is not None and found.columns == obj.board.columns and found.bend != (0.0, 0.0)
    assert load_object(out / "object.csv").num_fiducials == obj.num_fiducials


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("board") / "frames"
    assert main(["simulate", "--rig", "T4", "--object", "charuco", "--snapshots", "1", "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize("command", ["score", "calibrate"])
def test_frames_of_a_board_need_its_own_file(command, frames, tmp_path, capsys):
    out, obj = tmp_path / "out", imgcal.load_object("charuco")
    out.mkdir()
    save_object(obj, out / "board.yaml")
    save_object(replace(obj, board=None), out / "object.csv")
    given = ["--rig", "T4", "--object", str(out / "object.csv")]
    given += ["--out", str(tmp_path / "result")] if command == "calibrate" else []
    assert main([command, str(frames), *given]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and str(out / "board.yaml") in said[0]
    assert not (tmp_path / "result").exists()

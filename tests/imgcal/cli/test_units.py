"""A rig and an object both in metres fit the images; what comes of them is marked."""

import json
from dataclasses import replace

import pytest
import torch

from imgcal.cli.main import main
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, read_rig, save_detections, save_object, save_rig
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import RigPrior

NOTE = (
    "note: rig and object seem to be in metres, expected millimetres: the object is 0.108 mm large, and 0.85 mm from "
)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with a rig and an object in metres, and a table of blobs."""
    folder, rig, obj = tmp_path_factory.mktemp("metres"), read_rig("T4"), load_object("asymmetric8")
    blobs = true_detections(simulate_truth(rig, obj, 4, torch.Generator().manual_seed(0), PhysicalDrift()))
    save_detections(blobs, folder / "blobs.csv")
    motion = RigidTransform(rig.cam_from_rig.rotation, rig.cam_from_rig.translation / 1000)
    prior = replace(rig.prior or RigPrior(), position=0.01)
    save_rig(replace(rig, cam_from_rig=motion, working_distance=0.85, prior=prior), folder / "rig.yaml")
    save_object(replace(obj, points=obj.points / 1000, radius=None), folder / "object.csv")
    return folder


@pytest.mark.parametrize("command", ["calibrate", "score", "watch"])
def test_a_rig_and_an_object_in_metres_are_noted(command, inputs, tmp_path, capsys):
    more = [] if command == "score" else ["--out", str(tmp_path / "out")]
    given = ["--rig", str(inputs / "rig.yaml"), "--object", str(inputs / "object.csv")]
    code = main([command, str(inputs / "blobs.csv"), *given, *more])
    assert code == (3 if command == "watch" else 0)  # which reads no labels, and identifies nothing at such lengths
    assert NOTE in capsys.readouterr().err
    if command == "calibrate":
        result = json.loads((tmp_path / "out" / "result.json").read_text())
        assert f"note: {result['unit_doubt']}".startswith(NOTE)

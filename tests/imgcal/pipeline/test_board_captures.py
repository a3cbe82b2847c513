"""Real captures of boards meet their targets, in less time than the benchmark."""

import csv
import gzip
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.formats import load_rig
from imgcal.io import load_detections, load_object
from imgcal.pipeline import calibrate, calibrate_from_scratch
from imgcal.types import Board, CalibrationObject, RigPrior

CAPTURES = Path(os.environ.get("IMGCAL_CAPTURES", "/nowhere"))
pytestmark = pytest.mark.skipif(not CAPTURES.is_dir(), reason="IMGCAL_CAPTURES is not set")


@pytest.mark.parametrize("turned", [False, True])
def test_the_warp_of_a_board_is_found(tmp_path, turned):
    folder = CAPTURES / "board-186-views"
    rig = replace(load_rig(folder / "opencv8.cameramodel"), camera_names=("camera",))
    with gzip.open(folder / "detections.csv.gz", "rt") as file:
        rows = [row for row in csv.DictReader(file) if int(row["snapshot"]) % 6 == 1 and float(row["weight"]) > 0]
    lines = ["snapshot,camera,u,v,sigma,fiducial"]
    for row in rows:
        lines += [f"{row['snapshot']},camera,{row['u']},{row['v']},{0.3 / float(row['weight'])},{row['fiducial']}"]
    (tmp_path / "seen.csv").write_text("\n".join(lines))
    board = CalibrationObject.of_board(Board("checkerboard", 11, 11, 77.0))
    seen = load_detections(tmp_path / "seen.csv", rig, board.rows)
    if turned:  # as if OpenCV had numbered the corners
        turn = np.random.default_rng(1).integers(4, size=len(seen.snapshot_names))
        place = np.stack([place for _, place in board.board.turns])[turn]
        seen = replace(seen, fiducial=place[seen.snapshot, seen.fiducial])
    found = calibrate(seen, rig, board)
    assert found.bend is not None and found.bend.is_certain
    assert min(found.bend.x, found.bend.y) == pytest.approx(-1.04, abs=0.2)
    assert max(found.bend.x, found.bend.y) == pytest.approx(0.52, abs=0.2)
    assert turned or found.bend.x < found.bend.y


def test_webcams_are_not_an_object_of_another_size():
    folder = CAPTURES / "charuco-four-cameras"
    rig = load_rig(folder / "camera_array.toml")
    rig = replace(rig, camera_names=tuple(f"cam_{name}" for name in rig.camera_names))
    obj = load_object(folder / "object.csv")
    found = calibrate(load_detections(folder / "detections.csv", rig, obj.rows), rig, obj)
    assert found.unsynchronized is not None
    assert "not synchronized" in str(found.unsynchronized)


def test_coordinates_that_are_not_exact_are_named():
    folder = CAPTURES / "april-tags-two-planes"
    obj = load_object(folder / "object.csv")
    seen = load_detections(folder / "detections.csv", None, obj.rows)
    count, size = len(seen.camera_names), torch.tensor([1920, 1200])
    cameras = _cameras(seen.camera_names, size, count)
    with pytest.raises(RefusedError, match="the object's coordinates are not exact"):
        calibrate_from_scratch(seen, cameras, obj)


def _cameras(names, size, count):
    rig = load_rig("T4").select(range(count))
    return replace(
        rig,
        camera_names=names,
        image_size=size.expand(count, 2).contiguous(),
        focal_length=torch.full((count, 2), 1690.0, dtype=torch.float64),
        principal_point=((size - 1) / 2).double().expand(count, 2).contiguous(),
        distortion=torch.zeros(count, 5, dtype=torch.float64),
        prior=RigPrior(focal_length=0.15, principal_point=38.4, distortion=0.1, rotation=1.0, position=1e6),
        working_distance=None,
    )

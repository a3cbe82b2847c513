import json
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import convert_rig, read_foreign_rig
from imgcal.formats.values import rotation_from_vector
from tests.imgcal.formats.rigs import apart, brown, put, put_files, read_in_mm, rig_of

LENS = {"model": "standard", "image_size": [1280, 800], "K": [[900, 0, 640], [0, 901, 400], [0, 0, 1]],
        "dist": [[-0.1, 0.02, 0, 0, 0.01]]}  # fmt: skip
POSE = {"R": rotation_from_vector(np.array([0.1, 0.2, 0.3])).tolist(), "T": [-0.2, 0.01, 0.02]}
ZERO = {"R": np.eye(3).tolist(), "T": [0, 0, 0]}


def read(tmp_path: Path, cameras: dict[str, object], poses: dict[str, object] | None):
    content = {"cameras": cameras} | ({"camera_poses": poses} if poses is not None else {})
    return read_foreign_rig(put(tmp_path, calibration__json=json.dumps(content)) / "calibration.json")


def test_a_key_that_misleads(tmp_path: Path) -> None:
    names = {"a_to_b": LENS, "m": LENS, "c": LENS}
    rig = read(tmp_path, names, {"m": ZERO, "a_to_b_to_m": POSE})
    assert (rig.format, rig.unit, rig.frame, rig.names) == ("multical", "m", "camera m", ["a_to_b", "m"])
    assert np.allclose(rig.cameras[0].rotation, POSE["R"])  # a_to_b_from_m
    assert rig.cameras[0].translation.tolist() == POSE["T"]
    assert any("camera c: left out" in note for note in rig.notes)


def test_what_is_no_rig_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"this is a multical calibration.json: found only intrinsics"):
        read(tmp_path, {"a": LENS, "b": LENS}, None)
    with pytest.raises(InputError, match="found a_to_x"):
        read(tmp_path, {"a": LENS, "b": LENS}, {"a": ZERO, "a_to_x": POSE})
    with pytest.raises(InputError, match="no pose of one camera to another"):
        read(tmp_path, {"a": LENS, "b": LENS}, {"a": ZERO})
    with pytest.raises(InputError, match="the model 'fisheye'"):
        read(tmp_path, {"a": LENS, "b": {**LENS, "model": "fisheye"}}, {"a": ZERO, "b_to_a": POSE})


def test_written_and_read(tmp_path: Path) -> None:
    rig = rig_of(brown(-0.1, 0.02), brown(0, 0, 0, 0, 0, 0.1), brown(*[0.001] * 14), names=("m", "b", "c"))
    path = put_files(tmp_path, convert_rig(rig, "multical", "x").files)
    content = json.loads(path.read_text())
    assert list(content["camera_poses"]) == ["m", "b_to_m", "c_to_m"]
    assert [camera["model"] for camera in content["cameras"].values()] == ["standard", "rational", "tilted"]
    assert apart(rig, read_in_mm(path)) < 1e-8

import tomllib

import pytest

from imgcal.formats.foreign_rig import FormatError
from imgcal.formats.toml_cameras import AT, read_cameras, toml_key, toml_text

LENS = {"matrix": [[900.0, 0, 640], [0, 901, 400], [0, 0, 1]], "distortions": [0.1, 0, 0, 0, 0], "size": [1280, 800]}
LENS |= {AT: ("cameras.toml", ())}
POSED = {**LENS, "rotation": [0.1, 0.2, 0.3], "translation": [1.0, 2.0, 3.0]}


def test_who_has_no_pose_is_named_and_left_out() -> None:
    notes: list[str] = []
    tables = {
        "a": POSED, "b": {**LENS, "rotation": "null", "translation": "null"}, "c": LENS,
        "d": {**POSED, "matrix": "null"}, "e": {**POSED, "translation": []},
    }  # fmt: skip
    assert [camera.name for camera in read_cameras(tables, notes)] == ["a"]
    assert notes == [
        "camera d: left out, intrinsics are not calibrated",
        "cameras b, c, e: left out, poses are not calibrated",
    ]
    with pytest.raises(FormatError, match="no camera has both"):
        read_cameras({"c": LENS}, [])


def test_a_fisheye_has_four_coefficients() -> None:
    fish = {**POSED, "distortions": [0.1, 0.2, 0.3, 0.4], "fisheye": True}
    assert read_cameras({"a": fish}, [])[0].lens.model == "fisheye"
    with pytest.raises(FormatError, match="found 5 distortion"):
        read_cameras({"a": {**POSED, "fisheye": True}}, [])
    with pytest.raises(FormatError, match="expected true or false"):
        read_cameras({"a": {**POSED, "fisheye": "yes"}}, [])


def test_toml_is_read_as_it_was_written() -> None:
    name = 'a "b" \\ c'
    content = {toml_key(name): {"text": name, "numbers": [[1e-17, 2.0], [3, 4]], "yes": True}}
    assert tomllib.loads(toml_text(content).decode()) == {name: content[toml_key(name)]}
    assert toml_key("cam_1") == "cam_1"

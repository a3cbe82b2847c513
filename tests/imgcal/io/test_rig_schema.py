"""Rig files: content, and one-line errors that name the file, the camera and the expected value."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from imgcal.errors import InputError
from imgcal.geometry import rotation_from_vector
from imgcal.io import RigCovariance, load_rig_covariance, read_rig, save_rig
from imgcal.types import RigPrior

TEXT = """\
format: imgcal-rig/1
name: pair
working_distance: 850.14                 # mm, optional
cameras:
  - name: left
    image_size: [2048, 1088]
    focal_length: [1627.0, 1627]
    principal_point: [1024.0, 544.0]
    distortion: [0.1, -0.1, 0.0, 9e-05, 0.0]
    cam_from_rig: {rotation_vector: [0.0, 0.1, 0.0], translation: [0.0, 0.0, 1.0]}
  - name: right
    image_size: [640, 480]
    focal_length: [800.0, 801.0]
    principal_point: [320.0, 240.0]
    distortion: [0.0, 0.0, 0.0, 0.0, 0.0]
    cam_from_rig: {rotation_vector: [0.0, 0.0, 0.0], translation: [100.0, 0.0, 0.0]}
prior:
  focal_length: 0.03
  principal_point: 11.0
"""


def test_reads_the_documented_example(tmp_path: Path) -> None:
    path = tmp_path / "pair.yaml"
    path.write_text(TEXT)
    rig = read_rig(path)
    assert rig.camera_names == ("left", "right")
    assert rig.name == "pair"
    assert rig.working_distance == 850.14
    assert rig.prior == RigPrior(focal_length=0.03, principal_point=11.0)
    assert rig.image_size.tolist() == [[2048, 1088], [640, 480]]
    assert rig.focal_length.dtype == torch.float64
    assert rig.distortion[0].tolist() == [0.1, -0.1, 0.0, 9e-05, 0.0]
    assert rig.cam_from_rig.translation[1].tolist() == [100.0, 0.0, 0.0]
    torch.testing.assert_close(
        rig.cam_from_rig.rotation[0], rotation_from_vector(torch.tensor([0, 0.1, 0], dtype=torch.float64))
    )
    assert load_rig_covariance(path) is None


@pytest.mark.parametrize(
    ("model", "lens", "message"),
    [
        ("fisheye", [0.0] * 4, "model: found 'fisheye', expected one of brown_conrady, rational"),
        (
            "rational",
            [0.0] * 5,
            "distortion: found 5 coefficients, expected 8 of rational: k1, k2, p1",
        ),
        ("equidistant", [0.0] * 5, "distortion: found 5 coefficients, expected 4 of equidistant"),
        ("equidistant", [900.0, 0.0, 0.0, 0.0], "which moves the image corners"),
    ],
)
def test_lenses_that_cannot_be(model: str, lens: list[float], message: str, tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    save_rig(read_rig("T4").select([0]), path)
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("distortion: [")]
    at = next(i for i, line in enumerate(lines) if "principal_point: [" in line)
    path.write_text("\n".join([*lines[:at], f"  model: {model}", f"  distortion: {lens}", *lines[at:]]) + "\n")
    with pytest.raises(InputError, match=re.escape(message)):
        read_rig(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format: imgcal-rig/1\n", "", r"found no key `format`, expected `format: imgcal-rig/1`"),
        ("imgcal-rig/1", "imgcal-rig/2", r"found `format: 'imgcal-rig/2'`"),
        (TEXT, "", r"found an empty file"),
        (TEXT, "- 1\n- 2\n", r"found list \[1, 2\]"),
        (TEXT, "\x00\x01\x02", r"not a YAML text file"),
        ("name: pair", "[a, b]: pair", r"not valid YAML in line 2: found a list, a mapping or an alias as a key"),
        ("[1627.0, 1627]", "[1627.0, 1627", r"not valid YAML in line \d+"),
        ("name: pair", "name: pair\nname: other", r"line 3: key `name` given twice"),
        ("focal_length: [800.0, 801.0]", "focal_lenght: [800.0, 801.0]",
         r"camera right: unknown key `focal_lenght`, nearest: focal_length \(and 1 more\)"),
        ("prior:\n", "prior:\n  rotatoin: 0.1\n", r"prior: unknown key `rotatoin`, nearest: rotation"),
        ("rotation_vector: [0.0, 0.1", "rotation: [0.0, 0.1", r"camera left: cam_from_rig: unknown key `rotation`"),
        ("[800.0, 801.0]", "[800.0]", r"camera right: focal_length: found 1 values, expected 2"),
        ("[320.0, 240.0]", "[320.0, 240.0, 1.0]", r"camera right: principal_point: found more than 2 values"),
        ("[800.0, 801.0]", "[800.0, -801.0]", r"focal_length\[1\]: found -801\.0, expected greater than"),
        ("[800.0, 801.0]", "[800.0, .nan]", r"focal_length\[1\]: found nan, expected a finite number"),
        ("[0.0, 0.0, 1.0]", "[0.0, .inf, 1.0]", r"camera left: cam_from_rig: translation\[1\]: found inf"),
        ("[0.0, 0.1, 0.0]", "[0.0, .nan, 0.0]", r"rotation_vector\[1\]: found nan"),
        ("[0.0, 0.1, 0.0]", "[0.0, 90.0, 0.0]", r"length 90, expected rad"),
        ("[640, 480]", "[640, 0]", r"image_size\[1\]: found 0, expected greater than 0"),
        ("[640, 480]", "[640.5, 480]", r"image_size\[0\]: found 640\.5, expected a valid integer"),
        ("[320.0, 240.0]", "[320.0, '240.0']", r"principal_point\[1\]: found '240\.0', expected a valid number"),
        ("[320.0, 240.0]", "[320.0, true]", r"principal_point\[1\]: found True, expected a valid number"),
        ("[0.1, -0.1, 0.0", "[1000.0, -0.1, 0.0", r"camera left: distortion: found \[1000\.0"),
        ("name: right", "name: left", r"camera name left more than once"),
        ("name: right", "name: 7", r"camera number 2: name: found 7, expected a valid string"),
        ("name: right", "name: a/b", r"found the camera name 'a/b'"),
        ("    distortion: [0.0, 0.0, 0.0, 0.0, 0.0]\n", "", r"camera right: key `distortion` is missing"),
        ("850.14", "-1", r"working_distance: found -1, expected greater than"),
        (TEXT[TEXT.index("cameras") :], "cameras: []", r"cameras: found 0 values, expected 1 or more"),
        ("[800.0, 801.0]", "[800.0, 1e-150]", r"focal_length\[1\]: found 1e-150"),
        ("[800.0, 801.0]", "[800.0, 1e308]", r"focal_length\[1\]: found 1e\+308"),
        ("[0.0, 0.0, 1.0]", "[0.0, 1e200, 1.0]", r"translation\[1\]: found 1e\+200"),
        ("[640, 480]", "[60000, 60000]", r"image_size: found \[60000, 60000\], expected at most"),
        ("[320.0, 240.0]", "[320.0, -1e30]", r"principal_point\[1\]"),
        ("850.14", "1e-30", r"working_distance: found 1e-30"),
        ("prior:\n", "prior:\n  rotation: 1e-200\n", r"prior: rotation: found 1e-200"),
        ("name: right", "name: ../right", r"found the camera name '../right'"),
        ("name: right", "name: " + 300 * "x", r"camera x{37}\.\.\.: found the camera name 'x+\.\.\.', "),
        ("name: pair", 'name: "a\\x1b[31m"', r"name: found 'a\\x1b\[31m', expected text"),
        ("name: right", "1: right", r"camera number 2: unknown key `1`"),
        ("name: right", "name: !!int ''", r"line \d+: found '', expected a value of type int"),
        ("name: right", "name: right\n    " + "x" * 900 + ": 1", r"unknown key `x{37}\.\.\.`"),
        (TEXT[TEXT.index("cameras") :], "prior: &c {}\ncameras: [" + "*c, " * 200_000 + "]",
         r"cameras: found more than 256"),
        (TEXT[TEXT.index("cameras") :], "\n".join(f"k{i}: 0" for i in range(5000)), r"found 5,001 values"),
        ("prior:\n", "prior:\n  rotation: 0\n", r"prior: rotation: found 0"),
        ("prior:\n", "drift_rate: {rotation: -1}\nprior:\n", r"drift_rate: rotation: found -1"),
        ("prior:\n", "volume: {low: [0, 0, 0]}\nprior:\n", r"volume: expected `low` and `high` of a box, or `points`"),
        ("prior:\n", "volume: {low: [0, 0, 0], high: [1, 0, 1]}\nprior:\n", r"expected each low below its high"),
        ("prior:\n", "volume: {points: [[0, 0, 0], [1, 0, 0]]}\nprior:\n", r"volume: points: found 2 values"),
        ("prior:\n", "volume: {points: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]}\nprior:\n", "in one plane"),
        ("prior:\n", "drift_rate: {focal: 1}\nprior:\n", r"drift_rate: unknown key `focal`"),
        ("prior:\n", "covariance: {parameters: [fx]}\nprior:\n", r"found only one of `std`|`std`.*`covariance`"),
    ],
)  # fmt: skip
def test_bad_files_give_one_clear_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    assert old in TEXT
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(InputError, match=message) as caught:
        read_rig(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def _edit(content: dict[str, Any], case: str) -> None:
    block = content["covariance"]
    if case == "reference":
        block["reference_camera"] = "z"
    elif case == "order":
        block["parameters"].reverse()
    elif case == "shape":
        block["matrix"].pop()
    elif case == "diagonal":
        block["matrix"][20][20] *= 2
    elif case == "symmetry":
        block["matrix"][20][21] += 0.1
    elif case == "std":
        del content["cameras"][1]["std"]
    elif case == "length":
        content["cameras"][1]["std"]["position"].pop()


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("reference", "found reference_camera z, expected one of a, b, c"),
        ("order", "other parameters"),
        ("shape", "matrix of 44 rows"),
        ("diagonal", "diagonal that differs"),
        ("symmetry", "not symmetric"),
        ("std", "found `std` for a, c only"),
        ("length", "camera b: std: position: found 2 values, expected 3"),
    ],
)
def test_bad_covariance(case: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    rig = replace(read_rig("T4").select([0, 1, 2]), camera_names=("a", "b", "c"))
    root = torch.randn(45, 45, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    save_rig(rig, path, RigCovariance.from_matrix(root @ root.mT / 100, 3, "a"), full=True)
    content = yaml.safe_load(path.read_text())
    _edit(content, case)
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=message):
        read_rig(path)

"""Every numbered example prints what it promises; other programs understand those that talk to them."""

import re
import runpy
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from imgcal.io import model_file
from imgcal.networks import load_measurer, load_program, save_onnx
from imgcal.watch.wire import exposure_from_pixels
from tests.imgcal.watch.test_poses import record

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "scripts" / "examples").glob("[0-9]*.py"))


def numbers(line: str) -> list[float]:
    return [float(word) for word in re.findall(r"-?\d+\.?\d*", line)]


def recovers(lines: list[str]) -> bool:
    before, after, predicted = numbers(lines[0])
    return after < 0.1 * before and after < 3 * predicted and 0.8 < numbers(lines[1])[-1] < 1.2


PROMISES = {
    "01_project": lambda lines: lines[-1] == "all visible: True",
    "02_recover": recovers,
    "03_frames": lambda lines: lines[0].startswith("identity unique") and numbers(lines[0])[-1] < 0.05,
    "04_gradient": lambda lines: any(numbers(lines[1])) and numbers(lines[-1])[0] > 0,
    "05_training_loop": lambda lines: abs(numbers(lines[-1])[-1] + 1) < 0.2,  # the slope that the noise has
    "06_from_scratch": lambda lines: "identity unique" in lines[0] and numbers(lines[0])[-1] < 0.2,
    "06_keep_calibrated": lambda lines: (
        lines[0].startswith("2") and all("cam02" in line and "since snapshot 20" in line for line in lines[:-1])
        and lines[-1] == "all 4 cameras are calibrated"
    ),
}  # fmt: skip


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example(example, capsys):
    """In this process: a new one for each would import the same libraries once more."""
    runpy.run_path(str(example), run_name="__main__")
    said = capsys.readouterr().out
    assert PROMISES[example.stem](said.splitlines()), said


@pytest.mark.parametrize(("encoding", "order"), [("mono8", "|"), ("mono16", "<"), ("mono16", ">")])
def test_the_bridge_to_ros_sends_the_pixels_of_a_message(encoding, order):
    """Its messages are those of a library that knows ROS without having it; its node needs ROS itself."""
    typesys = pytest.importorskip("rosbags.typesys")
    pytest.importorskip("zmq")
    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE).types
    stamp = types["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=250_000_000)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="cam01")
    pixels = np.arange(12, dtype=encoding.replace("mono", "uint")).reshape(3, 4) * 20
    rows = np.pad(pixels.astype(pixels.dtype.newbyteorder(order)), ((0, 0), (0, 2)))
    message = types["sensor_msgs/msg/Image"](
        header=header, height=3, width=4, encoding=encoding, is_bigendian=int(order == ">"),
        step=6 * pixels.itemsize, data=np.frombuffer(rows.tobytes(), np.uint8),
    )  # fmt: skip
    bridge = runpy.run_path(str(ROOT / "scripts" / "examples" / "ros2_bridge.py"))
    found = exposure_from_pixels(*bridge["frame_parts"]("cam01", message))
    assert (found.content == pixels).all() and (found.camera, found.time) == ("cam01", 1_700_000_000.25)


def test_the_bridge_to_ros_gives_poses_in_metres():
    pytest.importorskip("zmq")
    bridge = runpy.run_path(str(ROOT / "scripts" / "examples" / "ros2_bridge.py"))
    place, turn, covariance, seconds = bridge["pose_values"](record(2).to_json())
    assert place.tolist() == [0.002, 0.002, 1.5] and seconds == record(2).time
    assert 2 * turn[:3] / np.linalg.norm(turn[:3]) * np.arccos(turn[3]) == pytest.approx([0.1, -0.2, 0.3])
    assert np.diag(covariance.reshape(6, 6)) == pytest.approx([1e-8] * 3 + [1e-6] * 3)
    assert bridge["pose_values"](record(2, "no_object").to_json()) is None


def openvino_and_compiler():
    """The folder of OpenVINO's wheel, which has headers, and a compiler; skips where one is missing."""
    found = find_spec("openvino")
    if found is None:
        pytest.skip("no openvino (extra dev): nobody has the headers of a runtime of ONNX")
    compiler = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if compiler is None:
        pytest.skip("no C++ compiler")
    return Path(found.origin).parent, compiler


def test_the_example_in_cpp_measures_as_pytorch_does(tmp_path):
    folder, compiler = openvino_and_compiler()
    program = tmp_path / "run_onnx"
    (library,) = (folder / "libs").glob("libopenvino.so.*")
    source = ROOT / "scripts" / "examples" / "run_onnx.cpp"
    build = [compiler, "-std=c++17", f"-I{folder / 'include'}", source, library, f"-Wl,-rpath,{folder / 'libs'}"]
    subprocess.run([*build, "-o", program], check=True)
    save_onnx(load_program(model_file("measurer-cnn"), 1, 8), tmp_path / "measurer.onnx")
    python, measurer = runpy.run_path(str(source.with_suffix(".py"))), load_measurer(model_file("measurer-cnn")).network
    random = np.random.default_rng(0)
    v, u = np.mgrid[0:24, 0:24]
    for radius in (1.5, 3.0):
        true = 11.5 + random.uniform(-2, 2, 2)
        patch = (
            20 + 180 / (1 + np.exp(3 * (np.hypot(u - true[0], v - true[1]) - radius))) + random.normal(0, 2, u.shape)
        )
        given = " ".join(f"{value:.9g}" for value in [radius, *patch.astype(np.float32).ravel()])
        asked = [program, tmp_path / "measurer.onnx"]
        done = subprocess.run(asked, input=given, capture_output=True, text=True, check=True)
        normal = torch.from_numpy(python["normalized"](patch.astype(np.float32)[None].astype(float)))
        with torch.no_grad():
            found = measurer(normal, torch.tensor([radius]))
        expected = [*found.offset[0].tolist(), float(found.log_sigma[0].exp()), float(found.valid[0].sigmoid())]
        assert [float(word) for word in done.stdout.split()] == pytest.approx(expected, abs=1e-4)
        assert np.hypot(*(np.array(expected[:2]) + 11.5 - true)) < 0.3
    wrong = subprocess.run(
        [program, tmp_path / "measurer.onnx"], input="3 1 2", capture_output=True, text=True, check=False
    )
    assert wrong.returncode == 2 and "expected a radius and 576 grey values" in wrong.stderr

"""Every numbered example runs and prints something."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from imgcal.watch.wire import exposure_from_pixels
from tests.imgcal.watch.test_poses import record

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "scripts" / "examples").glob("[0-9]*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example(example):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, example], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) >= 2


def test_there_are_examples():
    assert len(EXAMPLES) >= 4


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

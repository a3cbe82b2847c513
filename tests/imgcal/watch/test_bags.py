from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.io import read_rig
from imgcal.watch import Bag, Exposure, Unreadable

rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

RIG = read_rig("T4")
STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
PLUGINS = {"mcap": rosbag2.StoragePlugin.MCAP, "sqlite": rosbag2.StoragePlugin.SQLITE3}


def image(frame, second, encoding=None, big=False, padding=0, height=None):
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](sec=int(second), nanosec=round((second % 1) * 1e9))
    order = ">" if big else "<"
    rows = np.pad(frame.astype(frame.dtype.newbyteorder(order)), ((0, 0), (0, padding)))
    data = np.frombuffer(rows.tobytes(), np.uint8)
    kind = encoding or {1: "mono8", 2: "mono16"}[frame.itemsize]
    header = types["std_msgs/msg/Header"](stamp, "cam")
    shape = frame.shape[0] if height is None else height, frame.shape[1]
    return types["sensor_msgs/msg/Image"](header, *shape, kind, big, rows.strides[0], data)


def write(path, messages, plugin="mcap"):
    """Write (topic, message, recorded s) into a bag."""
    with rosbag2.Writer(path, version=9, storage_plugin=PLUGINS[plugin]) as writer:
        connections = {}
        for topic, message, recorded in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], round(recorded * 1e9), STORE.serialize_cdr(message, kind))
    return path


def frame(level, dtype=np.uint8):
    return np.arange(24, dtype=dtype).reshape(4, 6) + dtype(level)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_images_of_the_topics_that_name_cameras(plugin, tmp_path):
    text = STORE.types["std_msgs/msg/String"]("no image")
    messages = [
        ("/rig/cam01/image_raw", image(frame(1), 10.5), 11.0),
        ("/chatter", text, 11.1),
        ("/rig/cam02/image_raw", image(frame(300, np.uint16), 10.501, big=True, padding=3), 11.2),
        ("/rig/cam01/image_raw", image(frame(2), 0.0), 12.0),  # no stamp: when it was recorded
    ]
    path = write(tmp_path / "bag", messages, plugin)
    paths = [path, *path.glob("*.mcap")]
    for path in paths:
        found = list(Bag(path, RIG).items())
        assert [(e.camera, pytest.approx(e.time)) for e in found] == [
            ("cam01", 10.5),
            ("cam02", 10.501),
            ("cam01", 12.0),
        ]
        assert (found[1].content == frame(300, np.uint16)).all() and found[1].content.dtype == np.uint16
        assert (found[2].content == frame(2)).all()


def test_topics_by_name_and_what_is_no_grey_image(tmp_path):
    messages = [
        ("/left", image(frame(1), 1.0), 1.0),
        ("/left", image(frame(1), 2.0, encoding="rgb8"), 2.0),
        ("/left", image(frame(1), 3.0, height=400), 3.0),
        ("/left", image(frame(1), 4.0), 4.0),
    ]
    path = write(tmp_path / "bag", messages)
    found = list(Bag(path, RIG, {"cam03": "/left"}).items())
    assert [type(item) for item in found] == [Exposure, Unreadable, Unreadable, Exposure]
    assert found[1].camera == "cam03" and "rgb8" in found[1].reason and "for 6x400 pixels" in found[2].reason


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        ({}, "found no topic that names a camera.*image topics of this recording: /left"),
        ({"cam01": "/right"}, "found no images of the topic /right; image topics"),
        ({"cam01": "/left", "cam99": "/left"}, "found camera cam99"),
        ({"cam01": "/left", "cam02": "/left"}, "found the topic /left for cam01, cam02, expected one camera"),
    ],
)
def test_topics_that_are_not_there(topics, message, tmp_path):
    path = write(tmp_path / "bag", [("/left", image(frame(1), 1.0), 1.0)])
    with pytest.raises(InputError, match=message):
        list(Bag(path, RIG, topics).items())


def test_two_topics_of_one_camera(tmp_path):
    messages = [("/cam01/raw", image(frame(1), 1.0), 1.0), ("/cam01/rect", image(frame(1), 1.0), 1.0)]
    with pytest.raises(InputError, match="found /cam01/raw, /cam01/rect for camera cam01"):
        list(Bag(write(tmp_path / "bag", messages), RIG).items())


def test_what_is_no_recording(tmp_path):
    (tmp_path / "junk.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    (tmp_path / "empty").mkdir()
    bag = write(tmp_path / "bag", [("/cam01/raw", image(frame(1), 1.0), 1.0)])
    (file,) = bag.glob("*.mcap")
    content = file.read_bytes()
    for length in (9, 40, len(content) // 2, len(content) - 9):
        (tmp_path / "cut.mcap").write_bytes(content[:length])
        with pytest.raises(InputError, match=r"cut\.mcap"):
            list(Bag(tmp_path / "cut.mcap", RIG).items())
    for name in ("absent", "junk.mcap", "empty"):
        with pytest.raises(InputError, match=name):
            list(Bag(Path(tmp_path / name), RIG).items())

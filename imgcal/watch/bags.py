"""Robot recordings: image topics of rosbag2 folders and MCAP files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imgcal.errors import InputError
from imgcal.messages import list_names, quote, shorten
from imgcal.types import CameraRig
from imgcal.watch.exposures import Exposure, Item, Unreadable

IMAGE = "sensor_msgs/msg/Image"
ENCODINGS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
NANO = 1e-9


@dataclass(frozen=True)
class Bag:
    """Grey images of a recording, in the recorded order, with the time stamps of their headers."""

    path: Path  # folder with metadata.yaml, or an .mcap file
    rig: CameraRig
    topics: Mapping[str, str] = field(default_factory=dict)  # camera -> topic; default: the topic that names the camera
    live: bool = False

    def items(self) -> Iterator[Item]:
        """Yield the images of the cameras' topics.

        Raises:
            InputError: the recording cannot be read, or its topics cannot be assigned to the cameras.
        """
        from rosbags.highlevel import AnyReader  # not in the core
        from rosbags.typesys import Stores, get_typestore

        if not self.path.exists():
            raise InputError(f"{self.path}: no such file or folder, expected a rosbag2 folder or an .mcap file")
        try:
            with AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                cameras = self._cameras({connection.topic: connection.msgtype for connection in reader.connections})
                chosen = [connection for connection in reader.connections if connection.topic in cameras]
                for connection, recorded, raw in reader.messages(connections=chosen):
                    camera = cameras[connection.topic]
                    try:
                        message = reader.deserialize(raw, connection.msgtype)
                        yield _exposure(camera, message, recorded)
                    except (InputError, AttributeError, ValueError, TypeError, IndexError) as error:
                        yield Unreadable(f"{connection.topic}: {quote(str(error))}", camera)
        except InputError:
            raise
        except Exception as error:  # the reader may fail in any way on a damaged file
            raise InputError(f"{self.path}: cannot be read: {quote(str(error) or type(error).__name__)}") from error

    def _cameras(self, types: Mapping[str, str]) -> dict[str, str]:
        """Find the camera of each topic."""
        images = sorted(topic for topic, kind in types.items() if kind == IMAGE)
        there = f"image topics of this recording: {list_names(images) or 'none'}"
        found: dict[str, str] = {}
        for camera in self.rig.camera_names:
            named = [topic for topic in images if camera in topic.split("/")]
            topic = self.topics.get(camera) or (named[0] if len(named) == 1 else None)
            if topic is None and named:
                raise InputError(
                    f"{self.path}: found {list_names(named)} for camera {camera}, choose one with --topic {camera}=..."
                )
            if topic is not None and topic not in images:
                raise InputError(f"{self.path}: found no images of the topic {shorten(topic)}; {there}")
            if topic is not None and topic in found:
                cameras = list_names((found[topic], camera))
                raise InputError(f"{self.path}: found the topic {shorten(topic)} for {cameras}, expected one camera")
            if topic is not None:
                found[topic] = camera
        unknown = sorted(set(self.topics) - set(self.rig.camera_names))
        if unknown:
            raise InputError(f"--topic: found camera {list_names(unknown)}, expected those of rig {self.rig.name}")
        if not found:
            raise InputError(f"{self.path}: found no topic that names a camera, expected --topic CAMERA=TOPIC; {there}")
        return found


def _exposure(camera: str, message: Any, recorded: int) -> Exposure:
    """Take the pixels of a `sensor_msgs/msg/Image`."""
    kind = ENCODINGS.get(message.encoding)
    if kind is None:
        raise InputError(f"found the encoding {shorten(repr(message.encoding))}, expected {list_names(ENCODINGS)}")
    order = ">" if message.is_bigendian else "<"
    pixel = np.dtype(order + kind)
    height, width, step = int(message.height), int(message.width), int(message.step)
    if step < width * pixel.itemsize or len(message.data) < step * height or step % pixel.itemsize:
        found = f"{len(message.data):,} bytes in rows of {step:,}"
        raise InputError(f"found {found} for {width}x{height} pixels of {8 * pixel.itemsize} bit")
    rows = np.asarray(message.data, dtype=np.uint8)[: step * height].view(pixel).reshape(height, step // pixel.itemsize)
    frame = np.ascontiguousarray(rows[:, :width]).astype(pixel.newbyteorder("="), copy=False)
    stamp = message.header.stamp
    nanoseconds = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return Exposure(camera, NANO * (nanoseconds or recorded), frame)

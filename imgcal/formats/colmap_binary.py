"""COLMAP's binary files: little endian, every count compared with what is left of the file."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from imgcal.formats.chains import IDENTITY, Pose
from imgcal.formats.colmap_model import (
    COUNTS,
    MODELS,
    At,
    ColmapCamera,
    ColmapImage,
    ColmapRig,
    model_from_rig,
    pose_from_quaternion,
    pose_numbers,
    rig_from_model,
)
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignRig, FormatError
from imgcal.formats.format import Files, Format
from imgcal.formats.source import Source
from imgcal.formats.values import number
from imgcal.io import read_bytes

TITLE = "COLMAP model (binary)"
CAMERA = 0  # the type of a sensor
MOST_BYTES = 2**30
LONGEST_NAME = 4096
POINT = struct.calcsize("<ddQ")


class _Reader:
    """Values one after another; a file that ends too early is an error of one line."""

    def __init__(self, path: Path) -> None:
        self.path, self.name, self.content, self.place = path, path.name, read_bytes(path, MOST_BYTES), 0

    def read(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        self.need(size)
        values = struct.unpack_from("<" + layout, self.content, self.place)
        self.place += size
        return values

    def count(self, smallest: int) -> int:
        """Read a number of records, each of at least `smallest` bytes."""
        (count,) = self.read("Q")
        self.need(count * smallest)
        return int(count)

    def need(self, size: int) -> None:
        if size > len(self.content) - self.place:
            raise FormatError(f"{self.name}: ends after {len(self.content):,} bytes, in the middle of a record")

    def name_of_image(self) -> str:
        end = self.content.find(b"\0", self.place, self.place + LONGEST_NAME)
        if end < 0:
            raise FormatError(f"{self.name}: found an image name without an end")
        text = self.content[self.place : end].decode(errors="replace")
        self.place = end + 1
        return text

    def at(self) -> At:
        """Where it is."""
        return At(self.path, self.place)

    def pose(self) -> Pose:
        return pose_from_quaternion([number(value, self.name) for value in self.read("7d")], self.name)


def _recognizes(source: Source) -> bool:
    return source.find_file("cameras.bin") is not None


def _read(source: Source) -> ForeignRig:
    path = source.find_file("cameras.bin")
    assert path is not None
    cameras = _cameras(_Reader(path))
    rigs_path, images_path = source.find_file("rigs.bin"), source.find_file("images.bin")
    rigs = _rigs(_Reader(rigs_path)) if rigs_path else []
    if images_path is None and not any(len(rig.sensors) > 1 for rig in rigs):
        raise FormatError("found only intrinsics, expected images.bin or rigs.bin beside cameras.bin")
    return rig_from_model(FORMAT.name, cameras, _images(_Reader(images_path)) if images_path else [], rigs, source.rig)


def _cameras(reader: _Reader) -> list[ColmapCamera]:
    found = []
    for _ in range(reader.count(24)):
        camera, model, width, height = reader.read("IiQQ")
        if not 0 <= model < len(MODELS):
            raise FormatError(
                f"{reader.name}: camera {camera}: found the model number {model}, expected one of COLMAP's"
            )
        name = MODELS[model]
        at = reader.at()
        parameters = tuple(number(value, reader.name) for value in reader.read(f"{COUNTS[name]}d"))
        found.append(ColmapCamera(camera, name, (width, height), parameters, at))
    return found


def _rigs(reader: _Reader) -> list[ColmapRig]:
    found = []
    for _ in range(reader.count(8)):
        rig, sensors = reader.read("II")
        reader.need(9 * max(sensors - 1, 0))
        poses: dict[int, Pose | None] = {}
        places: dict[int, At] = {}
        for place in range(sensors):
            kind, sensor = reader.read("iI")
            pose: Pose | None = IDENTITY  # of the first one, the reference
            if place:
                (posed,) = reader.read("B")
                at = reader.at()
                pose = reader.pose() if posed else None
                if kind == CAMERA and posed:
                    places[sensor] = at
            if kind == CAMERA:
                poses[sensor] = pose
        found.append(ColmapRig(rig, poses, places))
    return found


def _images(reader: _Reader) -> list[ColmapImage]:
    found = []
    for _ in range(reader.count(73)):
        (image,) = reader.read("I")
        at = reader.at()
        pose = reader.pose()
        (camera,) = reader.read("I")
        name = reader.name_of_image()
        points = reader.count(POINT)
        reader.place += points * POINT
        found.append(ColmapImage(image, pose, camera, name, at))
    return found


def _write(rig: ForeignRig) -> Files:
    cameras, images, colmap_rig, rig_from_world = model_from_rig(rig)
    count = struct.pack("<Q", len(cameras))
    camera_rows = [
        struct.pack(f"<IiQQ{len(c.parameters)}d", c.id, MODELS.index(c.model), *(c.image_size or (0, 0)), *c.parameters)
        for c in cameras
    ]
    image_rows = [
        struct.pack("<I7dI", i.id, *pose_numbers(i.pose), i.camera) + i.name.encode() + b"\0" + struct.pack("<Q", 0)
        for i in images
    ]
    sensors = [struct.pack("<iI", CAMERA, 1)]
    for sensor, pose in colmap_rig.sensors.items():
        if sensor != 1 and pose is not None:
            sensors.append(struct.pack("<iIB7d", CAMERA, sensor, 1, *pose_numbers(pose)))
    data = [struct.pack("<iIQ", CAMERA, image.camera, image.id) for image in images]
    frame = struct.pack("<II7dI", 1, 1, *pose_numbers(rig_from_world), len(images))
    one = struct.pack("<Q", 1)
    return {
        "cameras.bin": count + b"".join(camera_rows),
        "images.bin": count + b"".join(image_rows),
        "rigs.bin": one + struct.pack("<II", 1, len(cameras)) + b"".join(sensors),
        "frames.bin": one + frame + b"".join(data),
        "points3D.bin": struct.pack("<Q", 0),
    }


FORMAT = Format(
    "colmap-binary", TITLE, _recognizes, _read, _write, Holds((4, 8), fisheye=True), unit="m", cameras=(2, 256)
)

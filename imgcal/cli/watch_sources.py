"""What INPUT of `imgcal watch` is: an address, standard input, a recording, or a folder that fills."""

from __future__ import annotations

import sys
from pathlib import Path

from imgcal.cli import arguments
from imgcal.errors import InputError
from imgcal.extras import advice, missing
from imgcal.io import Fiducials, open_input
from imgcal.messages import shorten
from imgcal.types import CameraRig, Detections
from imgcal.watch import Bag, BlobTable, Folder, JsonLines, LabStreaming, Qualisys, Source, Videos, ZeroMQ, holds_videos

USUAL_RATE = 30.0  # snapshots a second of a table of blobs

# What kind of input an option is for.
ONLY_FOR = {
    "rate": "a table of blobs",
    "topic": "a recording",
    "videos-differ": "a folder of videos",
    "until-idle": "a folder of frames",
    "remove": "a folder of frames",
}


def identify_source(given: str) -> str:
    """Name the source of INPUT, wherever the command is run."""
    return given if given == "-" or "://" in given else str(Path(given).resolve())


def open_source(asked: arguments.Watch, rig: CameraRig, labels: Fiducials) -> Source:
    """Find out what INPUT is; nothing is read yet, but for a table.

    Args:
        asked: the command line.
        rig: the cameras.
        labels: how tables call the fiducials.

    Raises:
        InputError: it is nothing that can be watched, a package is missing for it, or an option is for something else.
    """
    given = asked.input
    if given == "-":
        _check_options(asked, "standard input")
        return JsonLines(sys.stdin.fileno())
    if "://" in given:
        _check_options(asked, "an address")
        return _open_address(given, rig)
    path = Path(given)
    if path.suffix.lower() == ".mcap" or (path / "metadata.yaml").is_file():
        _check_options(asked, "a recording")
        _require("rosbags", given, "a recording")
        return Bag(path, rig, _read_topics(asked.topic))
    if path.is_dir() and not holds_videos(path):
        _check_options(asked, "a folder of frames")
        return Folder(path, rig, asked.remove, until_idle=asked.until_idle)
    if path.is_dir():
        _check_options(asked, "a folder of videos")
        return Videos(path, rig, asked.videos_differ)
    if path.exists():
        _check_options(asked, "a table of blobs")
    rate = USUAL_RATE if asked.rate is None else asked.rate
    if not 0 < rate < 1e6:
        raise InputError(f"--rate: found {rate:g}, expected more than 0 and less than 1e6 snapshots per second")
    source = open_input(path, rig, labels)
    assert isinstance(source, Detections)  # folders are seen to above
    return BlobTable(source, rate)


def _open_address(address: str, rig: CameraRig) -> Source:
    if address.startswith("qtm://"):
        return Qualisys(address, rig)
    if address.startswith("lsl://"):
        _require("pylsl", address, "an address")
        return LabStreaming(address)
    if not address.startswith(("tcp://", "ipc://")):
        known = "tcp://host:port, ipc://path, qtm://host or lsl://name"
        raise InputError(f"{shorten(address)}: expected an address {known}")
    _require("zmq", address, "an address")
    return ZeroMQ((address,))


def _check_options(asked: arguments.Watch, kind: str) -> None:
    """Refuse options that have no effect on this kind of input.

    Raises:
        InputError: names the first of them, and what it is for.
    """
    for option, meant in ONLY_FOR.items():
        value = getattr(asked, option.replace("-", "_"))
        if meant != kind and not (value is None or value is False or value == ()):
            raise InputError(f"--{option}: needs {meant}, found {kind} ({shorten(asked.input)})")


def _require(library: str, given: str, what: str) -> None:
    if missing(library):
        raise InputError(f"{shorten(given)}: {what} {advice(library)}")


def _read_topics(given: tuple[str, ...]) -> dict[str, str]:
    """Read CAMERA=TOPIC pairs as topics by camera."""
    pairs = [text.partition("=") for text in given]
    wrong = [camera for camera, _, topic in pairs if not camera or not topic]
    if wrong:
        raise InputError(f"--topic: found {shorten(wrong[0])!r}, expected CAMERA=TOPIC")
    cameras = [camera for camera, _, _ in pairs]
    twice = [camera for camera in dict.fromkeys(cameras) if cameras.count(camera) > 1]
    if twice:
        raise InputError(f"--topic: found camera {shorten(twice[0])} twice, expected one topic per camera")
    return {camera: topic for camera, _, topic in pairs}

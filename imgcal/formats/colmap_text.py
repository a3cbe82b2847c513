"""COLMAP's text files, also the comma-separated ones of kapture, and rig_config.json."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from imgcal.errors import InputError
from imgcal.formats import places
from imgcal.formats.chains import IDENTITY, Pose
from imgcal.formats.colmap_model import (
    At,
    ColmapCamera,
    ColmapImage,
    ColmapRig,
    chosen_rig,
    common_prefix,
    model_from_rig,
    pose_from_quaternion,
    pose_numbers,
    rig_from_model,
)
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.source import Source
from imgcal.formats.values import array, mapping, number, numbers, rotation_from_quaternion, text

TITLE = "COLMAP model (text)"
CONFIG_TITLE = "COLMAP rig_config.json"
MOST_BYTES = 2**30
MOST_ROW = 2**26  # characters: the points of an image stand in one row


def _recognizes(source: Source) -> bool:
    return source.find_file("cameras.txt") is not None


def _read(source: Source) -> ForeignRig:
    path = source.find_file("cameras.txt")
    assert path is not None
    cameras = [_camera(row, line, path) for line, row in _rows(path)]
    rigs_path, images_path = source.find_file("rigs.txt"), source.find_file("images.txt")
    rigs = [_rig(row, line, rigs_path) for line, row in _rows(rigs_path)] if rigs_path else []
    if images_path is None and not any(len(rig.sensors) > 1 for rig in rigs):
        raise FormatError("found only intrinsics, expected images.txt or rigs.txt beside cameras.txt")
    return rig_from_model(FORMAT.name, cameras, list(_images(images_path)) if images_path else [], rigs, source.rig)


def _camera(row: list[str], number_of_line: int, path: Path) -> ColmapCamera:
    line = f"line {number_of_line}"
    if len(row) < 5:
        raise FormatError(f"cameras.txt: {line}: found {len(row)} values, expected ID MODEL WIDTH HEIGHT PARAMETERS")
    place = f"cameras.txt: {line}"
    width, height = int(number(row[2], place)), int(number(row[3], place))
    parameters = tuple(number(value, place) for value in row[4:])
    at = At(path, number_of_line, 3)
    return ColmapCamera(int(number(row[0], place)), row[1], (width, height), parameters, at)


def _rig(row: list[str], line: int, path: Path) -> ColmapRig:
    place, rest = f"rigs.txt: line {line}", list(row)

    def take(count: int, what: str) -> list[str]:
        if len(rest) < count:
            raise FormatError(f"{place}: ends in the middle of a {what}")
        taken = rest[:count]
        del rest[:count]
        return taken

    rig, _ = take(2, "rig")
    sensors: dict[int, Pose | None] = {}
    at: dict[int, At] = {}
    words = 0  # the kinds of the sensors so far: the other values are numbers
    while rest:
        kind, name = take(2, "sensor")
        words += 1
        pose: Pose | None = IDENTITY  # of the first one, the reference
        if words > 1:
            posed = take(1, "sensor") == ["1"]
            pose = pose_from_quaternion(numbers(take(7, "pose"), place), place) if posed else None
        if kind == "CAMERA":
            sensor = int(number(name, place))
            sensors[sensor] = pose
            if words > 1 and pose is not None:
                at[sensor] = At(path, line, len(row) - len(rest) - words - 7)
    return ColmapRig(int(number(rig, place)), sensors, at)


def _images(path: Path) -> Iterator[ColmapImage]:
    """Every second row is an image; those between hold its points, and may be empty."""
    expects_points = False
    for line, row in _rows(path, keep_empty=True):
        if expects_points:
            expects_points = False
            continue
        if not row:
            continue
        place = f"images.txt: line {line}"
        if len(row) < 10:
            raise FormatError(f"{place}: found {len(row)} values, expected ID QW QX QY QZ TX TY TZ CAMERA NAME")
        pose = pose_from_quaternion([number(value, place) for value in row[1:8]], place)
        at = At(path, line, 1)
        yield ColmapImage(int(number(row[0], place)), pose, int(number(row[8], place)), " ".join(row[9:]), at)
        expects_points = True


def _rows(path: Path, keep_empty: bool = False) -> Iterator[tuple[int, list[str]]]:
    """The rows of a text file without its remarks, split at spaces or commas; a long one (points) is cut."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: found {path.stat().st_size:,} bytes, expected at most {MOST_BYTES:,}")
        with open(path, encoding="utf-8", errors="replace") as file:
            for count in range(1, MOST_BYTES):
                row = file.readline(MOST_ROW)
                if not row:
                    return
                if len(row) >= MOST_ROW:
                    raise InputError(f"{path}: found a row of more than {MOST_ROW:,} characters")
                if row.lstrip().startswith("#") or (not row.strip() and not keep_empty):
                    continue
                yield count, row[:20_000].replace(",", " ").split()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _write(rig: ForeignRig) -> Files:
    cameras, images, colmap_rig, rig_from_world = model_from_rig(rig)

    def row(*values: Any) -> str:
        return " ".join(v if isinstance(v, str) else repr(float(v)) if isinstance(v, float) else str(v) for v in values)

    camera_rows = [row(c.id, c.model, *(c.image_size or (0, 0)), *map(float, c.parameters)) for c in cameras]
    image_rows = [row(i.id, *pose_numbers(i.pose).tolist(), i.camera, i.name.replace(" ", "_")) + "\n" for i in images]
    others = [
        part for sensor, pose in colmap_rig.sensors.items() if sensor != 1 and pose is not None
        for part in ("CAMERA", sensor, 1, *pose_numbers(pose).tolist())
    ]  # fmt: skip
    rig_row = row(1, len(cameras), "CAMERA", 1, *others)
    data = [part for image in images for part in ("CAMERA", image.camera, image.id)]
    frame_row = row(1, 1, *pose_numbers(rig_from_world).tolist(), len(images), *data)
    made = "# made by imgcal convert\n"
    return {
        "cameras.txt": (made + "\n".join(camera_rows) + "\n").encode(),
        "images.txt": (made + "\n".join(image_rows) + "\n").encode(),
        "rigs.txt": (made + rig_row + "\n").encode(),
        "frames.txt": (made + frame_row + "\n").encode(),
        "points3D.txt": made.encode(),
    }


def _configs(source: Source) -> tuple[Path, list[dict[str, Any]]]:
    """The rigs of a rig_config.json."""
    for document in source.documents:
        rigs = document.value
        if document.kind == "json" and isinstance(rigs, list) and rigs and all(isinstance(rig, dict) for rig in rigs):
            found = [rig for rig in rigs if isinstance(rig.get("cameras"), list)]
            if found and any(isinstance(c, dict) and "image_prefix" in c for c in found[0]["cameras"]):
                return document.path, rigs
    return Path(), []


def _config_names(rigs: list[dict[str, Any]]) -> list[str]:
    """What the prefixes of a rig's images have in common, where each has something of its own, else its number."""
    names = []
    for rig in rigs:
        entries = [entry for entry in rig.get("cameras") or [] if isinstance(entry, dict)]
        names.append("/".join(common_prefix([str(entry.get("image_prefix", "")).split("/")[:-1] for entry in entries])))
    return names if all(names) and len(set(names)) == len(names) else [str(n) for n in range(1, len(rigs) + 1)]


def _read_config(source: Source) -> ForeignRig:
    path, rigs = _configs(source)
    which = chosen_rig(_config_names(rigs), source.rig)
    cameras: list[ForeignCamera] = []
    without: list[str] = []
    root = None
    for place, value in enumerate(rigs[which]["cameras"], start=1):
        entry = mapping(value, f"camera {place}")
        prefix = text(entry.get("image_prefix", str(place)), f"camera {place}")
        name = prefix.rstrip("/").rpartition("/")[2] or str(place)
        if "camera_model_name" not in entry or "camera_params" not in entry:
            raise FormatError(f"camera {name}: no intrinsics (camera_model_name, camera_params are optional there, and "
                              "COLMAP estimates them): give the folder of the model instead")  # fmt: skip
        parameters = tuple(numbers(entry["camera_params"], f"camera {name}: camera_params"))
        row = ColmapCamera(place, text(entry["camera_model_name"], name), None, parameters)
        keys = (which, "cameras", place - 1)
        others = [Place(path, (*keys, "camera_params"), row.numbers)]
        row.lens()
        turn, shift = entry.get("cam_from_rig_rotation"), entry.get("cam_from_rig_translation")
        if entry.get("ref_sensor") is True:
            pose, root = IDENTITY, len(cameras)
        elif turn is None or shift is None:
            without.append(name)
            continue
        else:
            pose = rotation_from_quaternion(turn, name), array(shift, (3,), name)
            sign = numbers(turn, name)
            others += [
                Place(path, (*keys, "cam_from_rig_rotation"), _quaternion_like(sign)),
                Place(path, (*keys, "cam_from_rig_translation"), places.translation),
            ]
        cameras.append(row.camera(name, pose, *others))
    notes = ["COLMAP's pixels begin half a pixel earlier: cx and cy are smaller by 0.5 here"]
    if without:
        notes.append(f"{', '.join(without)}: left out, without a pose in the rig")
    if len(cameras) < 2:
        raise FormatError("fewer than two cameras have a pose: COLMAP estimates them later")
    return ForeignRig(CONFIG.name, tuple(cameras), None, "the rig's reference camera", tuple(notes), root=root)


def _quaternion_like(found: list[float]) -> places.Numbers:
    return lambda camera: places.near_quaternion(camera.rotation, found)


FORMAT = Format("colmap", TITLE, _recognizes, _read, _write, Holds((4, 8), fisheye=True), unit="m", cameras=(2, 256))
CONFIG = Format("colmap-rig-config", CONFIG_TITLE, lambda source: bool(_configs(source)[1]), _read_config)

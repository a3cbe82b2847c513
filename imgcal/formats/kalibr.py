"""Kalibr camchain: T_cn_cnm1 takes points of the camera before to this one, in metres, so that poses are chains."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from imgcal.formats import places
from imgcal.formats.chains import Link, Pose, compose, follow_links, inverse, pose_from_matrix
from imgcal.formats.fitting import Holds
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, Place
from imgcal.formats.format import Files, Format
from imgcal.formats.lens import Lens, Model
from imgcal.formats.source import Source
from imgcal.formats.values import array, coefficients, focal_length, image_size, mapping, numbers, text
from imgcal.io import Flow, yaml_text
from imgcal.messages import list_names

TITLE = "Kalibr camchain"
CAMERA = re.compile(r"cam(\d+)")
BETWEEN = re.compile(r"T_(cam\d+|imu\d*)_(cam\d+|imu\d*)")
ROTATION_SAME, PLACE_SAME = 1e-3, 1e-2  # rad; of the largest distance to the first camera
NO_LENS = {
    "omni": "an omnidirectional model (omni)", "ds": "a double sphere (ds)", "eucm": "an extended unified model (eucm)",
}  # fmt: skip
DISTORTIONS: dict[str, tuple[Model, tuple[int, ...]]] = {
    "radtan": ("opencv", (4, 5)), "plumb_bob": ("opencv", (4, 5)), "rational_polynomial": ("opencv", (8,)),
    "equidistant": ("fisheye", (4,)), "equi": ("fisheye", (4,)), "none": ("opencv", (0, 4)), "": ("opencv", (0, 4)),
}  # fmt: skip


def _recognizes(source: Source) -> bool:
    return any(
        CAMERA.fullmatch(key) and isinstance(value, dict) and "intrinsics" in value
        for key, value in source.merge().items()
    )


def _read(source: Source) -> ForeignRig:
    values = source.merge()
    twice = next((key for key in values if CAMERA.fullmatch(key) and len(_files_with_key(source, key)) > 1), None)
    if twice is not None:
        raise FormatError(f"{twice} is in {list_names(_files_with_key(source, twice))}: give one of these files")
    entries = {key: mapping(values[key], key) for key in values if CAMERA.fullmatch(key)}
    names = sorted(entries, key=lambda name: int(name[3:]))
    lenses = {name: _lens(name, entries[name]) for name in names}
    links = _links(values, entries, names)
    root = names[0]
    notes = ["T_cn_cnm1 maps points from the previous camera to this one; in metres, like Kalibr's targets"]
    direct = [link for link in links if "imu" not in (link.destination, link.source)]
    try:
        poses = follow_links(root, names, direct)
    except FormatError:
        poses = follow_links(root, names, links)
        notes.append("some cameras are linked by the IMU only (T_cam_imu)")
    if off := _contradictions(links, poses):
        notes.append(f"{list_names(off)}: contradicts the other poses in the file; T_cn_cnm1 counts before T_cam_imu")
    cameras = tuple(
        ForeignCamera(name, lenses[name], image_size(entries[name].get("resolution"), name), *poses[name])
        for name in names
    )
    cameras = tuple(replace(camera, places=_places(source, values, camera, names)) for camera in cameras)
    return ForeignRig(FORMAT.name, cameras, "m", f"camera {root}", tuple(notes), root=0)


def _places(source: Source, values: dict[str, Any], camera: ForeignCamera, names: list[str]) -> tuple[Place, ...]:
    """Where a camera's numbers stand; poses to the IMU go along with the camera."""
    name, entry = camera.name, values[camera.name]
    before = (camera.rotation, camera.translation)
    path = _find_path(source, name)
    found = [
        Place(path, (name, "intrinsics"), places.focal_and_centre),
        Place(path, (name, "distortion_coeffs"), places.coefficients(len(camera.lens.coefficients))),
    ]
    if "T_cn_cnm1" in entry and names.index(name):
        found.append(Place(path, (name, "T_cn_cnm1"), places.matrix_rows, relative_to=names.index(name) - 1))
    if "T_cam_imu" in entry:
        pose = _pose(entry["T_cam_imu"], "T_cam_imu")
        found.append(Place(path, (name, "T_cam_imu"), places.carry_pose(before, pose, places.matrix_rows)))
    elif "T_imu_cam" in entry:
        pose = inverse(_pose(entry["T_imu_cam"], "T_imu_cam"))
        found.append(Place(path, (name, "T_imu_cam"), places.carry_pose(before, pose, places.inverse_rows)))
    groups = [((), values), *(((other,), values[other]) for other in names)]
    for outer, group in groups:
        for key, value in group.items():
            between = BETWEEN.fullmatch(key)
            if between is None or value is None or name not in between.groups():
                continue
            path = _find_path(source, outer[0] if outer else key)
            if between[1] == name and between[2] in names:
                of: places.Numbers = places.matrix_rows
                base: int | None = names.index(between[2])
            elif between[2] == name and between[1] in names:
                continue  # it is among the other camera's
            elif between[1] == name:
                of, base = places.carry_pose(before, _pose(value, key), places.matrix_rows), None
            else:
                of, base = places.carry_pose(before, inverse(_pose(value, key)), places.inverse_rows), None
            found.append(Place(path, (*outer, key), of, relative_to=base))
    return tuple(found)


def _find_path(source: Source, key: str) -> Path:
    return next(document.path for document, values in source.mappings if key in values)


def _files_with_key(source: Source, key: str) -> list[str]:
    """Names of the files with a key."""
    return [document.path.name for document, values in source.mappings if key in values]


def _lens(name: str, entry: dict[str, Any]) -> Lens:
    model = text(entry.get("camera_model", "pinhole"), f"{name}: camera_model").lower()
    kind = text(entry.get("distortion_model", "none"), f"{name}: distortion_model").lower()
    if model in NO_LENS:
        raise FormatError(
            f"{name}: {NO_LENS[model]}, which no other format here can express; calibrate with pinhole-radtan or "
            "pinhole-equi"
        )
    if model == "fov" or kind == "fov":
        raise FormatError(f"{name}: the FOV distortion is not supported; calibrate with radtan or equidistant")
    if model != "pinhole" or kind not in DISTORTIONS:
        raise FormatError(f"{name}: found the model {model}-{kind}, expected pinhole with radtan or equidistant")
    fx, fy, cx, cy = array(entry.get("intrinsics"), (4,), f"{name}: intrinsics").tolist()
    family, counts = DISTORTIONS[kind]
    ks = coefficients(entry.get("distortion_coeffs"), f"{name}: distortion_coeffs", counts)
    if kind in ("none", "") and any(ks):
        raise FormatError(f"{name}: found distortion_coeffs without a distortion_model")
    ks = () if kind in ("none", "") else ks
    focal = focal_length(fx, fy, f"{name}: intrinsics")
    return Lens(focal, (cx, cy), ks, family)


def _links(values: dict[str, Any], entries: dict[str, dict[str, Any]], names: list[str]) -> list[Link]:
    """Whatever says where one camera is relative to another, or to the IMU; what is nearest to Kalibr's own first."""
    links = []
    for number, name in enumerate(names):
        if number and "T_cn_cnm1" in entries[name]:
            links.append(Link(name, names[number - 1], _pose(entries[name]["T_cn_cnm1"], f"{name}: T_cn_cnm1")))
    for place, group in (("", values), *((f"{name}: ", entry) for name, entry in entries.items())):
        for key, value in group.items():
            if (between := BETWEEN.fullmatch(key)) and value is not None:
                links.append(Link(_node(between[1]), _node(between[2]), _pose(value, place + key)))
    for name, entry in entries.items():
        if "T_cam_imu" in entry:
            links.append(Link(name, "imu", _pose(entry["T_cam_imu"], f"{name}: T_cam_imu")))
        elif "T_imu_cam" in entry:  # OpenVINS
            links.append(Link(name, "imu", inverse(_pose(entry["T_imu_cam"], f"{name}: T_imu_cam"))))
    return links


def _contradictions(links: list[Link], poses: dict[str, Pose]) -> list[str]:
    """Name the links that contradict the cameras' poses; the first link to the IMU defines its pose."""
    known = dict(poses)
    size = max(float(np.linalg.norm(pose[1])) for pose in poses.values())
    off = []
    for link in links:
        if link.source not in known and link.destination in known:
            known[link.source] = compose(inverse(link.pose), known[link.destination])
        if not {link.source, link.destination} <= known.keys():
            continue
        turned, moved = compose(known[link.destination], inverse(known[link.source]))
        shift = float(np.linalg.norm(moved - link.pose[1]))
        if np.abs(turned - link.pose[0]).max() > ROTATION_SAME or shift > PLACE_SAME * size:
            off.append(f"{link.destination} from {link.source}")
    return list(dict.fromkeys(off))


def _node(name: str) -> str:
    return "imu" if name.startswith("imu") else name


def _pose(value: Any, what: str) -> Pose:
    rows = len(numbers(value, what)) // 4
    return pose_from_matrix(array(value, (4 if rows == 4 else 3, 4), what), what)


def _write(rig: ForeignRig) -> Files:
    content: dict[str, Any] = {}
    for number, camera in enumerate(rig.cameras):
        entry: dict[str, Any] = {}
        if number:
            before = rig.cameras[number - 1]
            turned = camera.rotation @ before.rotation.T
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turned, camera.translation - turned @ before.translation
            entry["T_cn_cnm1"] = [Flow(row) for row in pose.tolist()]
        fisheye = camera.lens.model == "fisheye"
        entry |= {
            "cam_overlaps": Flow(other for other in range(len(rig.cameras)) if other != number),
            "camera_model": "pinhole",
            "distortion_coeffs": Flow(camera.lens.pad(4)),
            "distortion_model": "equidistant" if fisheye else "radtan",
            "intrinsics": Flow([*camera.lens.focal_length, *camera.lens.principal_point]),
            "resolution": Flow(camera.image_size or ()),
            "rostopic": f"/{camera.name}/image_raw",
        }
        content[f"cam{number}"] = entry
    return {"": yaml_text(content).encode()}


FORMAT = Format(
    "kalibr", TITLE, _recognizes, _read, _write, Holds((4,), fisheye=True), states_unit=True, from_first=True,
    numbers_cameras=True, stem="camchain",
)  # fmt: skip

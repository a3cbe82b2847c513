"""Independent readers: calibrations of other tools, read by general parsers and projected by OpenCV.

They use no code of imgcal, only YAML, TOML, JSON and XML parsers, OpenCV's FileStorage and pycolmap, and follow the
descriptions of the formats. The output of `write_back.py` is checked with them.
"""

from __future__ import annotations

import ast
import importlib
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml

Projection = Callable[
    [Any], Any
]  # (N, 3) points in the file's frame and unit -> (N, 2) pixels, (0, 0) = centre of the first pixel
HALF = 0.5  # COLMAP's pixel coordinates of the first pixel's centre


def pinhole(turn: Any, shift: Any, k: Any, d: Any, fisheye: bool = False, half: float = 0.0) -> Projection:
    """Make an OpenCV camera; `turn` is the rotation vector or matrix of camera_from_world."""
    turn, shift = np.array(turn, dtype=float), np.array(shift, dtype=float).reshape(3, 1)
    vector = turn.reshape(3, 1) if turn.size == 3 else cv2.Rodrigues(turn.reshape(3, 3))[0]
    k, d = np.array(k, dtype=float).reshape(3, 3), np.array(d, dtype=float).ravel()
    if fisheye:
        return lambda points: cv2.fisheye.projectPoints(points[:, None], vector, shift, k, d[:4])[0][:, 0] - half
    return lambda points: cv2.projectPoints(points, vector, shift, k, d)[0][:, 0] - half


def matrix_of(fx: float, fy: float, cx: float, cy: float) -> Any:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=float)


def rotation_of(w: float, x: float, y: float, z: float) -> Any:
    """Rotation matrix of a unit quaternion."""
    scalar, vector = w, np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (scalar**2 - vector @ vector) * np.eye(3) + 2 * np.outer(vector, vector) + 2 * scalar * cross


def storage(path: Path) -> Callable[[str], Any]:
    """Open an OpenCV FileStorage; returns a function that reads a matrix."""
    opened = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    return lambda key: opened.getNode(key).mat()


def opencv_stereo(path: Path) -> dict[str, Projection]:
    inside, outside = storage(path / "intrinsics.yml"), storage(path / "extrinsics.yml")
    first = pinhole(np.eye(3), np.zeros(3), inside("M1"), inside("D1"))
    return {"1": first, "2": pinhole(outside("R"), outside("T"), inside("M2"), inside("D2"))}


def opencv_multiview(path: Path) -> dict[str, Projection]:
    read = storage(path)
    turns, shifts, k = read("Rs").reshape(-1, 3), read("Ts").reshape(-1, 3), read("Ks").reshape(-1, 3, 3)
    d, models = read("distortions").reshape(len(turns), -1), read("models").ravel()
    return {str(n): pinhole(turns[n], shifts[n], k[n], d[n], models[n] == 1) for n in range(len(turns))}


def easymocap(path: Path) -> dict[str, Projection]:
    inside, outside = storage(path / "intri.yml"), storage(path / "extri.yml")
    opened = cv2.FileStorage(str(path / "extri.yml"), cv2.FILE_STORAGE_READ)
    names = opened.getNode("names")
    every = [names.at(n).string() for n in range(names.size())]
    return {n: pinhole(outside(f"Rot_{n}"), outside(f"T_{n}"), inside(f"K_{n}"), inside(f"dist_{n}")) for n in every}


def kalibr(path: Path) -> dict[str, Projection]:
    found, pose = {}, np.eye(4)
    for name, camera in yaml.safe_load(path.read_text()).items():
        pose = np.array(camera.get("T_cn_cnm1", np.eye(4))) @ pose
        fisheye = camera["distortion_model"] == "equidistant"
        k, d = matrix_of(*camera["intrinsics"]), camera["distortion_coeffs"]
        found[name] = pinhole(pose[:3, :3], pose[:3, 3], k, d, fisheye)
    return found


def ros(path: Path) -> dict[str, Projection]:
    """One camera, or a pair: X_right = R_right^T (R_left X_left + (P[0, 3] / P[0, 0], 0, 0))."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    every = [yaml.safe_load(file.read_text()) for file in files]
    rectified = np.array(every[0]["rectification_matrix"]["data"]).reshape(3, 3)
    found = {}
    for number, one in enumerate(every):
        k, d = one["camera_matrix"]["data"], one["distortion_coefficients"]["data"]
        p, own = one["projection_matrix"]["data"], np.array(one["rectification_matrix"]["data"]).reshape(3, 3)
        turn = own.T @ rectified if number else np.eye(3)
        shift = own.T @ [p[3] / p[0], 0, 0] if number else np.zeros(3)
        fisheye = one["distortion_model"] == "equidistant"
        found[one["camera_name"].replace("/", "_")] = pinhole(turn, shift, k, d, fisheye)
    return found


def toml_cameras(path: Path) -> dict[str, Projection]:
    """One table per camera: anipose, FreeMoCap, Pose2Sim, caliscope (under `cameras` in newer files)."""
    text = "\n".join(line for line in path.read_text().splitlines() if not line.startswith("CreationDate"))
    values = tomllib.loads(text)
    values = values.get("cameras", values)
    placed = {
        name: one
        for name, one in values.items()
        if isinstance(one, dict) and "matrix" in one and isinstance(one.get("rotation"), list)
    }
    return {
        str(one.get("name", one.get("cam_id", one.get("port", name)))): pinhole(
            one["rotation"], one["translation"], one["matrix"], one["distortions"], one.get("fisheye") is True
        )
        for name, one in placed.items()
    }


def multical(path: Path) -> dict[str, Projection]:
    """`B_to_A` is B_from_A."""
    values = json.loads(path.read_text())
    poses = {name.split("_to_")[0]: pose for name, pose in values["camera_poses"].items()}
    return {
        name: pinhole(poses[name]["R"], poses[name]["T"], one["K"], one["dist"])
        for name, one in values["cameras"].items()
    }


def mrcal(path: Path) -> dict[str, Projection]:
    found = {}
    for file in sorted(path.iterdir()):
        model = ast.literal_eval(file.read_text())
        (*four,), turn, shift = model["intrinsics"][:4], model["extrinsics"][:3], model["extrinsics"][3:]
        found[file.stem] = pinhole(turn, shift, matrix_of(*four), model["intrinsics"][4:])
    return found


def pymvg(path: Path) -> dict[str, Projection]:
    cameras = json.loads(path.read_text())["camera_system"]
    return {str(one["name"]): pinhole(one["Q"], one["translation"], one["K"], one["D"]) for one in cameras}


def colmap_camera(model: str, numbers: Any) -> tuple[Any, list[float], bool]:
    """K, distortion, and whether the camera is a fisheye."""
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        f, cx, cy, *ks = numbers
        return matrix_of(f, f, cx, cy), [*ks, 0, 0, 0, 0][:4] if model != "SIMPLE_PINHOLE" else [0.0] * 4, False
    k, rest = matrix_of(*numbers[:4]), list(numbers[4:])
    if model == "FULL_OPENCV":
        return k, rest, False
    return k, rest or [0.0] * 4, model == "OPENCV_FISHEYE"


def colmap(path: Path) -> dict[str, Projection]:
    """The rig of a model, by pycolmap; kapture's comma-separated variant, which pycolmap rejects, by hand."""
    if not (path / "rigs.txt").is_file() and not (path / "rigs.bin").is_file():
        return kapture(path)
    pycolmap = importlib.import_module("pycolmap")
    model = pycolmap.Reconstruction(str(path))
    (rig,) = model.rigs.values()
    poses = {rig.ref_sensor_id.id: pycolmap.Rigid3d()}
    poses |= {sensor.id: pose for sensor, pose in rig.non_ref_sensors.items()}

    def projection(number: int) -> Projection:
        camera, pose = model.cameras[number], poses[number]
        return lambda points: np.array([camera.img_from_cam(pose * point) for point in points]) - HALF

    return {str(number): projection(number) for number in poses}


def kapture(path: Path) -> dict[str, Projection]:
    rows = [row.replace(",", " ").split() for row in (path / "cameras.txt").read_text().splitlines() if row[:1] != "#"]
    lenses = {row[0]: colmap_camera(row[1], list(map(float, row[4:]))) for row in rows if row}
    found: dict[str, Projection] = {}
    for row in (path / "images.txt").read_text().splitlines():
        cells = row.replace(",", " ").split()
        if len(cells) != 10 or row.startswith("#"):
            continue
        name = cells[9].split("/")[0]
        w, x, y, z, *shift = map(float, cells[1:8])
        if name not in found:  # images of the first snapshot come first
            k, d, fisheye = lenses[cells[8]]
            found[name] = pinhole(rotation_of(w, x, y, z), shift, k, d, fisheye, HALF)
    return found


def colmap_rig_config(path: Path) -> dict[str, Projection]:
    found = {}
    for one in json.loads(path.read_text())[0]["cameras"]:
        k, d, fisheye = colmap_camera(one["camera_model_name"], one["camera_params"])
        turn = rotation_of(*one.get("cam_from_rig_rotation", (1, 0, 0, 0)))
        name = one["image_prefix"].rstrip("/").split("/")[-1]
        found[name] = pinhole(turn, one.get("cam_from_rig_translation", (0, 0, 0)), k, d, fisheye, HALF)
    return found


def vicon(path: Path) -> dict[str, Projection]:
    return {one.attrib["DEVICEID"]: vicon_camera(one) for one in ElementTree.parse(path).getroot().iter("Camera")}


def vicon_camera(camera: ElementTree.Element) -> Projection:
    """A quaternion and a centre; the lens maps image points to ideal ones, and is inverted by iteration."""
    frame = next(camera.iter("KeyFrame"))
    x, y, z, w = map(float, frame.attrib["ORIENTATION"].split())
    turn = rotation_of(w, x, y, z) / (w * w + x * x + y * y + z * z)
    place = np.array(frame.attrib["POSITION"].split(), dtype=float)
    centre = np.array(frame.attrib["PRINCIPAL_POINT"].split(), dtype=float)
    aspect, focal = float(camera.attrib["PIXEL_ASPECT_RATIO"]), float(frame.attrib["FOCAL_LENGTH"])
    cx, cy, *ks = map(float, frame.attrib["VICON_RADIAL2"].split()[1:])

    def project(points: Any) -> Any:
        inside = (points - place) @ turn.T
        ideal = inside[:, :2] / inside[:, 2:] * [focal, focal / aspect] + centre
        found = ideal
        for _ in range(200):
            away = found - [cx, cy]
            square = away[:, :1] ** 2 + (away[:, 1:] * aspect) ** 2
            found = ideal - away * sum(k * square ** (n + 1) for n, k in enumerate(ks))
        return found

    return project


def motive(path: Path) -> dict[str, Projection]:
    """World axes of a camera that looks along its -z, y up; metres."""
    text = path.read_bytes().decode("utf-16").replace('encoding="UTF-16LE"', "")
    found = {}
    for camera in ElementTree.fromstring(text).iter("Camera"):
        pose, lens = camera.find("Extrinsic"), camera.find("IntrinsicStandardCameraModel")
        if pose is None or lens is None:
            continue
        axes = np.array([float(pose.attrib[f"OrientMatrix{n}"]) for n in range(9)]).reshape(3, 3)
        turn = np.diag([1.0, -1.0, -1.0]) @ axes.T
        names = ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
        k = matrix_of(*(float(lens.attrib[key]) for key in names))
        d = [float(lens.attrib[key]) for key in ("k1", "k2", "TangentialX", "TangentialY", "k3")]
        place = np.array([float(pose.attrib[axis]) for axis in "XYZ"])
        found[camera.attrib["Serial"]] = pinhole(turn, -turn @ place, k, d)
    return found


def qualisys(path: Path) -> dict[str, Projection]:
    """The same axes; 1/64 pixels; millimetres."""
    found = {}
    for camera in ElementTree.parse(path).getroot().iter("camera"):
        pose, lens = camera.find("transform"), camera.find("intrinsic")
        if pose is None or lens is None:
            continue
        axes = np.array([float(pose.attrib[f"r{row}{column}"]) for row in (1, 2, 3) for column in (1, 2, 3)])
        turn = np.diag([1.0, -1.0, -1.0]) @ axes.reshape(3, 3)
        focal_and_centre = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        k = matrix_of(*(float(lens.attrib[key]) / 64 for key in focal_and_centre))
        radial, turned = "radialDistortion", "tangentalDistortion"
        d = [float(lens.attrib[f"{key}{n}"]) for key, n in ((radial, 1), (radial, 2), (turned, 1), (turned, 2))]
        place = np.array([float(pose.attrib[axis]) for axis in "xyz"])
        found[camera.attrib["serial"]] = pinhole(turn, -turn @ place, k, [*d, float(lens.attrib[f"{radial}3"])])
    return found


READERS: dict[str, tuple[str, Callable[[Path], dict[str, Projection]]]] = {
    "vicon": ("XML parser", vicon),
    "motive": ("XML parser, OpenCV", motive),
    "qualisys": ("XML parser, OpenCV", qualisys),
    "opencv-stereo": ("OpenCV FileStorage", opencv_stereo),
    "opencv-multiview": ("OpenCV FileStorage", opencv_multiview),
    "easymocap": ("OpenCV FileStorage", easymocap),
    "kalibr": ("PyYAML, OpenCV", kalibr),
    "ros": ("PyYAML, OpenCV", ros),
    "anipose": ("tomllib, OpenCV", toml_cameras),
    "freemocap": ("tomllib, OpenCV", toml_cameras),
    "pose2sim": ("tomllib, OpenCV", toml_cameras),
    "caliscope": ("tomllib, OpenCV", toml_cameras),
    "caliscope-config": ("tomllib, OpenCV", toml_cameras),
    "multical": ("json, OpenCV", multical),
    "mrcal": ("Python's parser, OpenCV", mrcal),
    "pymvg": ("json, OpenCV", pymvg),
    "colmap": ("pycolmap", colmap),
    "colmap-binary": ("pycolmap", colmap),
    "colmap-rig-config": ("json, OpenCV", colmap_rig_config),
}

"""The tools' own readers, run as a program without imgcal in any Python that has the tool.

Standard input: JSON with `tool`, `path` and `points` (camera -> points in the files' frame and unit). Standard output:
the tool's projections of the points after it has read the files (camera -> pixels), and its version.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

Points = dict[str, Any]  # camera -> (N, 3)
Answer = tuple[dict[str, Any], str]  # camera -> (N, 2), and the version

HALF = 0.5  # COLMAP's pixel coordinates of the first pixel's centre


def version_of(*names: str) -> str:
    """Version of the first of these distributions that is installed."""
    for name in names:
        try:
            return f"{name} {metadata.version(name)}"
        except metadata.PackageNotFoundError:
            continue
    return names[0]


def opencv(points: Any, rotation: Any, translation: Any, k: Any, d: Any, fisheye: bool = False) -> Any:
    """Project points with OpenCV."""
    import cv2

    rotation, translation = np.array(rotation, dtype=float), np.array(translation, dtype=float).reshape(3, 1)
    vector = rotation.reshape(3, 1) if rotation.size == 3 else cv2.Rodrigues(rotation.reshape(3, 3))[0]
    d = np.array(d, dtype=float).ravel()
    if fisheye:
        return cv2.fisheye.projectPoints(points[:, None], vector, translation, np.array(k), d[:4])[0][:, 0]
    return cv2.projectPoints(points, vector, translation, np.array(k), d)[0][:, 0]


def storage(path: Path) -> Callable[[str], Any]:
    """Open an OpenCV FileStorage; returns a function that reads a matrix."""
    import cv2

    opened = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    return lambda key: opened.getNode(key).mat()


def read_opencv_stereo(path: Path, points: Points) -> Answer:
    inside, outside = storage(path / "intrinsics.yml"), storage(path / "extrinsics.yml")
    first, second = points
    uv = {first: opencv(points[first], np.eye(3), np.zeros(3), inside("M1"), inside("D1"))}
    uv[second] = opencv(points[second], outside("R"), outside("T"), inside("M2"), inside("D2"))
    return uv, f"OpenCV {importlib.import_module('cv2').__version__}"


def read_opencv_multiview(path: Path, points: Points) -> Answer:
    read = storage(path)
    count = len(points)
    r, t = read("Rs").reshape(count, 3), read("Ts").reshape(count, 3)
    k, d, models = read("Ks").reshape(count, 3, 3), read("distortions").reshape(count, -1), read("models").ravel()
    uv = {n: opencv(p, r[i], t[i], k[i], d[i], models[i] == 1) for i, (n, p) in enumerate(points.items())}
    return uv, f"OpenCV {importlib.import_module('cv2').__version__}"


def read_easymocap(path: Path, points: Points) -> Answer:
    inside, outside = storage(path / "intri.yml"), storage(path / "extri.yml")
    uv = {
        n: opencv(p, outside(f"Rot_{n}"), outside(f"T_{n}"), inside(f"K_{n}"), inside(f"dist_{n}"))
        for n, p in points.items()
    }
    return uv, f"OpenCV {importlib.import_module('cv2').__version__}, with EasyMocap's keys"


def read_anipose(path: Path, points: Points) -> Answer:
    cameras = importlib.import_module("aniposelib.cameras")
    group = cameras.CameraGroup.load(str(path))
    named = {camera.get_name(): camera for camera in group.cameras}
    return {n: named[n].project(p)[:, 0] for n, p in points.items()}, version_of("aniposelib")


def read_pose2sim(path: Path, points: Points) -> Answer:
    common = importlib.import_module("Pose2Sim.common")
    found = common.retrieve_calib_params(path)
    uv = {
        n: opencv(p, found["R"][i], found["T"][i], found["K"][i], found["dist"][i])
        for i, (n, p) in enumerate(points.items())
    }
    return uv, version_of("pose2sim")


def read_caliscope(path: Path, points: Points) -> Answer:
    array = importlib.import_module("caliscope.cameras.camera_array").CameraArray.from_toml(path)
    uv = {}
    for name, p in points.items():
        camera = array.cameras[int(name)]
        uv[name] = opencv(p, camera.rotation, camera.translation, camera.matrix, camera.distortions, camera.fisheye)
    return uv, version_of("caliscope")


def read_colmap(path: Path, points: Points) -> Answer:
    pycolmap = importlib.import_module("pycolmap")
    model = pycolmap.Reconstruction(str(path))
    uv = {}
    for image in model.images.values():
        inside = [image.cam_from_world() * point for point in points[image.name.split("/")[0]]]
        uv[image.name.split("/")[0]] = np.array([image.camera.img_from_cam(point) for point in inside]) - HALF
    return uv, version_of("pycolmap")


def read_multical(path: Path, points: Points) -> Answer:
    reader = importlib.import_module("multical.io.import_calib")
    structs = importlib.import_module("structs.struct")
    data = structs.to_structs(json.loads(path.read_text()))
    poses = reader.import_pose_graph(data.camera_poses, list(data.cameras.keys()))
    uv = {}
    for name, p in points.items():
        inside = p @ poses[name][:3, :3].T + poses[name][:3, 3]
        uv[name] = reader.import_camera(data.cameras[name]).project(inside)
    return uv, version_of("multical")


def read_mrcal(path: Path, points: Points) -> Answer:
    mrcal = importlib.import_module("mrcal")
    uv = {}
    for name, p in points.items():
        model = mrcal.cameramodel(str(path / f"{name}.cameramodel"))
        uv[name] = mrcal.project(mrcal.transform_point_rt(model.extrinsics_rt_fromref(), p), *model.intrinsics())
    return uv, "mrcal (Debian)"


def read_pymvg(path: Path, points: Points) -> Answer:
    module = importlib.import_module("pymvg.multi_camera_system")
    system = module.MultiCameraSystem.from_pymvg_file(str(path))
    return {n: np.array([system.find2d(n, point) for point in p]) for n, p in points.items()}, version_of("pymvg")


def read_ros(path: Path, points: Points) -> Answer:
    """ROS: its stereo model projects into rectified images; map these back by the file's K, D, R."""
    parsers, geometry = (importlib.import_module(name) for name in ("camera_calibration_parsers", "image_geometry"))
    infos = {name: parsers.readCalibration(str(path / f"{name}.yaml"))[1] for name in points}
    left, right = infos
    stereo = geometry.StereoCameraModel()
    stereo.fromCameraInfo(infos[left], infos[right])
    uv = {}
    for name, p in points.items():
        rectified = p @ np.array(infos[left].R).reshape(3, 3).T
        pixels = np.array([stereo.project3dToPixel(point)[name == right] for point in rectified])
        info = infos[name]
        projection = np.array(info.P).reshape(3, 4)
        rays = np.concatenate((pixels, np.ones((len(pixels), 1))), axis=1) @ np.linalg.inv(projection[:, :3]).T
        fisheye = info.distortion_model == "equidistant"
        rotation = np.array(info.R).reshape(3, 3).T
        uv[name] = opencv(rays, rotation, np.zeros(3), np.array(info.K).reshape(3, 3), info.D, fisheye)
    return uv, "camera_calibration_parsers, image_geometry (Debian)"


READERS = {
    "opencv-stereo": read_opencv_stereo,
    "opencv-multiview": read_opencv_multiview,
    "easymocap": read_easymocap,
    "anipose": read_anipose,
    "freemocap": read_anipose,
    "pose2sim": read_pose2sim,
    "caliscope": read_caliscope,
    "colmap": read_colmap,
    "colmap-binary": read_colmap,
    "multical": read_multical,
    "mrcal": read_mrcal,
    "pymvg": read_pymvg,
    "ros": read_ros,
}


def main() -> None:
    """Read a request and answer it."""
    given = json.load(sys.stdin)
    points = {name: np.array(rows) for name, rows in given["points"].items()}
    uv, version = READERS[given["tool"]](Path(given["path"]), points)
    sys.stdout.write("\n" + json.dumps({"uv": {n: np.asarray(p).tolist() for n, p in uv.items()}, "version": version}))


if __name__ == "__main__":
    main()

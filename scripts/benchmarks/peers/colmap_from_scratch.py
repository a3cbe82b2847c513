"""COLMAP's incremental mapping: every fiducial of every snapshot is a point of one static scene."""

from __future__ import annotations

import time
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scripts.benchmarks.peer import peer
from scripts.benchmarks.peers.rig_task import Array, RigAnswer

Rows = NDArray[np.int64]
CENTRE = 0.5  # px, COLMAP's coordinate of the top-left pixel's centre


def solve(uv: Array, seen: Array, points: Array, focal: Array, image_size: Array) -> RigAnswer:
    """Calibrate from scratch; the object is only used at the end, for the scale.

    Args:
        uv: (S, C, N, 2) pixels.
        seen: (S, C, N).
        points: (N, 3) mm.
        focal: (C, 2) pixels, rough.
        image_size: (C, 2) pixels.

    Raises:
        ValueError: not all cameras were registered.
    """
    pycolmap = peer("pycolmap")
    assert pycolmap is not None
    pycolmap.logging.minloglevel = 3
    cameras = seen.shape[1]
    with TemporaryDirectory() as folder:
        begin = time.perf_counter()
        index = _database(pycolmap, Path(folder) / "database.db", uv, seen, focal, image_size)
        options = pycolmap.IncrementalPipelineOptions()
        options.extract_colors = False
        options.num_threads = 1
        options.multiple_models = False
        options.ba_refine_principal_point = False
        found = pycolmap.incremental_mapping(Path(folder) / "database.db", folder, Path(folder) / "out", options)
        scene = max(found.values(), key=lambda model: model.num_reg_images(), default=None)
        if scene is None or scene.num_reg_images() < cameras:
            raise ValueError(f"{0 if scene is None else scene.num_reg_images()} of {cameras} cameras")
        refined = pycolmap.BundleAdjustmentOptions()
        refined.refine_principal_point, refined.print_summary = True, False
        pycolmap.bundle_adjustment(scene, refined)
        seconds = time.perf_counter() - begin
    return _answer(scene, index, seen, points, seconds)


def _database(pycolmap: Any, path: Path, uv: Array, seen: Array, focal: Array, image_size: Array) -> list[Rows]:
    """Write keypoints and matches; return the point of each keypoint of each camera."""
    cameras = seen.shape[1]
    flat_seen, flat_uv = seen.swapaxes(1, 2).reshape(-1, cameras), uv.swapaxes(1, 2).reshape(-1, cameras, 2)
    index = [np.flatnonzero(flat_seen[:, c]) for c in range(cameras)]
    known = []
    with pycolmap.Database.open(path) as database:
        for c in range(cameras):
            width, height = (int(v) for v in image_size[c])
            params = [*focal[c], width / 2, height / 2, 0, 0, 0, 0]
            camera = pycolmap.Camera(model="OPENCV", width=width, height=height, params=params, camera_id=c + 1)
            camera.has_prior_focal_length = True
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=c + 1)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
            frame = pycolmap.Frame(frame_id=c + 1, rig_id=c + 1)
            image = pycolmap.Image(name=f"{c + 1}.png", camera_id=c + 1, image_id=c + 1, frame_id=c + 1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_image(image, use_image_id=True)
            keypoints = flat_uv[index[c], c] + CENTRE
            database.write_keypoints(c + 1, keypoints.astype(np.float32))
            known.append((camera, keypoints))
        for a, b in combinations(range(cameras), 2):
            _, rows, columns = np.intersect1d(index[a], index[b], return_indices=True)
            matches = np.stack((rows, columns), axis=1).astype(np.uint32)
            if len(matches) < 15:
                continue
            database.write_matches(a + 1, b + 1, matches)
            options = pycolmap.TwoViewGeometryOptions()
            options.ransac.max_error = 20.0  # px, since the lenses are unknown
            geometry = pycolmap.estimate_calibrated_two_view_geometry(*known[a], *known[b], matches, options)
            database.write_two_view_geometry(a + 1, b + 1, geometry)
    return index


def _answer(scene: Any, index: list[Rows], seen: Array, points: Array, seconds: float) -> RigAnswer:
    """Scale the scene to the size of the object."""
    snapshots, cameras, fiducials = seen.shape
    place = np.full((snapshots * fiducials, 3), np.nan)
    for point in scene.points3D.values():
        element = point.track.elements[0]
        place[index[element.image_id - 1][element.point2D_idx]] = point.xyz
    placed = place.reshape(snapshots, fiducials, 3)
    pairs = np.array(list(combinations(range(fiducials), 2)))
    length = np.linalg.norm(placed[:, pairs[:, 0]] - placed[:, pairs[:, 1]], axis=-1)
    scale = 1 / float(np.nanmedian(length / np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=-1)))
    poses = [scene.images[c + 1].cam_from_world() for c in range(cameras)]
    params = np.stack([scene.cameras[c + 1].params for c in range(cameras)])
    return RigAnswer(
        params[:, :2],
        params[:, 2:4] - CENTRE,
        np.concatenate((params[:, 4:8], np.zeros((cameras, 1))), axis=1),
        np.stack([pose.rotation.matrix() for pose in poses]),
        np.stack([pose.translation for pose in poses]) * scale,
        seconds,
    )

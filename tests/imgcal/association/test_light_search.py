"""Places found by compiled loops are those that plain NumPy finds, and blobs go to one marker each."""

import numpy as np
import torch

import imgcal
from imgcal.association.light_search import REACH, find_lights
from imgcal.association.lights import sort_blobs
from scripts.benchmarks.lights import Scene, simulate

GATE = 0.5  # px


def found_in(scene: Scene, moment: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blobs (rows of the detections) and places of one moment, for the true rig."""
    rig = scene.rig
    blobs = scene.detections.select(scene.detections.snapshot == moment)
    rows = np.flatnonzero(scene.detections.snapshot == moment)
    blobs = imgcal.Detections(**(vars(blobs) | {"snapshot": np.zeros(len(blobs), dtype=int), "snapshot_names": ("0",)}))
    there = sort_blobs(blobs, rig)
    focal = rig.focal_length.numpy()
    most, cameras = len(there.xy), rig.num_cameras
    chosen, point = np.full((most, cameras), -1), np.empty((most, 3))
    count = find_lights(
        there.xy, there.start[0], np.ascontiguousarray(rig.cam_from_rig.rotation.numpy()),
        np.ascontiguousarray(rig.positions.numpy()), np.full(cameras, GATE) / focal.mean(1),
        0.5 * rig.image_size.double().numpy() / focal, 6.0, 3, chosen, point, np.empty(most), np.empty(most),
    )  # fmt: skip
    chosen = chosen[:count]
    return np.where(chosen >= 0, rows[there.row[np.maximum(chosen, 0)]], -1), point[:count], chosen


def test_places_are_the_markers() -> None:
    scene = simulate(markers=12, moments=4, drift=1.0, seed=3)
    for moment in range(4):
        row, point, chosen = found_in(scene, moment)
        labels = np.where(row >= 0, scene.fiducial[row], -2)
        marker = labels.max(1)
        assert all(set(own[own >= -1].tolist()) == {one} for own, one in zip(labels, marker, strict=True))
        assert len(set(marker.tolist())) == len(marker) >= 11
        assert np.linalg.norm(point - scene.points[moment].numpy()[marker], axis=1).max() < 2.0  # mm
        used = chosen[chosen >= 0]
        assert len(used) == len(set(used.tolist()))


def test_place_is_the_least_squares_place_of_its_blobs() -> None:
    scene = simulate(markers=6, moments=1, drift=1.0, seed=4)
    row, point, _ = found_in(scene, 0)
    rig = scene.rig
    for blobs, place in zip(row, point, strict=True):
        seen = np.flatnonzero(blobs >= 0)

        def misfit(at: np.ndarray, seen: np.ndarray = seen, blobs: np.ndarray = blobs) -> float:
            uv = rig.project(torch.from_numpy(at)[None]).uv[:, 0].numpy()
            return float(np.square(uv[seen] - scene.detections.uv[blobs[seen]]).sum())

        steps = 1.0 * np.concatenate((np.eye(3), -np.eye(3)))  # mm, one is some 0.25 px
        assert misfit(place) < min(misfit(place + step) for step in steps)


def test_every_blob_of_a_marker_is_within_reach() -> None:
    scene = simulate(markers=30, moments=2, drift=1.0, seed=5)
    row, point, _ = found_in(scene, 1)
    uv = scene.rig.project(torch.from_numpy(point)).uv.numpy()  # (C, R, 2)
    for number, blobs in enumerate(row):
        for camera in np.flatnonzero(blobs >= 0):
            assert np.linalg.norm(uv[camera, number] - scene.detections.uv[blobs[camera]]) < 1.5 * REACH * GATE

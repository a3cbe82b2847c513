"""Gradients of the compiled sums are those of their cost."""

from itertools import combinations

import numpy as np
import torch

import imgcal
from imgcal.association.light_alignment import CUT, FREE, REDUNDANCY, epipolar_equations, image_equations

WIDTH, CHANCE = 5.0, 0.5


def rig_and_blobs(noise: float = 3.0) -> tuple[imgcal.CameraRig, np.ndarray, np.ndarray]:
    """A pinhole rig, places, and their images a few pixels off on the plane z = 1."""
    rig = imgcal.load_rig("T4")
    rig = imgcal.CameraRig(**(vars(rig) | {"distortion": torch.zeros_like(rig.distortion)}))
    random = np.random.default_rng(0)
    places = np.array([0.0, 0.0, 850.0]) + random.uniform(-100, 100, (5, 3))
    uv = rig.project(torch.from_numpy(places)).uv.numpy()  # (C, N, 2)
    return rig, places, uv + random.normal(0, noise, uv.shape)


def on_plane(rig: imgcal.CameraRig, uv: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray((uv - rig.principal_point.numpy()[:, None]) / rig.focal_length.numpy()[:, None])


def epipolar_of_one(rig: imgcal.CameraRig, uv: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, gradient and information of one blob a camera and moment."""
    cameras, moments = uv.shape[:2]
    xy = on_plane(rig, uv).transpose(1, 0, 2).reshape(-1, 2)
    return epipolar(rig, xy, np.arange(moments)[:, None] * cameras + np.arange(cameras + 1))


def epipolar(rig: imgcal.CameraRig, xy: np.ndarray, start: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, gradient and information of blobs on the plane z = 1."""
    cameras = rig.num_cameras
    information, gradient = np.empty((cameras * FREE,) * 2), np.empty(cameras * FREE)
    cost, weight = epipolar_equations(
        np.ascontiguousarray(xy), start, np.ascontiguousarray(rig.cam_from_rig.rotation.numpy()),
        np.ascontiguousarray(rig.positions.numpy()), np.ascontiguousarray(rig.focal_length.numpy()),
        np.ones((cameras, FREE)), WIDTH, CHANCE, information, gradient,
    )  # fmt: skip
    assert weight > 0
    return cost, gradient, information


def test_epipolar_gradient_is_that_of_the_cost() -> None:
    rig, _, uv = rig_and_blobs(noise=0.02)
    _, gradient, information = epipolar_of_one(rig, uv)
    assert np.allclose(information, information.T)
    sizes = np.array([1e-5] * 3 + [1e-2] * 3 + [1e-2] * 4)
    for camera in (0, 2):
        for k in range(FREE):
            step = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
            step[camera, k] = sizes[k]
            after, before = epipolar_of_one(rig.retract(step), uv)[0], epipolar_of_one(rig.retract(-step), uv)[0]
            numeric = REDUNDANCY * (after - before) / (2 * sizes[k])
            # Sampson's denominator is taken as constant: right for small distances.
            assert np.isclose(numeric, gradient[camera * FREE + k], rtol=0.02, atol=1e-6)


def reference_cost(rig: imgcal.CameraRig, uv: np.ndarray) -> float:
    """Cost of blobs (C, S, N, 2) in every pair of cameras, each moment with N blobs a camera, one pair at a time."""
    xy, cost = on_plane(rig, uv.reshape(len(uv), -1, 2)).reshape(uv.shape), 0.0
    rotation, position, focal = (t.numpy() for t in (rig.cam_from_rig.rotation, rig.positions, rig.focal_length))
    for a, b in combinations(range(rig.num_cameras), 2):
        for s, i in np.ndindex(uv.shape[1:3]):
            near = 0.0
            for j in range(uv.shape[2]):
                one, two = np.append(xy[a, s, i], 1.0), np.append(xy[b, s, j], 1.0)
                ray1, ray2, apart = rotation[a].T @ one, rotation[b].T @ two, position[b] - position[a]
                along1, along2 = np.linalg.lstsq(np.stack((ray1, -ray2), 1), apart)[0]
                if along1 <= 0 or along2 <= 0:
                    continue
                slope1, slope2 = rotation[a] @ np.cross(ray2, apart), rotation[b] @ np.cross(apart, ray1)
                spread = np.square(slope1[:2] / focal[a]).sum() + np.square(slope2[:2] / focal[b]).sum()
                square = (one @ slope1) ** 2 / spread / WIDTH**2
                near += np.exp(-0.5 * square) if square < CUT else 0.0
            cost -= np.log(near + CHANCE)
    return float(cost)


def test_cost_of_several_blobs_is_that_of_the_obvious_loop() -> None:
    rig, places, uv = rig_and_blobs()
    random = np.random.default_rng(1)
    behind = 2 * rig.positions.mean(0).numpy() - places  # lines meet, but behind the cameras
    more = rig.project(torch.from_numpy(behind)).uv.numpy()
    blobs = np.stack((uv, uv + random.normal(0, 30, uv.shape), more), 2)  # (C, S, N, 2)
    assert np.isfinite(blobs).all()
    cameras, moments, each = blobs.shape[:3]
    xy = on_plane(rig, blobs.reshape(cameras, -1, 2)).reshape(blobs.shape).transpose(1, 0, 2, 3).reshape(-1, 2)
    start = each * (np.arange(moments)[:, None] * cameras + np.arange(cameras + 1))
    cost, *_ = epipolar(rig, xy, start)
    assert np.isclose(cost, reference_cost(rig, blobs), rtol=1e-9)


def image(rig: imgcal.CameraRig, camera: int, places: np.ndarray, uv: np.ndarray) -> tuple[float, np.ndarray]:
    """Cost and gradient of one camera that sees one place at each moment."""
    one = rig.select([camera])
    start = np.arange(len(places) + 1)
    focal = one.focal_length[0].numpy()
    centred = np.ascontiguousarray(uv - one.principal_point[0].numpy())
    information, gradient = np.empty((FREE, FREE)), np.empty(FREE)
    image_equations(
        centred, start, places, start, np.ascontiguousarray(one.cam_from_rig.rotation[0].numpy()),
        np.ascontiguousarray(one.positions[0].numpy()), focal, np.ones(FREE), WIDTH, CHANCE, information, gradient,
    )  # fmt: skip
    off = one.project(torch.from_numpy(places)).uv[0].numpy() - uv
    return float(-np.log(np.exp(-0.5 * np.square(off).sum(1) / WIDTH**2) + CHANCE).sum()), gradient


def test_image_gradient_is_that_of_the_cost() -> None:
    rig, places, uv = rig_and_blobs()
    _, gradient = image(rig, 1, places, uv[1])
    sizes = np.array([1e-5] * 3 + [1e-2] * 3 + [1e-2] * 4)
    for k in range(FREE):
        step = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
        step[1, k] = sizes[k]
        after, before = (image(rig.retract(way * step), 1, places, uv[1])[0] for way in (1.0, -1.0))
        assert np.isclose((after - before) / (2 * sizes[k]), gradient[k], rtol=1e-3, atol=1e-6)

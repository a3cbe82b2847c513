"""Gradients of the compiled sums are those of their cost."""

import numpy as np
import torch

import imgcal
from imgcal.association.light_alignment import FREE, REDUNDANCY, epipolar_equations, image_equations

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


def epipolar(rig: imgcal.CameraRig, uv: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, gradient and information of one blob a camera and moment."""
    cameras, moments = uv.shape[:2]
    xy = on_plane(rig, uv).transpose(1, 0, 2).reshape(-1, 2)
    start = np.arange(moments)[:, None] * cameras + np.arange(cameras + 1)
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
    _, gradient, information = epipolar(rig, uv)
    assert np.allclose(information, information.T)
    sizes = np.array([1e-5] * 3 + [1e-2] * 3 + [1e-2] * 4)
    for camera in (0, 2):
        for k in range(FREE):
            step = torch.zeros(rig.num_cameras, rig.num_parameters, dtype=torch.float64)
            step[camera, k] = sizes[k]
            after, before = epipolar(rig.retract(step), uv)[0], epipolar(rig.retract(-step), uv)[0]
            numeric = REDUNDANCY * (after - before) / (2 * sizes[k])
            # Sampson's denominator is taken as constant: right for small distances.
            assert np.isclose(numeric, gradient[camera * FREE + k], rtol=0.02, atol=1e-6)


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

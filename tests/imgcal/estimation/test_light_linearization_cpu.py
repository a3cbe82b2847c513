"""Normal equations of lights agree with numerical derivatives, including the covariance of shaking cameras."""

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import linearize_lights
from imgcal.geometry import lens_codes
from imgcal.types import CameraRig

STEP = 1e-4


def image(rig: CameraRig, places: np.ndarray) -> np.ndarray:
    """Where lights (N, 3) are seen: (C, 2, N)."""
    uv = rig.expand(1).project_values(torch.from_numpy(places)[None]).uv[0]
    return uv.numpy().swapaxes(-1, -2)


@pytest.mark.parametrize("shake", [None, (0.4, 0.0, 0.2, 0.0)])
def test_equations_are_those_of_dense_derivatives(shake) -> None:
    rig, generator = imgcal.load_rig("T4"), np.random.default_rng(2)
    unit = np.tile([1e-3] * 3 + [1.0] * 3 + [5.0] * 4 + [0.01] * 5, (4, 1))
    places = generator.normal(size=(3, 3)) * 60 + [0.0, 0.0, float(rig.working_distance)]
    uv = image(rig, places) + generator.normal(size=(4, 2, 3))
    sigma = generator.uniform(0.1, 0.3, (4, 3))
    seen = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 0], [0, 1, 0]], dtype=bool)
    root = np.where(seen, 1 / sigma, 0.0)
    cameras, lights, free = 4, 3, 15
    wide, size = cameras * free, 3 * lights
    blocks = (
        np.empty((cameras, free, free)), np.full((size, wide), np.nan), np.full((size, size), np.nan),
        np.empty((cameras, free)), np.empty(size), np.empty((cameras, 2, lights)),
    )  # fmt: skip
    rotation = rig.cam_from_rig.rotation.contiguous().numpy()
    lens = (rig.focal_length.numpy(), rig.principal_point.numpy(), rig.distortion.numpy())
    given = (
        np.zeros(lights), lens_codes(rig.lens_model, cameras, 5), uv, root, rotation,
        np.ascontiguousarray(rig.positions.numpy()), *lens, unit,
    )  # fmt: skip
    shaken = np.zeros(0) if shake is None else np.array(shake)
    cost = linearize_lights(given, places, blocks, 0, 1.0, shaken)
    camera, coupling, pose, camera_gradient, pose_gradient, residual = blocks

    def along(offset: np.ndarray) -> np.ndarray:
        step = torch.from_numpy(offset[:wide].reshape(cameras, free) * unit)
        return image(rig.retract(step), places + offset[wide:].reshape(lights, 3))

    away = np.repeat(np.linalg.norm(places, axis=1), 3)
    rest = image(rig, places) - uv
    by = np.stack([(along(STEP * e) - along(-STEP * e)) / (2 * STEP) for e in np.eye(wide + size)], -1)  # (C, 2, N, D)
    by[..., wide:] *= away
    information, gradient, expected = np.zeros((wide + size,) * 2), np.zeros(wide + size), 0.0
    for c in range(cameras):
        shown = seen[c]
        covariance = np.diag(sigma[c, shown] ** 2) + (0.0 if shake is None else shake[c] ** 2)
        weight = np.linalg.inv(covariance)
        for axis in range(2):
            rows, off = by[c, axis, shown], rest[c, axis, shown]
            information += rows.T @ weight @ rows
            gradient += rows.T @ weight @ off
            expected += 0.5 * off @ weight @ off
    assert cost == pytest.approx(expected)
    np.testing.assert_allclose(
        residual[np.repeat(seen[:, None], 2, 1)], rest[np.repeat(seen[:, None], 2, 1)], atol=1e-9
    )
    np.testing.assert_allclose(camera_gradient.ravel(), gradient[:wide], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(pose_gradient, gradient[wide:], rtol=1e-4, atol=1e-1)
    scale = np.abs(information[:wide, :wide]).max()
    for c in range(cameras):
        part = slice(free * c, free * (c + 1))
        np.testing.assert_allclose(camera[c] - np.eye(free), information[part, part], rtol=1e-4, atol=1e-6 * scale)
    np.testing.assert_allclose(coupling, information[wide:, :wide], rtol=1e-4, atol=1e-6 * np.abs(coupling).max())
    lower = np.tril_indices(size)
    np.testing.assert_allclose(pose[lower], information[wide:, wide:][lower], rtol=1e-4, atol=1e-6 * np.abs(pose).max())


def test_a_light_that_nobody_sees_says_nothing() -> None:
    rig = imgcal.load_rig("T4")
    places = np.array([[0.0, 0.0, 600.0], [0.0, 50.0, 600.0]])
    uv, root = np.ascontiguousarray(image(rig, places)), np.array([[1.0, 0.0]] * 4)
    blocks = (
        np.empty((4, 15, 15)), np.full((6, 60), np.nan), np.full((6, 6), np.nan), np.empty((4, 15)), np.empty(6),
        np.empty((4, 2, 2)),
    )  # fmt: skip
    lens = (rig.focal_length.numpy(), rig.principal_point.numpy(), rig.distortion.numpy())
    rotation = rig.cam_from_rig.rotation.contiguous().numpy()
    position = np.ascontiguousarray(rig.positions.numpy())
    given = (np.zeros(2), lens_codes(rig.lens_model, 4, 5), uv, root, rotation, position, *lens, np.ones((4, 15)))
    assert linearize_lights(given, places, blocks, 0, 1.0, np.zeros(0)) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(np.tril(blocks[2])[3:], np.eye(6)[3:])
    assert not blocks[1][3:].any()
    assert not blocks[4][3:].any()

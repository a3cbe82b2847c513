"""Against OpenCV's P3P, which solves the perspective problem that this one approximates."""

import cv2
import numpy as np
import pytest
import torch

from imgcal.association.p3p import rotation_towards, three_point_pose
from imgcal.geometry import rotation_from_vector
from tests.imgcal.association.scenes import degrees_between


def triangle_seen(random, distance, aside=0.6):
    """A triangle of about unit size, up to `aside` from the axis: points (3, 3), rotation cam_from_object, rays."""
    while True:
        points = random.uniform(-0.5, 0.5, (3, 3))
        a, b, c = (np.linalg.norm(points[i] - points[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
        area = np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0]))
        rotation = rotation_from_vector(torch.from_numpy(random.normal(0, 1.5, 3))).numpy()
        normal = rotation @ np.cross(points[1] - points[0], points[2] - points[0]) / area
        # Edge-on or face-on its mirror images all but coincide, and the depth is ill-conditioned.
        if area > 0.3 * max(a, b, c) ** 2 and 0.3 < abs(normal[2]) < 0.9:
            break
    inside = points @ rotation.T + np.array([*random.uniform(-aside, aside, 2), 1.0]) * distance
    return points, rotation, inside[:, :2] / inside[:, 2:]


def frame_of(points):
    along = points[1] - points[0]
    normal = np.cross(along, points[2] - points[0])
    along, normal = along / np.linalg.norm(along), normal / np.linalg.norm(normal)
    return np.stack((along, np.cross(normal, along), normal), axis=1)


def sides_of(points):
    return np.array([np.sum((points[i] - points[j]) ** 2) for i, j in ((0, 1), (0, 2), (1, 2))])


def solutions(points, rays):
    """Both mirror images: rotation cam_from_object, and the points in the camera (3, 3)."""
    found = []
    turned, directions = rotation_towards(rays)
    for mirror in (1.0, -1.0):
        frame, depths = np.empty((3, 3)), np.empty(3)
        if three_point_pose(turned, directions, sides_of(points), mirror, frame, depths):
            found.append((frame @ frame_of(points).T, directions * depths[:, None]))
    return found


def p3p(points, rays):
    """OpenCV's solutions: rotation, and the points in the camera."""
    count, turns, shifts = cv2.solveP3P(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_AP3P)
    assert count
    rotations = [cv2.Rodrigues(turn)[0] for turn in turns]
    return [(r, points @ r.T + t.ravel()) for r, t in zip(rotations, shifts, strict=True)]


@pytest.mark.parametrize("seed", range(20))
def test_from_afar_both_solutions_are_those_of_p3p(seed) -> None:
    points, rotation, rays = triangle_seen(np.random.default_rng(seed), 200.0)
    ours, theirs = solutions(points, rays), p3p(points, rays)
    assert len(ours) == 2
    for turn, inside in ours:
        angles = [degrees_between(turn, other) for other, _ in theirs]
        assert min(angles) < 0.01
        np.testing.assert_allclose(inside, theirs[int(np.argmin(angles))][1], rtol=3e-5)
    assert min(degrees_between(turn, rotation) for turn, _ in ours) < 0.01


@pytest.mark.parametrize("aside", [0.0, 0.6])
def test_the_error_is_small_at_a_fifth_of_the_distance_wherever_the_camera_looks_and_falls_with_its_square(aside):
    typical = []
    for distance in (5.0, 20.0, 80.0):
        errors = []
        for seed in range(200):
            points, rotation, rays = triangle_seen(np.random.default_rng(seed), distance, aside)
            errors.append(min(degrees_between(turn, rotation) for turn, _ in solutions(points, rays)))
        typical.append(np.median(errors))
    assert typical[0] < 0.3
    assert typical[1] < typical[0] / 10 and typical[2] < typical[1] / 10


def test_the_points_lie_on_their_rays_in_a_frame_that_is_a_rotation() -> None:
    for seed in range(50):
        points, _, rays = triangle_seen(np.random.default_rng(seed), 6.0)
        for turn, inside in solutions(points, rays):
            np.testing.assert_allclose(inside[:, :2] / inside[:, 2:], rays, atol=1e-12)
            np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-9)
            assert np.linalg.det(turn) == pytest.approx(1)
            np.testing.assert_allclose(turn @ frame_of(points), frame_of(inside), atol=1e-9)


def test_it_turns_with_the_camera_and_grows_with_the_triangle() -> None:
    points, _, rays = triangle_seen(np.random.default_rng(4), 8.0)
    turned_by = rotation_from_vector(torch.tensor([0.2, -0.3, 0.7], dtype=torch.float64)).numpy()
    turned = np.c_[rays, np.ones(3)] @ turned_by.T
    for (turn, inside), (other, same), (alike, larger) in zip(
        solutions(points, rays),
        solutions(points, turned[:, :2] / turned[:, 2:]),
        solutions(3 * points, rays),
        strict=True,
    ):
        # The view towards a mean of rays is not quite the same in both: far less than the error of the solution.
        assert degrees_between(other, turned_by @ turn) < 0.05
        np.testing.assert_allclose(same, inside @ turned_by.T, rtol=2e-3)
        np.testing.assert_allclose(alike, turn, atol=1e-9)
        np.testing.assert_allclose(larger, 3 * inside)


def test_the_order_of_the_points_hardly_matters() -> None:
    points, _, rays = triangle_seen(np.random.default_rng(5), 8.0)
    order = [1, 2, 0]
    others = solutions(points[order], rays[order])
    for turn, _ in solutions(points, rays):
        assert min(degrees_between(turn, other) for other, _ in others) < 0.2


def test_a_camera_turned_towards_its_rays_sees_them_about_its_axis() -> None:
    rays = np.random.default_rng(6).uniform(-1.5, 1.5, (40, 1, 2)) + np.random.default_rng(7).normal(
        0, 0.05, (40, 3, 2)
    )
    turned, directions = rotation_towards(rays)
    assert np.abs(turned.mean(1)).max() < 0.01
    np.testing.assert_allclose(directions[..., :2] / directions[..., 2:], rays, atol=1e-12)
    # A turn keeps lengths and angles.
    near = np.concatenate((turned, np.ones((40, 3, 1))), axis=-1)
    np.testing.assert_allclose(near @ near.swapaxes(1, 2), directions @ directions.swapaxes(1, 2), atol=1e-12)


def test_points_in_line_and_rays_that_are_one_have_no_pose() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert solutions(line, np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.1]])) == []
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert solutions(flat, np.full((3, 2), 0.1)) == []

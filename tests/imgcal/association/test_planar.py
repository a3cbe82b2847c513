"""Poses of planar objects against the truth, homographies against OpenCV's."""

from dataclasses import replace
from functools import reduce
from operator import add

import cv2
import numpy as np
import pytest
import torch

from imgcal.association.blobs import PaddedBlobs, gather
from imgcal.association.hypotheses import Poses
from imgcal.association.planar import _affinity, _count_shifts, _fit_homography, _pose, _rotation, _whiten, planar_poses
from imgcal.geometry import rotation_from_vector
from tests.imgcal.association.scenes import degrees_between, make_object, take


def every_pose(*arguments) -> Poses:
    return reduce(add, planar_poses(*arguments))


def random_rotation(random):
    return rotation_from_vector(torch.from_numpy(random.normal(0, 0.8, 3))).numpy()


@pytest.fixture(scope="module")
def flat():
    """Sixty points in a plane that is not z = 0."""
    random = np.random.default_rng(0)
    points = np.c_[random.uniform(-90, 90, (60, 2)), np.zeros(60)] @ random_rotation(random).T + [10.0, -5, 20]
    return make_object(points)


@pytest.mark.parametrize("seed", range(4))
def test_one_of_the_poses_is_the_true_one(seed, flat, o10) -> None:
    snapshot = take(o10, flat, seed, drift=None, noise=0.05, false=4, missing=6)
    blobs = gather(snapshot.detections, o10)
    camera = 2 * seed
    poses = every_pose(blobs, o10, camera, flat)
    points, true = flat.points.numpy(), snapshot.pose.apply(flat.points).numpy()
    error = [
        np.linalg.norm(points @ r.T + t - true, axis=1).max()
        for r, t in zip(poses.rotation, poses.translation, strict=True)
    ]
    assert min(error) < 0.02 * float(o10.working_distance)
    best = int(np.argmin(error))
    assert degrees_between(poses.rotation[best], snapshot.pose.rotation.numpy()) < 2
    assert (
        np.allclose(poses.rotation @ poses.rotation.swapaxes(1, 2), np.eye(3))
        and (np.linalg.det(poses.rotation) > 0).all()
    )


def test_the_order_of_blobs_does_not_matter(flat, o10) -> None:
    blobs = gather(take(o10, flat, 1, drift=None, missing=5).detections, o10)
    order = np.random.default_rng(1).permutation(blobs.count[0])
    parts = (part[:1][:, order] for part in (blobs.uv, blobs.ideal, blobs.sigma, blobs.radius, blobs.row))
    shuffled = PaddedBlobs(*parts, blobs.count[:1], blobs.rows)
    one, other = every_pose(blobs, o10, 0, flat), every_pose(shuffled, o10, 0, flat)
    assert len(one) == len(other) > 0
    np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-6)
    np.testing.assert_allclose(one.translation, other.translation, atol=1e-3)


def test_blobs_of_another_size_and_strays_are_not_of_the_plane(flat, o10) -> None:
    snapshot = take(o10, flat, 2, drift=None, noise=0.05)
    blobs = gather(snapshot.detections, o10)
    count = int(blobs.count[0])
    radius = np.full_like(blobs.radius, 4.0)
    big = np.random.default_rng(3).permutation(count)[:12]
    radius[0, big] = 20.0
    ideal = blobs.ideal.copy()
    ideal[0, big] += 400.0  # lamps beside the object
    poses = every_pose(replace(blobs, radius=radius, ideal=ideal), o10, 0, flat)
    assert degrees_between(poses.rotation, snapshot.pose.rotation.numpy()).min() < 2


def test_blobs_of_something_else_have_no_pose(flat, o10) -> None:
    blobs = gather(take(o10, flat, 1).detections, o10)
    random = np.random.default_rng(2).uniform(-600, 600, blobs.ideal.shape).astype(np.float32)
    random[0, : random.shape[1] // 2] *= 0.01  # half of them in a heap
    assert len(every_pose(replace(blobs, ideal=random), o10, 0, flat)) == 0


@pytest.mark.parametrize("count", [4, 30])
def test_homographies_are_those_of_opencv(count) -> None:
    random = np.random.default_rng(count)
    source = random.uniform(-100, 100, (count, 2))
    true = np.array([[1.1, 0.2, 3.0], [-0.1, 0.9, -5.0], [4e-4, -3e-4, 1.0]])
    image = np.c_[source, np.ones(count)] @ true.T
    target = image[:, :2] / image[:, 2:]
    found = _fit_homography(source, target)
    np.testing.assert_allclose(found, true, atol=1e-8)
    noisy = target + 0.05 * random.standard_normal((count, 2))
    ours, theirs = _fit_homography(source, noisy), cv2.findHomography(source, noisy)[0]

    def error(homography):
        image = np.c_[source, np.ones(count)] @ homography.T
        return np.linalg.norm(image[:, :2] / image[:, 2:] - noisy)

    assert error(ours) < 1.02 * error(theirs) + 1e-9


def test_a_pose_is_that_of_the_plane_whose_homography_it_is() -> None:
    random = np.random.default_rng(5)
    for _ in range(20):
        rotation, translation = random_rotation(random), np.array([*random.uniform(-100, 100, 2), 900.0])
        homography = np.stack((rotation[:, 0], rotation[:, 1], translation), axis=1)
        found, where = _pose(homography / homography[2, 2])
        np.testing.assert_allclose(found, rotation, atol=1e-9)
        np.testing.assert_allclose(where, translation, atol=1e-6)


def test_whitened_points_differ_by_a_rotation_after_any_affine_map() -> None:
    random = np.random.default_rng(6)
    points = random.uniform(-50, 50, (40, 2)) * [1, 0.4]
    white, mean, root = _whiten(points)
    np.testing.assert_allclose(np.cov(white.T), np.eye(2), atol=1e-12)
    np.testing.assert_allclose(white @ root.T + mean, points)
    mapped = points @ np.array([[0.7, 0.3], [-0.2, 0.5]]).T + [100.0, 20]
    other = _whiten(mapped)[0]
    u, _, vh = np.linalg.svd(other.T @ white)
    turn = u @ vh
    np.testing.assert_allclose(white @ turn.T, other, atol=1e-9)
    angle = np.arctan2(turn[1, 0], turn[0, 0])
    np.testing.assert_allclose(_rotation(angle), turn, atol=1e-9)
    affine = _affinity(points, mapped, angle)
    np.testing.assert_allclose(np.c_[points, np.ones(40)] @ affine[:2].T, mapped, atol=1e-9)


def test_a_lattice_is_found_though_half_of_it_is_hidden(o10) -> None:
    """What is left is no cloud whose shape says anything, and other blobs lie about."""
    rows, columns = np.meshgrid(np.arange(9.0), np.arange(9.0), indexing="ij")
    grid = make_object(np.c_[20 * columns.ravel() - 80, 20 * rows.ravel() - 80, np.zeros(81)])
    for seed in range(3):
        snapshot = take(o10, grid, seed, drift=None, noise=0.05)
        blobs, camera = gather(snapshot.detections, o10), 3 * seed
        uv, count = blobs.ideal[camera], blobs.count[camera]
        random = np.random.default_rng(seed)
        middle = uv[:count].mean(0)
        # Behind one drape are the fiducials of one side, behind another a few of the rest.
        shown = (uv[:count] - middle) @ (np.cos(seed), np.sin(seed)) < 10
        shown &= np.linalg.norm(uv[:count] - uv[:count][shown][5], axis=1) > 60
        strays = middle + random.uniform(-300, 300, (12, 2))
        kept = np.concatenate((uv[:count][shown], strays)).astype(np.float32)
        parts = (
            kept[None], kept[None], np.full((1, len(kept)), 0.1), np.full((1, len(kept)), np.nan),
            np.arange(len(kept))[None],
        )  # fmt: skip
        assert 25 < shown.sum() < 60
        poses = every_pose(PaddedBlobs(*parts, np.array([len(kept)]), len(kept)), o10.select([camera]), 0, grid)
        points, truth = grid.points.numpy(), snapshot.pose.apply(grid.points).numpy()
        # A square has eight poses, and steps of the lattice are as good as long as they show as many of the rest.
        error = [
            np.linalg.norm((points @ r.T + t)[:, None] - truth, axis=-1).min(1).max()
            for r, t in zip(poses.rotation, poses.translation, strict=True)
        ]
        assert min(error, default=np.inf) < 0.02 * float(o10.working_distance)


def test_shifts_of_cells_are_counted() -> None:
    random = np.random.default_rng(8)
    source, target = (np.unique(random.integers(-5, 6, (20, 2)), axis=0) for _ in range(2))
    counts, low = _count_shifts(source, target)
    expected = np.zeros_like(counts)
    np.add.at(expected, tuple((target[:, None] - source - low).reshape(-1, 2).T), 1)
    np.testing.assert_array_equal(counts, expected)
    assert counts.sum() == len(source) * len(target)

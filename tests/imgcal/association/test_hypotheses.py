"""Triples against counting and brute force; poses of single cameras against the truth."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from imgcal.association.blobs import gather
from imgcal.association.hypotheses import (
    CELLS,
    MOST_FIDUCIAL_TRIPLES,
    Poses,
    _rasterize,
    blob_triples,
    edge_triples,
    fiducial_triples,
    has_many_triples,
    likely_blobs,
    single_camera_poses,
)
from imgcal.io import load_object
from tests.imgcal.association.scenes import degrees_between, detections_of, make_object, take


def rng(seed=0):
    return np.random.default_rng(seed)


def test_triples_of_an_asymmetric_object_are_all_there_are(asymmetric8) -> None:
    found = fiducial_triples(asymmetric8, rng())
    points = asymmetric8.points.numpy()
    assert sorted(map(tuple, found.triples)) == sorted(permutations(range(8), 3))
    for (i, j, k), sides, frame in zip(found.triples, found.sides, found.frames, strict=True):
        lengths = [np.sum((points[a] - points[b]) ** 2) for a, b in ((i, j), (i, k), (j, k))]
        np.testing.assert_allclose(sides, lengths)
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1)
        first, second = points[j] - points[i], points[k] - points[i]
        assert first @ frame[:, 0] == pytest.approx(np.linalg.norm(first))
        assert second @ frame[:, 1] > 0 and abs(second @ frame[:, 2]) < 1e-9
    assert sorted(found.order) == list(range(8))


def test_of_triples_that_symmetry_cannot_tell_apart_one_is_tried() -> None:
    cube = load_object("cube8")
    found = fiducial_triples(cube, rng()).triples
    assert len(found) == 8 * 7 * 6 // 24  # no turn keeps three of its corners in place
    turned = {tuple(motion.permutation[triple]) for motion in cube.symmetries for triple in found}
    assert turned == set(permutations(range(8), 3))


def test_triples_that_are_kept_are_those_of_the_same_object_and_draw_no_numbers(asymmetric8) -> None:
    generator = rng()
    first = fiducial_triples(asymmetric8, generator)
    turned = replace(asymmetric8, points=asymmetric8.points.roll(1, dims=1).contiguous())
    other, again = fiducial_triples(turned, rng()), fiducial_triples(asymmetric8, generator)
    np.testing.assert_array_equal(first.triples, again.triples)
    np.testing.assert_array_equal(first.frames, again.frames)
    np.testing.assert_allclose(other.sides, first.sides)
    assert not np.allclose(other.frames, first.frames)
    drawn = rng()
    np.testing.assert_array_equal(first.order, drawn.permutation(8))
    np.testing.assert_array_equal(again.order, drawn.permutation(8))


def test_neighbours_on_an_images_hull_are_an_edge_of_the_object() -> None:
    obj = make_object(rng(2).normal(size=(40, 3)) * 50)
    points = obj.points.numpy()
    found = edge_triples(obj, rng())
    assert edge_triples(load_object("asymmetric8"), rng()) is None
    assert edge_triples(make_object(points * [1, 1, 0]), rng()) is None
    edges = set(map(tuple, found.triples[:, :2]))
    outer = ConvexHull(points).vertices
    assert len(edges) == 2 * (3 * len(outer) - 6) and len(found.triples) == len(edges) * (len(outer) - 2)
    assert set(found.order[: len(outer)]) == set(outer) and sorted(found.order) == list(range(40))
    for seed in range(20):
        turned = points @ np.linalg.qr(rng(seed).normal(size=(3, 3)))[0].T + [0, 0, 900]
        uv = 1000 * turned[:, :2] / turned[:, 2:]
        hull = ConvexHull(uv).vertices
        assert {*zip(hull, np.roll(hull, 1), strict=True), *zip(hull, np.roll(hull, -1), strict=True)} <= edges


def test_blobs_are_drawn_as_neighbours_in_their_order() -> None:
    uv, likely = rng(3).uniform(0, 100, (9, 2)), np.array([7, 2, 5, 0, 8])
    drawn = blob_triples(uv, likely, 60, rng(4), neighbours=True)
    ring = {(7, 2), (2, 5), (5, 0), (0, 8), (8, 7)}
    assert set(map(tuple, drawn[:, :2])) == ring and set(drawn[:, 2]) == set(likely)
    assert all(len(set(triple)) == 3 for triple in drawn.tolist())


def test_triples_in_line_are_left_out() -> None:
    points = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [0, 15, 3]])
    found = fiducial_triples(make_object(points), rng()).triples
    assert {frozenset(triple.tolist()) for triple in found} == {frozenset(t) for t in ((0, 1, 3), (0, 2, 3), (1, 2, 3))}


def test_of_many_fiducials_the_outer_ones_are_tried() -> None:
    points = rng(1).normal(size=(120, 3)) * 50
    obj = make_object(points)
    assert has_many_triples(obj) and not has_many_triples(make_object(points[:35]))
    found = fiducial_triples(obj, rng())
    assert set(found.triples.ravel()) <= set(ConvexHull(points).vertices)
    assert len(found.triples) <= MOST_FIDUCIAL_TRIPLES
    assert (found.triples != np.roll(found.triples, 1, axis=1)).all()


def test_likely_blobs_are_those_close_to_others_or_the_outermost_of_these(o10) -> None:
    cloud = rng(2).normal((900, 500), 30, (25, 2))
    strays = np.array([[50.0, 50], [2000, 60], [1900, 1000], [80, 1000]])
    blobs = gather(detections_of(np.concatenate((strays, cloud)), np.zeros(29), o10), o10)
    likely = likely_blobs(blobs, 0, outer=False)
    assert not set(likely) & set(range(4)) and len(likely) > 15
    outer = likely_blobs(blobs, 0, outer=True)
    assert not set(outer) & set(range(4)) and set(4 + ConvexHull(cloud).vertices) & set(outer)
    inside = ConvexHull(blobs.ideal[0, 4:29].astype(float)).equations
    depth = (blobs.ideal[0, outer].astype(float) @ inside[:, :2].T + inside[:, 2]).max(1)
    assert np.median(depth) > -1e-3  # on the hull


def test_blob_triples_are_three_likely_ones_and_wide() -> None:
    uv, likely = rng(3).uniform(0, 100, (30, 2)), np.array([2, 3, 5, 7, 11, 13])

    def area(triples):
        a, b = uv[triples[:, 1]] - uv[triples[:, 0]], uv[triples[:, 2]] - uv[triples[:, 0]]
        return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

    found = blob_triples(uv, likely, 3000, rng(4))
    assert found.shape == (3000, 3) and set(found.ravel()) == set(likely)
    assert (np.sort(found, axis=1)[:, 1:] != np.sort(found, axis=1)[:, :-1]).all()
    # The widest of three draws of all ordered triples, each as likely as the other.
    each = np.sort(area(likely[list(permutations(range(6), 3))]))
    share = np.arange(1, len(each) + 1) / len(each)
    expected = float(np.sum(each * (share**3 - np.insert(share[:-1], 0, 0) ** 3)))
    assert area(found).mean() == pytest.approx(expected, rel=0.03)


def test_three_blobs_are_enough_to_draw_from() -> None:
    found = blob_triples(rng().uniform(0, 9, (3, 2)), np.arange(3), 50, rng(1))
    assert {tuple(sorted(triple)) for triple in found.tolist()} == {(0, 1, 2)}


def test_the_raster_holds_the_nearness_of_the_nearest_blob() -> None:
    uv = rng(5).uniform(-40, 40, (2, 12, 2)).astype(np.float32)
    count, origin, cell = np.array([12, 5]), np.zeros((2, 2)), 0.75
    raster = _rasterize(uv, count, cell, origin)
    for camera in range(2):
        rows, columns = np.mgrid[: raster.shape[1], : raster.shape[2]]
        at = np.stack((columns + 0.5, rows + 0.5), axis=-1) * cell + origin[camera]
        away = np.linalg.norm(at[:, :, None] - uv[camera, : count[camera]], axis=-1).min(-1)
        expected = 1 - (away / (CELLS * cell)) ** 2
        near = away < (CELLS - 1) * cell  # at the rim, whole cells decide
        np.testing.assert_allclose(raster[camera][near], expected[near], atol=1e-4)
        assert (raster[camera] >= 0).all() and (raster[camera][away > (CELLS + 1.5) * cell] == 0).all()


@pytest.mark.parametrize("camera", [0, 6])
def test_one_of_the_poses_of_a_camera_is_the_true_one(camera, o10, asymmetric8) -> None:
    snapshot = take(o10, asymmetric8, 2, drift=None, noise=0.05, false=2)
    blobs = gather(snapshot.detections, o10)
    truth = snapshot.labels(blobs, 8)[camera]
    fiducials = fiducial_triples(asymmetric8, rng())
    triples = np.array([truth[[0, 3, 6]], truth[[1, 2, 7]]])
    poses = single_camera_poses(blobs, o10, np.array([camera, camera]), triples, fiducials, 4.0, 8)
    assert 0 < len(poses) <= 16
    angle = degrees_between(poses.rotation, snapshot.pose.rotation.numpy())
    assert angle.min() < 1
    centre = asymmetric8.points.mean(0).numpy()
    there = poses.rotation[angle.argmin()] @ centre + poses.translation[angle.argmin()]
    expected = snapshot.pose.rotation.numpy() @ centre + snapshot.pose.translation.numpy()
    assert np.linalg.norm(there - expected) < 0.02 * float(o10.working_distance)


def test_the_order_of_blobs_and_fiducials_does_not_matter(o10, asymmetric8) -> None:
    snapshot = take(o10, asymmetric8, 3, drift=None)
    blobs = gather(snapshot.detections, o10)
    labels, order = snapshot.labels(blobs, 8), rng(6).permutation(8)
    shuffled = replace(asymmetric8, points=asymmetric8.points[order], colours=asymmetric8.colours[order], radius=None)
    best = []
    for obj, triple in ((asymmetric8, labels[0, [0, 3, 6]]), (shuffled, labels[0, [6, 0, 3]])):
        poses = single_camera_poses(blobs, o10, np.array([0]), triple[None], fiducial_triples(obj, rng()), 4.0, 4)
        best.append(poses.rotation[0])
    assert degrees_between(*best) < 1


def test_poses_are_selected_and_added() -> None:
    poses = Poses(rng().normal(size=(5, 3, 3)), rng(1).normal(size=(5, 3)))
    both = poses.select(np.array([4, 0])) + poses.select(np.array([2]))
    assert len(both) == 3
    np.testing.assert_array_equal(both.rotation, poses.rotation[[4, 0, 2]])
    np.testing.assert_array_equal(both.translation, poses.translation[[4, 0, 2]])

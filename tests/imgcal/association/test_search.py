"""Rounds of the pose search: their results and counts, and searches that find nothing."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.association.ambiguities import conflicts, lattice_shifts
from imgcal.association.search import PLANAR_EFFORT, VERIFIED, Search, distinct, match_on_lattice
from imgcal.association.verification import evidence
from imgcal.association.voting import match, predict_ideal
from imgcal.io import load_object
from tests.imgcal.association.scenes import make_object, scene_of, take


def search_of(scene, cameras, alone=True) -> Search:
    return Search(scene, cameras, (8.0, 150.0), alone)


@pytest.mark.parametrize("seed", range(3))
def test_a_round_finds_the_labels(seed, o10, asymmetric8) -> None:
    rig = o10.select([0, 3, 6])
    snapshot = take(rig, asymmetric8, seed, false=1, missing=1)
    scene = scene_of(snapshot, rig, asymmetric8)
    search = search_of(scene, [0, 1, 2], alone=False)
    fits = search.run_round(5000, np.random.default_rng(seed))
    assert fits is not None and len(fits.labels) <= VERIFIED
    best = fits.labels[evidence(scene, fits).argmax()]
    assert conflicts(asymmetric8, snapshot.labels(scene.blobs, 8), best) < 0.1
    assert search.hypotheses >= 12 * 8 * 7 * 6  # ten blob triples, as many in each camera


@pytest.mark.parametrize("seed", range(3))
def test_the_first_camera_ends_a_round_where_its_pose_labels_nearly_all_blobs(seed, o10, asymmetric8) -> None:
    rig = o10.select([0, 3, 6])
    snapshot = take(rig, asymmetric8, seed)
    scene = scene_of(snapshot, rig, asymmetric8)
    search = search_of(scene, [0, 1, 2])
    fits = search.run_round(5000, np.random.default_rng(seed))
    assert fits is not None and len(fits.labels) == 1
    np.testing.assert_array_equal(fits.labels[0], snapshot.labels(scene.blobs, 8))
    assert search.hypotheses < 1.5 * 4 * 8 * 7 * 6
    # Two cameras do not suffice.
    pair = scene_of(take(rig.select([0, 1]), asymmetric8, seed), rig.select([0, 1]), asymmetric8)
    search = search_of(pair, [0, 1])
    search.run_round(5000, np.random.default_rng(seed))
    assert search.hypotheses >= 10 * 8 * 7 * 6


@pytest.mark.parametrize("fiducials", [20, 90])
def test_edges_of_the_hull_find_an_object_with_little_hidden(fiducials, o10) -> None:
    obj = make_object(np.random.default_rng(fiducials).uniform(-90, 90, (fiducials, 3)))
    rig = o10.select([0, 3, 6])
    for seed in range(3):
        snapshot = take(rig, obj, seed)
        scene = scene_of(snapshot, rig, obj)
        search = search_of(scene, [0, 1, 2])
        fits = search.run_round(8000, np.random.default_rng(seed))
        assert fits is not None and conflicts(obj, snapshot.labels(scene.blobs, fiducials), fits.labels[0]) < 0.05
        assert search.triples is None  # no other hypotheses were made


def test_every_camera_is_moved_to_the_step_of_a_lattice_that_pairs_most(o10) -> None:
    rows, columns = np.meshgrid(np.arange(9.0), np.arange(7.0), indexing="ij")
    obj = make_object(np.c_[20 * columns.ravel() - 60, 20 * rows.ravel() - 80, np.zeros(63)])
    rig = o10.select([0, 3, 6])
    snapshot = take(rig, obj, 1, drift=None)
    scene = scene_of(snapshot, rig, obj)
    truth = snapshot.labels(scene.blobs, 63)
    predicted = predict_ideal(rig, obj.points.numpy(), snapshot.poses())
    step = lattice_shifts(obj)[0].permutation
    falls = step >= 0
    shift = np.median(predicted[0][:, step[falls]] - predicted[0][:, falls], axis=1)
    off = np.stack((shift[0], np.zeros(2), -2 * shift[2]))[None]  # as if the first and the last camera saw it shifted
    assert not np.array_equal(match(scene.blobs, predicted, off, 4.0)[0], truth)
    np.testing.assert_array_equal(match_on_lattice(scene, predicted, off, 4.0)[0], truth)


def test_where_edges_mislead_all_triples_are_tried(o10) -> None:
    obj = make_object(np.random.default_rng(1).uniform(-90, 90, (20, 3)))
    rig = o10.select([0, 3, 6])
    snapshot = take(rig, obj, 2, missing=6, false=4)
    scene = scene_of(snapshot, rig, obj)
    search = search_of(scene, [0, 1, 2])
    random = np.random.default_rng(0)
    rounds = [search.run_round(16_000, random) for _ in range(3)]
    assert search.triples is not None
    found = [labels for fits in rounds if fits is not None for labels in fits.labels]
    assert min(conflicts(obj, snapshot.labels(scene.blobs, 20), labels) for labels in found) < 0.1


def test_the_same_seed_finds_the_same_and_effort_is_counted(o10, asymmetric8) -> None:
    rig = o10.select([0, 3])
    scene = scene_of(take(rig, asymmetric8, 4), rig, asymmetric8)
    found = []
    for _ in range(2):
        search = search_of(scene, [0, 1])
        fits = search.run_round(3000, np.random.default_rng(9))
        found.append((search.hypotheses, fits.labels))
    assert found[0][0] == found[1][0]
    np.testing.assert_array_equal(found[0][1], found[1][1])
    before = search.hypotheses
    search.run_round(3000, np.random.default_rng(10))
    assert search.hypotheses > 1.5 * before


def test_planar_objects_with_many_fiducials_are_searched_as_planes(o10) -> None:
    random = np.random.default_rng(0)
    obj = make_object(np.c_[random.uniform(-90, 90, (60, 2)), np.zeros(60)])
    rig = o10.select([0, 4])
    snapshot = take(rig, obj, 1)
    scene = scene_of(snapshot, rig, obj)
    search = search_of(scene, [0, 1])
    fits = search.run_round(1, random)
    assert search.hypotheses >= 2 * PLANAR_EFFORT
    assert min(conflicts(obj, snapshot.labels(scene.blobs, 60), labels) for labels in fits.labels) < 0.05


def test_few_blobs_are_exhausted_after_few_rounds(o10, asymmetric8) -> None:
    rig = o10.select([0])
    for missing, triples in ((4, 4), (0, 56)):
        scene = scene_of(take(rig, asymmetric8, 1, missing=missing), rig, asymmetric8)
        search, generator = search_of(scene, [0]), np.random.default_rng(1)
        for _ in range(8):
            search.run_round(5000, generator)
        assert search.exhausted == (missing > 0)
        assert len(search.drawn) <= triples


def test_a_round_without_poses_finds_nothing(o10) -> None:
    random = np.random.default_rng(1)
    obj = make_object(np.c_[random.uniform(-90, 90, (60, 2)), np.zeros(60)])
    rig = o10.select([0])
    scene = scene_of(take(rig, obj, 1), rig, obj)
    elsewhere = random.uniform(-600, 600, scene.blobs.ideal.shape).astype(np.float32)
    elsewhere[0, :30] *= 0.01
    assert search_of(replace(scene, blobs=replace(scene.blobs, ideal=elsewhere)), [0]).run_round(1, random) is None


def testdistinct_labellings_are_kept_the_fullest_first() -> None:
    cube = load_object("cube8")
    full = np.tile(np.arange(8), (2, 1))
    fewer = np.where(np.arange(8) < 6, full, -1)
    turned = full[:, cube.symmetries[7].permutation]
    random = np.random.default_rng(0)
    other, third = (full[:, random.permutation(8)] for _ in range(2))
    assert min(conflicts(cube, *pair) for pair in ((full, other), (full, third), (other, third))) > 0.5
    rows, labels = distinct(cube, np.array([40, 41, 42, 43, 44]), np.stack((fewer, full, turned, other, third)))
    assert rows.tolist() == [41, 43] and len(rows) == VERIFIED
    np.testing.assert_array_equal(labels, np.stack((full, other)))

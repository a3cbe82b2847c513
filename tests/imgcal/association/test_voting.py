"""Votes against histograms, matches against the truth; both do not care about the order of anything."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association.blobs import FAR, PaddedBlobs, gather
from imgcal.association.hypotheses import Poses
from imgcal.association.voting import match, predict_ideal, vote
from tests.imgcal.association.scenes import take


def blobs_at(ideal: np.ndarray, count=None) -> PaddedBlobs:
    """Blobs (C, M, 2) px, counted from the principal point."""
    shape = ideal.shape[:2]
    count = np.full(shape[0], shape[1]) if count is None else count
    row = np.where(np.arange(shape[1]) < count[:, None], np.arange(shape[0] * shape[1]).reshape(shape), -1)
    ideal = np.where(row[..., None] >= 0, ideal, FAR)
    return PaddedBlobs(ideal, ideal.astype(np.float32), np.ones(shape), np.full(shape, np.nan), row, count, row.size)


def test_predictions_are_projections_without_distortion(o10, asymmetric8) -> None:
    snapshot = take(o10, asymmetric8, 0, drift=None)
    mean = o10.focal_length.mean(-1, keepdim=True).expand(-1, 2)
    plain = replace(
        o10, focal_length=mean, principal_point=torch.zeros(10, 2).double(), distortion=torch.zeros(10, 5).double()
    )
    points = asymmetric8.points.numpy()
    turned = Poses(-snapshot.poses().rotation, -snapshot.poses().translation)  # through the cameras: behind them
    found = predict_ideal(o10, points, snapshot.poses() + turned)
    expected = plain.project(snapshot.pose.apply(asymmetric8.points)).uv.numpy()
    np.testing.assert_allclose(found[0], expected, atol=1e-9)
    inside = o10.cam_from_rig.apply((snapshot.pose.apply(asymmetric8.points) * -1)[None])[..., 2].numpy()
    assert (found[1][inside < 1] == -1e7).all() and (inside < 1).any()


def fullest(predicted, ideal, width, gate):
    """Votes and shift of the first fullest window of two by two cells of a histogram of all differences."""
    difference = (ideal[None] - predicted[:, None]).reshape(-1, 2).astype(np.float64) + gate
    inside = difference[((difference >= 0) & (difference < 2 * gate)).all(1)]
    cells = np.floor(inside / width).astype(int) + 1
    table = np.zeros((np.ceil(2 * gate / width).astype(int) + 2,) * 2, dtype=int)
    np.add.at(table, tuple(cells.T), 1)
    windows = table[1:, 1:] + table[:-1, 1:] + table[1:, :-1] + table[:-1, :-1]
    return windows.max(), np.array(np.unravel_index(windows.argmax(), windows.shape)) * width - gate


@pytest.mark.parametrize("gate", [30.0, 75.0])
def test_votes_are_those_of_a_histogram(gate) -> None:
    random = np.random.default_rng(0)
    ideal = random.uniform(-100, 100, (3, 9, 2)).astype(np.float32)
    predicted = random.uniform(-100, 100, (4, 3, 6, 2))
    blobs = blobs_at(ideal.astype(np.float64), np.array([9, 4, 0]))
    votes = vote(blobs, predicted, 5.0, gate)
    for k in range(4):
        for c, number in enumerate(blobs.count):
            expected, shift = fullest(predicted[k, c], ideal[c, :number], 5.0, gate) if number else (0, -gate)
            assert votes.count[k, c] == min(expected, 6)
            np.testing.assert_allclose(votes.shift[k, c], shift)


def test_a_shift_of_each_camera_is_found_among_false_blobs() -> None:
    random = np.random.default_rng(1)
    predicted = random.uniform(-150, 150, (1, 4, 10, 2))
    shift = random.uniform(-40, 40, (4, 2))
    seen = predicted[0] + shift[:, None] + random.uniform(-1, 1, (4, 10, 2))
    blobs = blobs_at(np.concatenate((seen, random.uniform(-200, 200, (4, 6, 2))), axis=1))
    votes = vote(blobs, predicted, 4.0, 50.0)
    np.testing.assert_array_equal(votes.count, np.full((1, 4), 10))
    assert np.abs(votes.shift[0] - shift).max() < 6.0
    labels = match(blobs, predicted, votes.shift, 5.0)
    np.testing.assert_array_equal(labels[0], np.tile(np.arange(10), (4, 1)))


def test_a_match_refines_the_shift_it_is_given() -> None:
    random = np.random.default_rng(2)
    predicted = random.uniform(-150, 150, (1, 2, 12, 2))
    blobs = blobs_at(predicted[0] + [6.0, -4.0])
    labels = match(blobs, predicted, np.full((1, 2, 2), [2.5, -1.0]), 3.6)  # as given, 4.6 px off
    np.testing.assert_array_equal(labels[0], np.tile(np.arange(12), (2, 1)))
    far = match(blobs, predicted, np.full((1, 2, 2), [60.0, 60.0]), 3.6)
    assert (far >= 0).mean() < 0.2


def test_permuted_cameras_fiducials_and_blobs_give_permuted_votes_and_labels(o10, asymmetric8) -> None:
    snapshot = take(o10, asymmetric8, 3, false=2, missing=1)
    blobs = gather(snapshot.detections, o10)
    predicted = predict_ideal(o10, asymmetric8.points.numpy(), snapshot.poses())
    votes = vote(blobs, predicted, 6.0, 60.0)
    labels = match(blobs, predicted, votes.shift, 7.5)
    assert (labels == snapshot.labels(blobs, 8)).mean() > 0.9
    random = np.random.default_rng(4)
    cameras, fiducials, slots = random.permutation(10), random.permutation(8), random.permutation(blobs.uv.shape[1])
    parts = (part[cameras[:, None], slots] for part in (blobs.uv, blobs.ideal, blobs.sigma, blobs.radius, blobs.row))
    mixed = PaddedBlobs(*parts, blobs.count[cameras], blobs.rows)
    assert (blobs.count == blobs.uv.shape[1]).all()
    shuffled = np.ascontiguousarray(predicted[:, cameras][:, :, fiducials])
    other = vote(mixed, shuffled, 6.0, 60.0)
    np.testing.assert_array_equal(other.count, votes.count[:, cameras])
    np.testing.assert_array_equal(other.shift, votes.shift[:, cameras])
    again = match(mixed, shuffled, other.shift, 7.5)
    back = np.where(again >= 0, slots[again], -1)
    np.testing.assert_array_equal(back, labels[:, cameras][:, :, fiducials])


def test_what_is_not_seen_gets_no_label() -> None:
    places = np.array([[0.0, 0], [40, 0], [0, 40], [40, 40], [80, 10]])
    blobs = blobs_at(places[None, [0, 1, 3, 4]])
    labels = match(blobs, places[None, None], np.zeros((1, 1, 2)), 5.0)
    np.testing.assert_array_equal(labels[0, 0], [0, 1, -1, 2, 3])
    assert (
        match(blobs_at(np.zeros((1, 1, 2)), np.array([0])), places[None, None], np.zeros((1, 1, 2)), 5.0) == -1
    ).all()

"""Blobs as arrays agree with their table, and the shifts that the prior allows with sampled rigs."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from imgcal.association import pattern_prior
from imgcal.association.blobs import FAR, gather
from imgcal.errors import InputError
from imgcal.types import BlobFlag, RigPrior
from tests.imgcal.association.scenes import detections_of, take


def test_every_usable_blob_is_there_once_and_padding_is_far_away(o10, asymmetric8) -> None:
    given = take(o10, asymmetric8, 0, false=3).detections
    flags = given.flags.copy()
    flags[::7] = int(BlobFlag.BORDER)
    few = replace(given, flags=flags).select(given.camera != 4)
    blobs = gather(few, o10)
    assert blobs.count[4] == 0 and blobs.count.sum() == few.usable.sum() and blobs.rows == len(few)
    kept = blobs.row >= 0
    np.testing.assert_array_equal(kept.sum(1), blobs.count)
    assert sorted(blobs.row[kept]) == np.flatnonzero(few.usable).tolist()
    np.testing.assert_array_equal(blobs.uv[kept], few.uv[blobs.row[kept]])
    np.testing.assert_array_equal(np.nonzero(kept)[0], few.camera[blobs.row[kept]])
    assert (blobs.uv[~kept] == FAR).all() and (blobs.ideal[~kept] == np.float32(FAR)).all()


def test_the_first_of_two_blobs_in_one_place_counts(o10) -> None:
    uv = np.array([[5.0, 6.0], [7.0, 8.0], [5.0, 6.0], [5.0, 6.0]])
    blobs = gather(detections_of(uv, [1, 1, 1, 2], o10), o10)
    np.testing.assert_array_equal(blobs.count[:4], [0, 2, 1, 0])
    assert blobs.row[1, :2].tolist() == [0, 1] and blobs.row[2, 0] == 3


def test_ideal_pixels_are_those_that_opencv_undistorts(o10) -> None:
    rig = replace(o10, distortion=torch.tensor([[-0.12, 0.03, 1e-3, -8e-4, 0.005]]).double().expand(10, -1))
    uv = np.random.default_rng(0).uniform((0, 0), (2047, 1087), (200, 2))
    camera = np.arange(200) % 10
    blobs = gather(detections_of(uv, camera, rig), rig)
    for c in range(10):
        focal, principal = rig.focal_length[c].numpy(), rig.principal_point[c].numpy()
        matrix = np.array([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1]])
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        places = np.ascontiguousarray(blobs.uv[c, : blobs.count[c]])
        pixels = cv2.undistortImagePoints(places, matrix, rig.distortion[c].numpy(), arg1=criteria)[:, 0]
        expected = focal.mean() * (pixels - principal) / focal
        np.testing.assert_allclose(blobs.ideal[c, : blobs.count[c]], expected, atol=0.01)


def test_labels_of_blobs_become_labels_of_rows(o10, asymmetric8) -> None:
    snapshot = take(o10, asymmetric8, 1, false=2, missing=1)
    blobs = gather(snapshot.detections, o10)
    np.testing.assert_array_equal(blobs.to_rows(snapshot.labels(blobs, 8)), snapshot.truth)
    one = blobs.select_camera(3)
    alone = one.to_rows(snapshot.labels(blobs, 8)[[3]])
    np.testing.assert_array_equal(alone, np.where(snapshot.detections.camera == 3, snapshot.truth, -1))


def test_other_cameras_and_several_snapshots_are_an_error(o10, asymmetric8) -> None:
    given = take(o10, asymmetric8, 0).detections
    with pytest.raises(InputError, match="cameras"):
        gather(given, o10.select([0, 1]))
    with pytest.raises(InputError, match="several snapshots"):
        gather(replace(given, snapshot=np.arange(len(given)) % 2, snapshot_names=("0", "1")), o10)


def test_patterns_of_sampled_rigs_move_and_bend_as_much_as_the_spread_says(o10, asymmetric8) -> None:
    prior = RigPrior(focal_length=0.01, principal_point=5.0, distortion=0.0, rotation=0.005, position=3.0)
    std, distance = prior.std(o10), float(o10.working_distance)
    snapshot = take(o10, asymmetric8, 0, drift=None)
    points = snapshot.pose.apply(asymmetric8.points)
    drift = torch.randn(2000, 10, 15, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * std
    change = (o10.expand(2000).retract(drift).project(points).uv - o10.project(points).uv).numpy()
    allowed = pattern_prior(std, o10, distance)
    shift = change.mean(2)  # (K, C, 2)
    np.testing.assert_allclose(shift.std((0, 2)), allowed.shift, rtol=0.15)
    pattern = o10.project(points).uv.numpy()
    pattern = pattern - pattern.mean(1, keepdims=True)
    bent = (change - shift[:, :, None]) / np.sqrt((pattern**2).sum(-1).mean(1))[:, None, None]
    # Of lengths in the pattern, at most: a turn about the view moves all of it and bends none.
    assert 0.5 * allowed.shape < np.sqrt((bent**2).sum(-1).mean()) < 1.5 * allowed.shape


def test_what_a_lens_cannot_show_is_left_out(o10, asymmetric8) -> None:
    blobs = take(o10, asymmetric8, 0).detections
    distortion = o10.distortion.clone()
    distortion[3] = torch.nan  # fitted to nothing
    found, whole = gather(blobs, replace(o10, distortion=distortion)), gather(blobs, o10)
    others = [camera for camera in range(10) if camera != 3]
    assert found.count[3] == 0 and (found.uv[3] == FAR).all()
    assert (found.count[others] == whole.count[others]).all() and np.isfinite(found.ideal).all()

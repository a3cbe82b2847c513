"""A blob that may be several markers in one has no label."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import Associations, SnapshotIdentity, drop_merged, merging_distance
from imgcal.association.merging import MOST_REACH
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object
from imgcal.synthesis import arrange_rig
from imgcal.types import BlobFlag, CalibrationObject, Detections

RIG = arrange_rig("ring", 3, 3000.0, height=0.0)
WAND = load_object("wand4")
SIGMA = 0.02
TURN = rotation_from_vector(torch.tensor([0.0, 0.0, 0.02], dtype=torch.float64))
POSES = RigidTransform(TURN.repeat(2, 1, 1), torch.zeros(2, 3, dtype=torch.float64))
"""The bar points at the first camera, nearly, and at no other."""


def seen(radius, merged=True):
    """Labels of two snapshots: in the first camera, one blob in the middle of the bar's three markers."""
    uv = RIG.expand(2).project(POSES.apply(WAND.points)).uv.numpy()
    snapshot, camera, fiducial = np.nonzero(np.ones(uv.shape[:3], dtype=bool))
    places = uv[snapshot, camera, fiducial]
    kept = np.ones(len(camera), dtype=bool)
    if merged:
        bar = (camera == 0) & (fiducial < 3)
        places[bar] = places[bar].mean(0)
        kept &= ~bar | (fiducial == 1)
    table = Detections(
        uv=places, sigma=np.full(len(camera), SIGMA), camera=camera, snapshot=snapshot, fiducial=fiducial,
        radius=np.full(len(camera), radius), flags=np.zeros(len(camera), dtype=np.uint8),
        camera_names=RIG.camera_names, snapshot_names=("0", "1"),
    )  # fmt: skip
    return labels(table.select(kept))


def labels(table):
    poses = [SnapshotIdentity(name, "unique", "", 1, POSES[k]) for k, name in enumerate(table.snapshot_names)]
    return Associations(table, tuple(poses))


def dropped(labelled):
    """Camera and fiducial of the labels that are taken off, the same in both snapshots."""
    left = drop_merged(labelled, POSES, RIG, WAND).detections
    rows = np.flatnonzero((left.fiducial < 0) & (labelled.detections.fiducial >= 0))
    assert ((left.flags[rows] & BlobFlag.MERGED) > 0).all()
    found = [[(left.camera[r], labelled.detections.fiducial[r]) for r in rows if left.snapshot[r] == s] for s in (0, 1)]
    assert found[0] == found[1]
    return found[0]


@pytest.mark.parametrize("radius", [2.0, np.nan])
def test_a_blob_of_several_markers_loses_its_label(radius):
    assert dropped(seen(radius)) == [(0, 1)]


def test_of_many_markers_those_near_one_without_a_blob_lose_their_labels():
    generator = np.random.default_rng(0)
    points = torch.from_numpy(generator.uniform(-150, 150, (200, 3)))
    uv = RIG.expand(2).project(POSES.apply(points)).uv.numpy()
    has_blob = generator.random(uv.shape[:3]) < 0.9
    snapshot, camera, fiducial = np.nonzero(has_blob)
    radius = generator.uniform(0.5, 4.0, len(camera))
    table = Detections(
        uv=uv[has_blob], sigma=np.full(len(camera), SIGMA), camera=camera, snapshot=snapshot, fiducial=fiducial,
        radius=radius, flags=np.zeros(len(camera), dtype=np.uint8),
        camera_names=RIG.camera_names, snapshot_names=("0", "1"),
    )  # fmt: skip
    labelled = labels(table)
    reach = merging_distance(labelled, np.arange(len(table)))
    apart = np.linalg.norm(uv[snapshot, camera] - table.uv[:, None], axis=-1)
    expected = (~has_blob[snapshot, camera] & (apart < reach[:, None])).any(1)
    assert 0.02 < expected.mean() < 0.9
    left = drop_merged(labelled, POSES, RIG, CalibrationObject(points, torch.ones_like(points)))
    np.testing.assert_array_equal(left.detections.fiducial < 0, expected)


def test_a_marker_whose_neighbours_have_blobs_of_their_own_is_not_merged():
    assert dropped(seen(2.0, merged=False)) == []


def test_a_marker_is_not_merged_with_a_hidden_one_far_away():
    labelled = seen(2.0, merged=False)
    hidden = (labelled.detections.camera == 1) & (labelled.detections.fiducial == 1)
    assert dropped(labels(labelled.detections.select(~hidden))) == []


def test_a_snapshot_that_has_no_label_left_is_refused():
    labelled = seen(2.0)
    table = labelled.detections
    part = labels(table.select((table.snapshot == 0) | ((table.camera == 0) & (table.fiducial == 1))))
    assert [s.status for s in drop_merged(part, POSES, RIG, WAND).snapshots] == ["unique", "refused"]


def test_without_radii_the_closest_two_blobs_of_a_camera_say_how_close_markers_can_be():
    labelled = seen(np.nan, merged=False)
    table = labelled.detections
    reach = merging_distance(labelled, np.arange(len(table)))
    apart = np.linalg.norm(table.uv[:, None] - table.uv, axis=-1) + 1e9 * np.eye(len(table))
    for camera in range(3):
        own = np.flatnonzero((table.camera == camera) & (table.snapshot == 0))
        assert reach[own] == pytest.approx(min(apart[np.ix_(own, own)].min(), MOST_REACH))
    known = labels(replace(table, radius=np.full(len(table), 3.0)))
    assert merging_distance(known, np.array([0, 3])) == pytest.approx(8.0)

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_equal

from imgcal.online.resection import labels_at, resect_camera
from imgcal.types import RigPrior
from tests.imgcal.streams import Stream


def sightings(stream, camera, snapshots, turn_deg, false=1, noise=0.1):
    """What a camera that was turned sees; where the fiducials are; the true labels of the last snapshot."""
    after = stream.bumped([camera], turn_deg)
    blobs, labels = [], None
    for s in snapshots:
        seen = after.project(stream.poses[s].apply(stream.obj.points))
        rows = np.flatnonzero(seen.visible[camera].numpy())
        uv = seen.uv[camera].numpy()[rows] + noise * stream.random.standard_normal((len(rows), 2))
        clutter = stream.random.random((false, 2)) * after.image_size[camera].numpy()
        order = stream.random.permutation(len(rows) + false)
        blobs.append(np.concatenate((uv, clutter))[order])
        labels = np.concatenate((rows, np.full(false, -1)))[order]
    places = torch.stack([stream.poses[s].apply(stream.obj.points) for s in snapshots])
    return blobs, places, labels


def known(camera):
    return torch.zeros(1, camera.num_parameters, dtype=torch.float64)


def test_a_camera_with_another_lens_is_found_within_its_prior():
    """Its focal lengths were 2 % off, so no pose was within two pixels."""
    stream = Stream("T4", "asymmetric8", 40)
    blobs, places, labels = sightings(stream, 1, [0, 12, 24, 36], 15.0)
    alone = stream.rig.select([1])
    alone = replace(alone, focal_length=alone.focal_length * torch.tensor([0.98, 1.02]))
    assert resect_camera(blobs, places, alone, known(alone), np.random.default_rng(0)) is None
    place = resect_camera(blobs, places, alone, RigPrior().std(alone), np.random.default_rng(0))
    assert place is not None and ((place.labels < 0) | (place.labels == labels)).all()


@pytest.mark.parametrize(("rig", "obj", "turn_deg"), [("room10", "wand4", 25.0), ("T4", "asymmetric8", 15.0)])
def test_a_camera_turned_far_is_found(rig, obj, turn_deg):
    stream, found = Stream(rig, obj, 40), 0
    for camera in range(stream.rig.num_cameras):
        blobs, places, labels = sightings(stream, camera, [0, 12, 24, 36], turn_deg)
        if sum(len(uv) >= 5 for uv in blobs) < 2:
            continue  # it looks away now
        alone = stream.rig.select([camera])
        place = resect_camera(blobs, places, alone, known(alone), np.random.default_rng(0))
        if place is not None:
            found += 1
            named = place.labels
            assert ((named < 0) | (named == labels)).all()
            assert_equal(labels_at(blobs[-1], places[-1], place.camera), named)
            assert labels_at(blobs[-1], places[-1], alone) is None
    assert found >= 2


def test_blobs_that_no_place_explains_stay_without_labels():
    stream = Stream("room10", "wand4", 40)
    places = torch.stack([stream.poses[s].apply(stream.obj.points) for s in (0, 12, 24)])
    for seed in range(5):
        random = np.random.default_rng(seed)
        blobs = [random.random((5, 2)) * 1000 for _ in range(3)]
        alone = stream.rig.select([0])
        for std in (known(alone), RigPrior().std(alone)):
            assert resect_camera(blobs, places, alone, std, random) is None
            assert resect_camera([uv[:2] for uv in blobs], places, alone, std, random) is None

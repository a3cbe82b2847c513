"""A light and sticks among false blobs, without labels: nothing is labelled wrongly, and what cannot be is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import identify
from imgcal.errors import RefusedError
from imgcal.io import load_rig
from imgcal.pipeline import calibrate
from imgcal.synthesis import simulate_volume, true_detections
from imgcal.synthesis.rigs import PhysicalDrift
from imgcal.types import CalibrationObject, RigPrior

LIGHT = ((0.0, 0.0, 0.0),)
PAIR = ((-250.0, 0.0, 0.0), (250.0, 0.0, 0.0))
TRIPLE = ((-250.0, 0.0, 0.0), (-80.0, 0.0, 0.0), (250.0, 0.0, 0.0))


def capture(points, snapshots, seed=1, false=3):
    """Blobs in random order of a drifted room10: a quarter of the markers hidden, false blobs in every camera."""
    rig, rng = load_rig("room10"), np.random.default_rng(seed)
    obj = CalibrationObject(torch.tensor(points, dtype=torch.float64), torch.ones(len(points), 3))
    truth = simulate_volume(rig, obj, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())
    table = true_detections(truth)
    table = replace(table, sigma=np.full(len(table), 0.1))
    table = table.select(rng.random(len(table)) > 0.25)
    table.uv[:] += 0.1 * rng.standard_normal(table.uv.shape)
    camera = np.tile(np.repeat(np.arange(rig.num_cameras), false), snapshots)
    count = len(camera)
    added = {
        "uv": rng.random((count, 2)) * rig.image_size.numpy()[camera],
        "sigma": np.full(count, 0.1),
        "camera": camera,
        "snapshot": np.repeat(np.arange(snapshots), false * rig.num_cameras),
        "fiducial": np.full(count, -1),
        "radius": np.full(count, np.nan),
        "flags": np.zeros(count, dtype=table.flags.dtype),
    }
    columns = {name: np.concatenate((getattr(table, name), value)) for name, value in added.items()}
    table = replace(table, **columns)
    table = table.select(np.lexsort((rng.random(len(table)), table.camera, table.snapshot)))
    return rig, obj, replace(table, fiducial=np.full(len(table), -1)), table.fiducial


@pytest.mark.parametrize(("points", "snapshots"), [(LIGHT, 40), (PAIR, 20)])
def test_labels_among_false_blobs_are_right(points, snapshots):
    rig, obj, blobs, true = capture(points, snapshots)
    result = calibrate(blobs, rig, obj)
    labels = result.labelled_detections.fiducial
    given = labels >= 0
    assert given.sum() > 0.6 * (true >= 0).sum()
    kept = given & (result.labelled_detections.flags == blobs.flags)
    assert (true[kept] >= 0).all()
    for snapshot in range(snapshots):  # a stick may be held either way, but alike in all cameras
        rows = kept & (blobs.snapshot == snapshot)
        same, turned = labels[rows] == true[rows], labels[rows] == len(points) - 1 - true[rows]
        assert same.all() or (len(obj.symmetries) > 1 and turned.all())
    assert float(result.rms) < 0.12


def test_two_lights_are_no_single_light():
    rig, obj, blobs, _ = capture(PAIR, 8, false=0)
    light = CalibrationObject(obj.points[:1], obj.colours[:1])
    with pytest.raises(RefusedError, match="another place"):
        calibrate(blobs, rig, light)


def test_false_blobs_alone_are_no_light():
    rig, obj, blobs, true = capture(LIGHT, 8, false=6)
    noise = blobs.select(true < 0)
    std = RigPrior().std(rig)
    for snapshot in range(8):
        one = noise.select(noise.snapshot == snapshot)
        one = replace(one, snapshot=np.zeros(len(one), dtype=np.int64), snapshot_names=("0",))
        assert not identify(one, rig, obj, std).accepted

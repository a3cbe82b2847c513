"""Tables of blobs are cut into snapshots and joined again."""

import numpy as np
import torch

import imgcal
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.types import Detections


def some_blobs(snapshots: int) -> Detections:
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    return true_detections(simulate_truth(rig, obj, snapshots, torch.Generator().manual_seed(0), None))


def test_what_is_cut_and_joined_is_the_same() -> None:
    blobs = some_blobs(5)
    again = Detections.join([blobs.of_snapshots(0, 2), blobs.of_snapshots(2, 5)])
    assert again.snapshot_names == blobs.snapshot_names and again.camera_names == blobs.camera_names
    for name in ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags"):
        np.testing.assert_array_equal(getattr(again, name), getattr(blobs, name))


def test_chosen_snapshots_are_renumbered() -> None:
    blobs = some_blobs(5)
    chosen = blobs.choose_snapshots(np.array([1, 4]))
    assert chosen.snapshot_names == (blobs.snapshot_names[1], blobs.snapshot_names[4])
    np.testing.assert_array_equal(chosen.uv[chosen.snapshot == 1], blobs.uv[blobs.snapshot == 4])
    assert len(chosen) == int(np.isin(blobs.snapshot, [1, 4]).sum())
    assert len(blobs.choose_snapshots(np.zeros(0, dtype=np.int64))) == 0

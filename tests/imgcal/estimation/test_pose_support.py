"""Snapshots whose labels lie on one line are done without, by name."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.estimation import UndeterminedPosesError, has_poses, require_poses
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate
from imgcal.synthesis import PhysicalDrift, simulate_volume, true_detections

STEM = 3  # the fiducial of the wand that does not lie on a line with the others


def wand_capture(snapshots=8):
    rig, wand = read_rig("room10"), load_object("wand4")
    truth = simulate_volume(rig, wand, snapshots, torch.Generator().manual_seed(1), PhysicalDrift())
    table = true_detections(truth)
    table.uv[:] += 0.1 * np.random.default_rng(1).standard_normal(table.uv.shape)
    return rig, wand, table


def test_a_snapshot_that_loses_its_only_fiducial_off_the_line_is_named_and_left_out():
    rig, wand, table = wand_capture()
    bad = (table.snapshot == 5) & (table.fiducial == STEM)
    table.uv[bad] += np.random.default_rng(2).choice([-8.0, 8.0], size=(int(bad.sum()), 2))
    result = calibrate(table, rig, wand)
    refused = [s for s in result.labelled.snapshots if s.status == "refused"]
    assert [s.name for s in refused] == ["00005"] and "one line" in refused[0].reason
    assert len(result.observations.seen) == 7
    assert (result.labelled.detections.fiducial[table.snapshot == 5] == -1).all()


def test_a_snapshot_labelled_on_a_line_is_named_and_left_out():
    rig, wand, _ = wand_capture()
    longer = replace(wand, points=torch.cat((wand.points, torch.tensor([[80.0, 0, 0]], dtype=torch.float64))))
    truth = simulate_volume(rig, longer, 4, torch.Generator().manual_seed(1), PhysicalDrift())
    table = true_detections(truth)
    result = calibrate(table.select((table.snapshot != 2) | (table.fiducial != STEM)), rig, longer)
    assert [s.name for s in result.labelled.snapshots if s.status == "refused"] == ["00002"]


def test_a_fiducial_that_never_fits_is_no_matter_of_single_snapshots():
    rig, wand, table = wand_capture()
    bad = (table.snapshot < 5) & (table.fiducial == STEM)
    table.uv[bad] += np.random.default_rng(2).choice([-8.0, 8.0], size=(int(bad.sum()), 2))
    with pytest.raises(RefusedError, match="fiducial"):
        calibrate(table, rig, wand)


def test_breadth_is_relative_to_the_object():
    points = torch.tensor([[0.0, 0, 0], [100, 0, 0], [200, 0, 0], [0, 8, 0]])
    seen = np.ones((2, 3, 4), dtype=bool)
    require_poses(seen, points)
    seen[1, :, 3] = False
    with pytest.raises(UndeterminedPosesError) as found:
        require_poses(seen, points)
    assert found.value.rows == (1,)


def test_three_labels_fit_any_pose_and_determine_none():
    points = torch.tensor([[0.0, 0, 0], [100, 0, 0], [0, 80, 0], [60, 60, 40]])
    seen = np.zeros((3, 2, 4), dtype=bool)
    seen[0, 0, :3] = True  # three labels of one camera ...
    seen[1, 0, :2], seen[1, 1, 2] = True, True  # ... of two ...
    seen[2, 0, :2], seen[2, 1, 1:3] = True, True  # ... and four
    assert has_poses(seen, points).tolist() == [False, False, True]


def test_a_snapshot_that_is_left_with_three_labels_is_named_and_left_out():
    """An object that leaves the view: its pose slid along a valley, and no minimum was found."""
    rig, wand, table = wand_capture()
    last = np.flatnonzero((table.snapshot == 7) & (table.camera < 2))
    assert len(last) > 5
    table.uv[last[3:]] += np.random.default_rng(2).choice([-40.0, 40.0], size=(len(last) - 3, 2))
    result = calibrate(table.select((table.snapshot != 7) | (table.camera < 2)), rig, wand)
    (refused,) = (s for s in result.labelled.snapshots if s.status == "refused")
    assert refused.name == "00007" and "fewer than four labels" in refused.reason

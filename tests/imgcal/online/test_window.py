"""Windows of labelled snapshots: what they forget; fits of them: test_recalibrator, test_live_moves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import SnapshotIdentity
from imgcal.association.options import PipelineOptions
from imgcal.online.window import Kept, Usual, Window, WindowFit, stacked
from tests.imgcal.streams import Stream


@pytest.fixture(scope="module")
def stream() -> Stream:
    return Stream("T4", "asymmetric8", 4)


def window_of(stream, rigs=(None,) * 4) -> Window:
    kept = []
    for s, rig in enumerate(rigs):
        blobs, truth = stream.blobs(s, rig)
        blobs = replace(blobs, fiducial=truth, snapshot_names=(f"s{s}",))
        kept.append(Kept(blobs, SnapshotIdentity(f"s{s}", "by_tracking", "", 1, stream.poses[s])))
    return Window(tuple(kept), stream.rig.prior.std(stream.rig))


def test_what_a_camera_saw_is_forgotten_and_nothing_else(stream) -> None:
    kept = window_of(stream).kept[0]
    less = kept.without(2)
    assert kept.sees(2) and not less.sees(2) and less.sees(1)
    other = kept.blobs.camera != 2
    np.testing.assert_array_equal(less.blobs.fiducial[other], kept.blobs.fiducial[other])
    assert kept.blobs.fiducial[~other].min() >= 0  # the original stays


def test_after_a_move_older_labels_of_the_camera_are_gone_and_its_place_is_open(stream) -> None:
    window = window_of(stream)
    wide = torch.full((4, 15), 0.5, dtype=torch.float64)
    after = window.after_move(1, 2, wide)
    assert [k.sees(1) for k in after.kept] == [False, False, True, True]
    assert all(k.sees(c) for k in after.kept for c in (0, 2, 3))
    assert after.moved == {1: "s2"}
    assert (after.prior_std[1, :3] == 0.5).all()
    assert torch.equal(after.prior_std[1, 6:], window.prior_std[1, 6:])
    assert torch.equal(after.prior_std[[0, 2, 3]], window.prior_std[[0, 2, 3]])
    assert after.after_move(0, 4, wide).moved == {1: "s2", 0: ""}  # nothing from its new place yet


def test_snapshots_of_which_nothing_is_left_are_dropped(stream) -> None:
    window = window_of(stream)
    alone = replace(window, kept=tuple(k.without(0).without(2).without(3) for k in window.kept))
    assert [k.snapshot.name for k in alone.after_move(1, 3, alone.prior_std).kept] == ["s3"]


def test_snapshots_are_put_into_one_table_in_order(stream) -> None:
    window = window_of(stream)
    table = stacked(window.kept, stream.rig).detections
    assert table.snapshot_names == ("s0", "s1", "s2", "s3") and len(table) == sum(len(k.blobs) for k in window.kept)
    for s, kept in enumerate(window.kept):
        rows = table.snapshot == s
        np.testing.assert_array_equal(table.uv[rows], kept.blobs.uv)
        np.testing.assert_array_equal(table.fiducial[rows], kept.blobs.fiducial)


def test_a_camera_that_moved_in_the_window_is_named_with_its_snapshot(stream) -> None:
    bumped = stream.bumped([2], turn_deg=0.5)
    fit = WindowFit(stream.rig, stream.obj, PipelineOptions(), 4)
    still = fit(window_of(stream), None, Usual())
    assert not still.window.moved and still.tests
    fitted = fit(window_of(stream, (None, None, bumped, bumped)), None, Usual())
    assert fitted.window.moved == {2: "s2"}
    assert [k.sees(2) for k in fitted.window.kept] == [False, False, True, True]
    assert not fitted.window.restarted and fitted.result.rms < 0.2

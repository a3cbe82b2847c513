"""What the report is told of a run that was refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import associate
from imgcal.cli.report_content import describe_refusal, summarize_snapshots
from imgcal.errors import RefusedError
from imgcal.pipeline import EARLIER
from imgcal.report import SnapshotSummary
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import MovedCamera, MovedError


@pytest.fixture(scope="module")
def seen():
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
    return true_detections(truth), factory, obj


def test_snapshots_are_rejected_only_where_the_refusal_is_about_them(seen):
    def reasons(refusal):
        return [snapshot.reason for snapshot in describe_refusal(refusal, *seen, {}, {}).snapshots]

    assert reasons(RefusedError("estimation: no minimum after 40 iterations")) == [""] * 4
    assert all(reasons(RefusedError("identity: nothing wins clearly (4 of 4 snapshots)")))
    moved = MovedError([MovedCamera("cam02", "00002", "rotation", 0.3, 0.01)], 2, 4)
    assert reasons(moved) == [EARLIER, EARLIER, "", ""]


def test_rows_of_one_snapshot_are_counted_together(seen):
    blobs, factory, obj = seen
    labelled = associate(blobs, factory, obj)
    first, second, *others = labelled.snapshots
    two_objects = replace(
        labelled,
        snapshots=(
            replace(first, moment=0),
            replace(second, moment=0, status="refused", reason="not found"),
            *(replace(snapshot, moment=i + 1, status="refused", reason="blurred") for i, snapshot in enumerate(others)),
        ),
    )
    used = blobs.snapshot == 0
    found = np.bincount(blobs.snapshot)
    assert summarize_snapshots(two_objects, used) == (
        SnapshotSummary(first.name, found[0] + found[1], found[0]),
        SnapshotSummary(others[0].name, found[2], 0, "blurred"),
        SnapshotSummary(others[1].name, found[3], 0, "blurred"),
    )

"""What the report is told of a run that was refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import associate
from imgcal.cli.calibrate import trusted_covariance
from imgcal.cli.outcome import findings
from imgcal.cli.report_content import describe, describe_refusal, summarize_snapshots
from imgcal.errors import RefusedError
from imgcal.estimation import Gauge
from imgcal.pipeline import EARLIER
from imgcal.report import SnapshotSummary
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import MovedCamera, MovedError
from scripts.benchmarks.lights import LIGHTS, simulate


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


def test_a_picture_shows_every_marker_of_its_snapshot():
    scene = simulate(markers=8, moments=20, drift=0.3, seed=2)
    result = imgcal.calibrate(scene.detections, scene.factory, LIGHTS)
    found = findings(result, Gauge.from_majority(result.rig, scene.factory), trusted_covariance(result, 0))
    content = describe(result, found, scene.factory, {}, {})
    markers = len(np.unique(content.detections.snapshot[content.pictured]))
    assert markers == (result.labelled.moments == 0).sum() > 4

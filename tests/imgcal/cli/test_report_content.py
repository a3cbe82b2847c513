"""What the report is told of a run that was refused."""

import pytest
import torch

import imgcal
from imgcal.cli.report_content import describe_refusal
from imgcal.errors import RefusedError
from imgcal.pipeline import EARLIER
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

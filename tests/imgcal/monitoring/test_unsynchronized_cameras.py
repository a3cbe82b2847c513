"""Cameras with moments of their own: how probable, in the same measure as a camera that moved."""

import math
from dataclasses import replace

import pytest
import torch

from imgcal.estimation import EstimationOptions
from imgcal.monitoring import absorb
from imgcal.monitoring.measurement_update import stack_snapshots
from imgcal.monitoring.pending_change import free_cameras
from imgcal.monitoring.unsynchronized_cameras import (
    _evidence_of_few_labels,
    _evidence_of_sure_poses,
    drop_cameras,
    unsynchronized_evidence,
)
from scripts.benchmarks.rig_streams import Bump, Slip
from tests.imgcal.monitoring.followed import followed

BEFORE, COUNT, OPTIONS = 24, 3, EstimationOptions()


@pytest.mark.parametrize("rate", [2.0, 60.0])
@pytest.mark.parametrize("late", [0.0, 0.25])
def test_it_is_compared_with_a_move(rate: float, late: float) -> None:
    bumps = [] if late else [Bump(BEFORE, 1, "rotation", math.radians(0.5))]
    made = followed(BEFORE + COUNT, rate=rate, slips=[Slip(BEFORE, 1, late)] if late else [], bumps=bumps)
    before, (observations, poses) = made.beliefs[BEFORE], stack_snapshots(made.snapshots[BEFORE:])
    moved = absorb(free_cameras(before, {1: None}), observations, poses, OPTIONS).evidence
    apart = unsynchronized_evidence(before, observations, poses, [1], OPTIONS)
    assert (apart - moved > 50) == (late > 0) and abs(apart - moved) > 50
    both = unsynchronized_evidence(before, observations, poses, [1, 2], OPTIONS)
    assert both < apart - 20  # the other one is in time


def test_snapshots_with_too_few_labels_for_a_pose_are_compared_too() -> None:
    """Otherwise a move wins as soon as a late camera shows two fiducials once."""
    made = followed(BEFORE + COUNT, rate=2.0, slips=[Slip(BEFORE, 1, 0.25)])
    before, (observations, poses) = made.beliefs[BEFORE], stack_snapshots(made.snapshots[BEFORE:])
    seen = observations.seen.clone()
    seen[1, 1, 2:] = False
    few = replace(observations, seen=seen)
    moved = absorb(free_cameras(before, {1: None}), few, poses, OPTIONS).evidence
    assert unsynchronized_evidence(before, few, poses, [1], OPTIONS) - moved > 50


def test_few_labels_are_weighed_as_many_are() -> None:
    made = followed(BEFORE + COUNT, rate=2.0)
    belief, (observations, poses) = made.beliefs[BEFORE], stack_snapshots(made.snapshots[BEFORE:])
    alone = drop_cameras(observations, [0, 2, 3])
    fitted = _evidence_of_sure_poses(alone, OPTIONS, belief, poses)
    assert _evidence_of_few_labels(alone, OPTIONS, belief, poses) == pytest.approx(fitted, abs=1)  # of -134


def test_what_cameras_saw_is_left_out() -> None:
    observations, _ = followed(1).snapshots[0]
    less = drop_cameras(observations, [0, 2])
    assert not less.seen[:, [0, 2]].any() and torch.equal(less.seen[:, [1, 3]], observations.seen[:, [1, 3]])
    assert observations.seen[:, 0].any()

"""Cameras with moments of their own: how probable, in the same measure as a camera that moved."""

import math

import pytest
import torch

from imgcal.estimation import EstimationOptions
from imgcal.monitoring import absorb
from imgcal.monitoring.measurement_update import stack_snapshots
from imgcal.monitoring.pending_change import free_cameras
from imgcal.monitoring.unsynchronized import drop_cameras, unsynchronized_evidence
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


def test_what_cameras_saw_is_left_out() -> None:
    observations, _ = followed(1).snapshots[0]
    less = drop_cameras(observations, [0, 2])
    assert not less.seen[:, [0, 2]].any() and torch.equal(less.seen[:, [1, 3]], observations.seen[:, [1, 3]])
    assert observations.seen[:, 0].any()

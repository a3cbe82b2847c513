"""A clock that slips is distinguished from a camera that moves while the object moves."""

import math

import pytest

import imgcal
from imgcal.estimation import initial_pose
from scripts.benchmarks.rig_streams import Bump, Conditions, Slip, Stream
from tests.imgcal.monitoring.followed import monitor_of

BEFORE = 40


def told(**happened) -> tuple[list, list]:
    """Follow a rig until something is told: changes, and slips."""
    stream = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 5, Conditions(labelled=True), **happened)
    monitor, pose = monitor_of(stream.factory, stream.obj), None
    seen, _ = stream.labelled(0, BEFORE + 30)
    for number in range(BEFORE + 30):
        observations = seen.of_snapshots([number])
        pose = initial_pose(observations, monitor.filter.belief.rig, stream.obj) if pose is None else pose
        found = monitor.update(observations, pose, 1 / 60)
        pose = found.update.rig_from_object
        if found.changes or found.slips:
            return list(found.changes), list(found.slips)
    return [], []


@pytest.mark.parametrize("late", [0.002, -0.01, 0.0167])
def test_a_slip_is_told_with_its_camera_and_its_size(late: float) -> None:
    changes, (slip,) = told(slips=[Slip(BEFORE, 2, late)])
    assert changes == []
    assert slip.camera == 2
    assert slip.seconds == pytest.approx(late, abs=max(5 * slip.sigma, 2e-4))
    assert abs(slip.since - BEFORE) <= 1
    assert slip.odds > 0


@pytest.mark.parametrize(
    ("kind", "size"), [("rotation", math.radians(0.1)), ("position", 1.0), ("principal_point", 1.0)]
)
def test_a_move_while_the_object_moves_is_no_slip(kind: str, size: float) -> None:
    changes, slips = told(bumps=[Bump(BEFORE, 2, kind, size)])
    assert slips == []
    assert [change.camera for change in changes] == [2]


def test_nothing_is_told_of_a_rig_that_stands_still() -> None:
    assert told() == ([], [])

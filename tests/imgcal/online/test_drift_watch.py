"""Drift is reported once, for the right camera, when it is certain and large enough."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch

import imgcal
from imgcal.monitoring import RigBelief
from imgcal.online import RigKeeper
from imgcal.online.drift_watch import EVERY_SECONDS, DriftWatch, replace_cameras
from imgcal.online.keeper_memory import DRIFT_FROM
from scripts.benchmarks.rig_streams import Stream


def middle(camera: int) -> torch.Tensor:
    """Where the cameras look."""
    return 30.0 * torch.eye(3, dtype=torch.float64)


def test_a_slow_turn_is_told_of_its_camera() -> None:
    rig, obj = imgcal.load_rig("U7").to(torch.float64), imgcal.load_object("asymmetric8")
    sure = torch.tensor((1e-6,) * 3 + (0.01,) * 3 + (0.01,) * 4 + (1e-4,) * 5, dtype=torch.float64).expand(7, -1)
    belief, watch, told = RigBelief.of_prior(rig, obj, sure), DriftWatch(rig.camera_names), []
    step = torch.zeros(7, 15, dtype=torch.float64)
    step[3, 1] = math.radians(0.03)
    for number in range(5):
        time = number * EVERY_SECONDS
        told += watch.observe(replace(belief, rig=belief.rig.retract(number * step)), frozenset(), middle, time, number)
    assert [(event.kind, event.camera, event.change) for event in told] == [("drift", "cam04", "rotation")] * 2
    assert told[0].size is not None
    assert abs(told[0].size - 0.06) < 0.002
    assert told[0].since == 0.0
    assert watch.observe(belief, frozenset(), middle, 4 * EVERY_SECONDS + 1, 12) == []  # it was looked a moment ago


def test_a_camera_that_moved_does_not_drift() -> None:
    rig, obj = imgcal.load_rig("U7").to(torch.float64), imgcal.load_object("asymmetric8")
    belief, watch = (
        RigBelief.of_prior(rig, obj, torch.full((7, 15), 1e-4, dtype=torch.float64)),
        DriftWatch(rig.camera_names),
    )
    step = torch.zeros(7, 15, dtype=torch.float64)
    step[3, 1] = math.radians(1.0)
    watch.observe(belief, frozenset(), middle, 0.0, 0)
    there = replace(belief, rig=rig.retract(step))
    assert watch.observe(there, frozenset({3}), middle, 20.0, 1) == []
    assert watch.observe(there, frozenset(), middle, 40.0, 2) == []  # from where it is now


def test_a_move_between_two_looks_is_no_drift() -> None:
    rig, obj = imgcal.load_rig("U7").to(torch.float64), imgcal.load_object("asymmetric8")
    belief = RigBelief.of_prior(rig, obj, torch.full((7, 15), 1e-4, dtype=torch.float64))
    watch, step = DriftWatch(rig.camera_names), torch.zeros(7, 15, dtype=torch.float64)
    step[3, 1] = math.radians(1.0)
    watch.observe(belief, frozenset(), middle, 0.0, 0)
    there = replace(belief, rig=rig.retract(step))
    assert watch.observe(there, frozenset({3}), middle, 2.0, 1) == []  # bumped, and learnt again before the next look
    assert watch.observe(there, frozenset(), middle, EVERY_SECONDS + 1, 2) == []


def test_what_a_first_snapshot_taught_wrongly_is_no_drift() -> None:
    """A first half-hidden marker moves a camera by many standard deviations; more snapshots correct it."""
    rig, obj = imgcal.load_rig("U7").to(torch.float64), imgcal.load_object("asymmetric8")
    sure = torch.full((7, 15), 0.01, dtype=torch.float64)
    watch, step = DriftWatch(rig.camera_names), torch.zeros(7, 15, dtype=torch.float64)
    step[2, 6:8] = 12.0
    first = RigBelief.of_prior(rig.retract(step), obj, 5.0 * sure)
    settled = RigBelief.of_prior(rig, obj, sure)
    watch.observe(first, frozenset(), middle, 0.0, 0)
    assert watch.observe(settled, frozenset(), middle, EVERY_SECONDS + 1, 5) == []
    later = watch.observe(replace(settled, rig=rig.retract(step)), frozenset(), middle, 2 * EVERY_SECONDS + 2, 9)
    assert [(event.camera, event.change) for event in later] == [("cam03", "focal_length")]  # known as well as before


def test_what_is_not_known_any_more_has_not_drifted() -> None:
    """After a long pause the rig is known less well than before: what it is found to be then is no drift yet."""
    rig, obj = imgcal.load_rig("U7").to(torch.float64), imgcal.load_object("asymmetric8")
    sure = RigBelief.of_prior(rig, obj, torch.full((7, 15), 1e-5, dtype=torch.float64))
    watch, step = DriftWatch(rig.camera_names), torch.zeros(7, 15, dtype=torch.float64)
    step[3, 1] = math.radians(0.2)
    watch.observe(sure, frozenset(), middle, 0.0, 0)
    unsure = RigBelief.of_prior(rig.retract(step), obj, torch.full((7, 15), 0.01, dtype=torch.float64))
    assert watch.observe(unsure, frozenset(), middle, EVERY_SECONDS + 1, 1) == []


def test_values_that_change_without_moving_the_image_do_not_drift() -> None:
    """A principal point makes up for a longer focal length where the camera sees the object: both are being learnt."""
    rig, obj = imgcal.load_rig("U7").to(torch.float64), imgcal.load_object("asymmetric8")
    std = torch.full((7, 15), 0.01, dtype=torch.float64)
    std[:, :3] = 1e-5
    belief, step = RigBelief.of_prior(rig, obj, std), torch.zeros(7, 15, dtype=torch.float64)
    step[3, 6:8] = 2.0

    before_camera = torch.tensor([[[200.0, 10.0, 1000.0], [200.0, -10.0, 1000.0]]], dtype=torch.float64)
    seen = rig.select([3]).cam_from_rig.inverse().apply(before_camera)[0]

    def drifts(points: Callable[[int], torch.Tensor] = lambda camera: seen) -> list[tuple[str | None, str | None]]:
        watch = DriftWatch(rig.camera_names)
        watch.observe(belief, frozenset(), points, 0.0, 0)
        there = replace(belief, rig=rig.retract(step))
        found = watch.observe(there, frozenset(), points, EVERY_SECONDS + 1, 1)
        return [(event.camera, event.change) for event in found]

    assert drifts() == [("cam04", "focal_length")]
    assert drifts(lambda camera: seen[:0]) == []  # it has seen nothing lately
    step[3, 8] = -0.4  # a fifth of the focal length's change
    assert drifts() == []
    step[3, 6:9], step[3, 1] = torch.tensor([60.0, 60.0, -12.0]), math.radians(0.1)
    assert drifts() == [("cam04", "rotation")]  # which does move the image


def test_cameras_are_replaced() -> None:
    rig = imgcal.load_rig("T4").to(torch.float64)
    other = rig.retract(torch.full((4, 15), 0.01, dtype=torch.float64))
    mixed = replace_cameras(rig, other, [2])
    assert torch.equal(mixed.focal_length[2], other.focal_length[2])
    assert torch.equal(mixed.cam_from_rig.rotation[[0, 1, 3]], rig.cam_from_rig.rotation[[0, 1, 3]])


def test_the_drift_of_a_rig_that_began_with_its_factory_values_is_measured_once_it_is_learnt() -> None:
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 3)
    with RigKeeper(made.factory, made.obj) as keeper:
        for number in range(DRIFT_FROM + 6):
            keeper.update(made.snapshot(number), 2.0 * EVERY_SECONDS * number)
        since = keeper._memory.drift_watch.since
    assert set(since) == set(range(4))
    assert all(time >= 2.0 * EVERY_SECONDS * (DRIFT_FROM - 2) for time in since.values())

"""A late camera is reported; a bumped one is not."""

import math
from dataclasses import replace

import numpy as np
import torch

from imgcal.geometry import RigidTransform
from imgcal.online import ClockOffsets
from tests.imgcal.online.states import restart, state_at


def watched(late: dict[int, float], bump: float = 0.0) -> tuple[ClockOffsets, list]:
    """Watch three seconds at 20 a second; what is late, or bumped, is so from the first second on."""
    test, events = ClockOffsets(4), []
    for number in range(60):
        begun = number >= 20
        left = (np.array([late.get(camera, 0.0) for camera in range(4)]) if begun else 0.0) - test.late
        state = state_at(number, number / 20, lambda camera, left=left: left[camera], bump if begun else 0.0)
        events += test(state, None, None)
    return test, events


def test_a_late_camera_is_told_with_its_offset() -> None:
    test, events = watched({2: 0.01})
    assert {event.camera for event in events} == {"cam03"}
    assert {event.kind for event in events} == {"clock_slip"}
    assert events[0].unit == "frames"
    offset, sigma = test.offsets()
    assert np.all(np.abs(offset[[0, 1, 3]]) < 5 * sigma[[0, 1, 3]] + 1e-4)
    assert 0.0095 < offset[2] < 0.0105


def test_of_a_camera_in_doubt_no_offset_is_told() -> None:
    test, events = ClockOffsets(4), []
    for number in range(60):
        state = state_at(number, number / 20, lambda camera: 0.01 if camera == 2 else 0.0)
        events += test(replace(state, cameras={"cam03": "doubtful"}), None, None)
    assert events == [] and np.isnan(test.offsets()[0][2])


def test_a_small_offset_is_reckoned_with_and_not_told() -> None:
    test, events = watched({2: 5e-4})
    assert events == []
    assert 4e-4 < test.late[2] < 6e-4
    assert (test.late[[0, 1, 3]] == 0).all()


def test_cameras_in_time_and_bumped_cameras_are_not_told() -> None:
    assert watched({})[1] == []
    assert watched({}, bump=2.0)[1] == []


def test_an_object_that_stands_still_says_nothing_of_clocks() -> None:
    test, random, events = ClockOffsets(4), np.random.default_rng(0), []
    still = state_at(0, 0.0)
    assert still.rig_from_object is not None
    for number in range(80):  # the pose is off by noise, and residuals are off by as much the other way
        shift = torch.from_numpy(0.05 * random.standard_normal(3))
        pose = RigidTransform(still.rig_from_object.rotation, still.rig_from_object.translation + shift)
        image = still.rig.expand(1).project_values(pose.apply(still.belief.obj.points)[None])
        state = replace(still, time=number / 20, predicted=image.uv[0].numpy(), rig_from_object=pose)
        events += test(state, None, None)
    assert events == []
    assert np.isnan(test.offsets()[0]).all()


def test_a_rig_that_is_learnt_anew_is_no_motion_of_the_object() -> None:
    test, events = ClockOffsets(4), []
    for number in range(60):
        state = state_at(number, number / 20)
        step = torch.zeros(4, 15, dtype=torch.float64)
        step[1, 0] = 2e-3 * math.sin(number)
        rig, pose = state.rig.retract(step), state.rig_from_object
        assert pose is not None
        image = rig.expand(1).project_values(pose.apply(state.belief.obj.points)[None])
        belief = replace(state.belief, rig=rig)
        events += test(replace(state, belief=belief, predicted=image.uv[0].numpy()), None, None)
    offset, sigma = test.offsets()
    assert events == []
    assert np.all((np.abs(offset) < 5 * sigma + 1e-3)[[0, 2, 3]])


def test_a_few_snapshots_of_a_camera_say_nothing_of_its_clock() -> None:
    test, events = ClockOffsets(4), []
    for number in range(90):  # camera 2 is late for a fifth of a second, and then sees nothing
        state = state_at(number, number / 20, lambda camera, late=number >= 10: 0.01 * (late and camera == 2))
        if number >= 14:
            rows = np.flatnonzero(state.detections.camera != 2)
            state = replace(state, detections=state.detections.select(rows), lag=state.lag[rows])
        events += test(state, None, None)
    assert events == []


def test_errors_that_last_do_not_look_like_a_late_clock() -> None:
    def follow(late: float, persistent: float, seed: int) -> tuple[float, float]:
        """Correction (s) of a camera whose image is shifted, another way after ten snapshots; its largest z-score."""
        test, random, shift, scores = ClockOffsets(4), np.random.default_rng(seed), np.zeros(2), [0.0]
        for number in range(100):
            shift = 0.9 * shift + 0.15 * (1 - 0.9**2) ** 0.5 * random.standard_normal(2)
            state = state_at(number, number / 60, lambda camera: (late - test.late[2]) * (camera == 2))
            uv = state.detections.uv + shift * (state.detections.camera == 2)[:, None]
            noise = np.array([0.0, 0.0, persistent, 0.0])
            list(test(replace(state, detections=replace(state.detections, uv=uv), persistent=noise), None, None))
            offset, sigma = test.offsets()
            scores.append(abs(float(offset[2] - test.late[2]) / float(sigma[2])) if number > 40 else 0.0)
        return float(test.late[2]), max(scores)

    lasting = 0.15 * (1.9 / 0.1) ** 0.5  # times the root of the correlation time
    assert follow(late=0.0, persistent=0.0, seed=4)[1] > 6  # as if the noise were independent
    assert all(follow(late=0.0, persistent=lasting, seed=seed)[1] < 3 for seed in (0, 4, 5))
    assert abs(follow(late=0.03, persistent=lasting, seed=4)[0] - 0.03) < 1e-3


def test_what_was_told_is_kept() -> None:
    test, _ = watched({2: 0.01})
    again = restart(test, ClockOffsets(4))
    assert again.late[2] != 0
    for number in (1000, 1001):  # where motion goes on, it is that since the last snapshot before
        for one in (test, again):
            list(one(state_at(number, 1e6 + number / 20, lambda camera: 0.0), None, None))
    for one, other in zip(test.offsets(), again.offsets(), strict=True):
        np.testing.assert_array_equal(one, other)

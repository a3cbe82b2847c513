from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.live_page.contents import belief_message
from imgcal.live_page.guidance import compare, compute_guidance, information_gain
from imgcal.live_page.rig_drawing import viewing_volume
from imgcal.monitoring import RigBelief, absorb
from imgcal.types import Observations
from tests.imgcal.live_page.pages import made_state

PLACES = torch.tensor([[0.0, 0.0, 850.0], [150.0, 80.0, 800.0], [0.0, 0.0, -500.0]]).double()


def seen_at(rig, obj, place):
    state = made_state(rig, obj, place=place)
    observations = Observations(
        torch.as_tensor(state.predicted)[None],
        torch.full((1, rig.num_cameras, obj.num_fiducials), 0.1).double(),
        torch.ones(1, rig.num_cameras, obj.num_fiducials, dtype=torch.bool),
    )
    return observations, state.rig_from_object.reshape(1)


def test_the_gain_is_what_the_filter_learns(o10, asymmetric8):
    """Information gain against the determinants of the filter's own covariance before and after such a snapshot."""
    belief = RigBelief.of_prior(o10, asymmetric8)
    observations, pose = seen_at(o10, asymmetric8, PLACES[1])
    after = absorb(belief, observations, pose).belief
    expected = float(after.factor.diagonal().log().sum() - belief.factor.diagonal().log().sum())
    points = pose.apply(asymmetric8.points)[0]
    shape, middle = points - points.mean(0), points.mean(0)
    gain = information_gain(belief, belief.covariance(), middle[None], shape, 0.1)
    assert float(gain[0]) == pytest.approx(expected, rel=0.02)


def test_nothing_is_learnt_where_nothing_is_seen_and_less_where_one_has_been(o10, asymmetric8):
    belief = RigBelief.of_prior(o10, asymmetric8)
    shape = asymmetric8.points - asymmetric8.points.mean(0)
    before = information_gain(belief, belief.covariance(), PLACES, shape, 0.1)
    assert before[2] == 0 and before[0] > 10
    after = absorb(belief, *seen_at(o10, asymmetric8, PLACES[0])).belief
    gain = information_gain(after, after.covariance(), PLACES, shape, 0.1)
    assert gain[0] < gain[1] < before[1]


def test_the_page_is_told_how_well_the_volume_is_known(o10, asymmetric8):
    state = made_state(o10, asymmetric8)
    advice = compute_guidance(belief_message(state), asymmetric8.points.numpy(), viewing_volume(o10))
    assert advice["time"] == state.time
    assert np.shape(advice["mm"]) == np.shape(advice["count"]) == (9, 9, 9)
    assert 0 < advice["median"] < advice["p95"] and advice["best"] == int(np.argmax(advice["gain"]))


def test_the_page_says_the_deviations_of_the_state_where_the_rig_has_moved_too(o10, asymmetric8):
    state = made_state(o10, asymmetric8)
    step = torch.zeros(10, 15).double()
    step[6, 1], step[2, 3] = 0.1, 30.0
    state = replace(state, belief=replace(state.belief, rig=state.belief.rig.retract(step)))
    rig, _, std = compare(belief_message(state))
    assert torch.equal(rig.focal_length, state.rig.focal_length) and torch.equal(rig.positions, state.rig.positions)
    assert std.numpy() == pytest.approx(state.std.numpy(), rel=1e-12)


def test_a_camera_that_turned_has_turned_and_no_other(o10, asymmetric8):
    state = made_state(o10, asymmetric8)
    step = torch.zeros(10, 15).double()
    step[6, 1] = 0.005
    state = replace(state, belief=replace(state.belief, rig=state.belief.rig.retract(step)))
    _, change, _ = compare(belief_message(state))
    turned = np.linalg.norm(change[:, :3], axis=1)
    assert turned[6] == pytest.approx(0.005, rel=1e-3) and np.delete(turned, 6).max() < 1e-4

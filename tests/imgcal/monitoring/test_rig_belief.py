"""Belief about a rig: what it must never learn, and the effect of time."""

import pytest
import torch

import imgcal
from imgcal.estimation import displace
from imgcal.monitoring import RigBelief, absorb, age_belief
from imgcal.types import DriftRate
from tests.imgcal.monitoring.made_snapshots import SQUARED, made_snapshots, snapshots


@pytest.fixture(scope="module")
def made():
    return made_snapshots()


def test_nothing_is_learnt_of_motions_of_the_whole_rig(made) -> None:
    factory, obj, _, _ = made
    prior = belief = RigBelief.of_prior(factory, obj)
    for s in range(24):  # each linearized elsewhere
        belief = absorb(belief, *snapshots(made, s, s + 1), SQUARED).belief
    whole = torch.cat((torch.eye(6, dtype=torch.float64), torch.zeros(9, 6, dtype=torch.float64))).repeat(4, 1)
    whole = whole / belief.unit.reshape(-1, 1)
    before, after = (whole.mT @ b.information @ whole for b in (prior, belief))
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4 * float(before.max()))


def test_standard_deviations_are_those_of_the_covariance(made) -> None:
    factory, obj, _, _ = made
    for belief in (
        RigBelief.of_prior(factory, obj),
        absorb(RigBelief.of_prior(factory, obj), *snapshots(made, 0, 3)).belief,
    ):
        expected = belief.covariance().diagonal().sqrt().view(belief.unit.shape)
        torch.testing.assert_close(belief.std(), expected, rtol=1e-9, atol=0)


def test_time_widens_what_is_known_and_moves_nothing(made) -> None:
    factory, obj, _, _ = made
    rate = DriftRate(focal_length=1e-3, principal_point=2.0, distortion=1e-3, rotation=1e-3, position=1.0)
    known = absorb(RigBelief.of_prior(factory, obj), *snapshots(made, 0, 6), SQUARED).belief
    later = age_belief(known, 4 * 3600.0, rate)
    expected = (known.std().square() + 4 * rate.std(known.rig).square()).sqrt()
    torch.testing.assert_close(later.std(), expected, rtol=1e-6, atol=0)
    assert later.rig is known.rig


def test_a_belief_may_be_moved_as_a_whole(made) -> None:
    factory, obj, _, _ = made
    belief = RigBelief.of_prior(factory, obj)
    assert torch.allclose(belief.std(), (factory.prior or imgcal.types.RigPrior()).std(factory), rtol=1e-6)
    assert displace(belief.rig, torch.zeros(4, 15, dtype=torch.float64)).camera_names == factory.camera_names

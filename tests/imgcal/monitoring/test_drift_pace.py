"""A camera that drifts faster than is taken for granted is followed as fast, and no other."""

import math

import pytest
import torch

import imgcal
from imgcal.monitoring import CHANGES, OwnTest, RigBelief, RigFilter, RigMonitor, camera_change_errors, pixel_changes
from imgcal.monitoring.drift_pace import ADDED_TOGETHER, STRETCH_SECONDS, DriftLearning, DriftPaces, Stretch
from imgcal.types import CameraRig, DriftRate
from scripts.benchmarks.rig_streams import Conditions, Stream
from tests.imgcal.monitoring.followed import Followed, followed

STEADY = DriftRate(0.0, 0.0, 0.0, 0.0, 0.0)
RATE = 10.0  # snapshots/s


def known(sigma: float = 0.01) -> RigBelief:
    """A rig of four cameras of which everything is known to this part of what the factory knows."""
    rig, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    return RigBelief.of_prior(rig, obj, sigma * imgcal.types.RigPrior().std(rig))


def drifted(belief: RigBelief, step: torch.Tensor, generator: torch.Generator) -> Stretch:
    """A stretch that measured every value, twice as well as it was known, of a rig that went by a step (C, K)."""
    stretch = Stretch.after(belief)
    stretch.seconds = STRETCH_SECONDS
    brought = 4 * belief.information
    error = torch.einsum("cij,cj->ci", camera_change_errors(belief.rig, belief.unit), step).flatten()
    noise = torch.linalg.cholesky(brought) @ torch.randn(len(brought), generator=generator, dtype=torch.float64)
    stretch.add(belief, brought, brought @ error + noise)
    return stretch


def test_a_pace_is_learnt_of_its_camera_and_kind_and_forgotten() -> None:
    belief, generator, paces = known(1e-3), torch.Generator().manual_seed(1), DriftPaces(4)
    walk = DriftRate().std(belief.rig)
    noise = belief.std()  # and no more: what is known leaves room for nothing but drift
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[2, 6:8] = 10 * walk[2, 6:8] * math.sqrt(STRETCH_SECONDS / 3600) + 3 * noise[2, 6:8]
    lacking = sum(paces.add_stretch(drifted(belief, step, generator), walk) for _ in range(8))
    pace = paces.squared.sqrt()
    assert pace[2, 2] > 10
    assert (pace > 2).sum() == 1
    assert lacking[2, 6] > 0 and bool((lacking[:2] <= 1e-2 * lacking[2, 6]).all())
    assert torch.equal(paces.of_parameters(15)[2, 6:8], pace[2, 2].expand(2))
    for _ in range(20):
        paces.add_stretch(drifted(belief, torch.zeros_like(step), generator), walk)
    assert bool((paces.squared < 4).all())


def test_what_is_added_up_is_what_the_snapshots_say() -> None:
    belief, generator = known(), torch.Generator().manual_seed(3)
    step = 1e-3 * belief.unit * torch.randn(4, 15, generator=generator, dtype=torch.float64)
    whole, other = drifted(belief, step, generator), Stretch.after(belief)
    there = RigBelief.of_prior(belief.rig.retract(0.5 * step), belief.obj, belief.unit)
    error = torch.einsum("cij,cj->ci", camera_change_errors(belief.rig, belief.unit), 0.5 * step).flatten()
    other.add(there, whole.brought, whole.pull - whole.brought @ error)  # the same from another place
    other.seconds = STRETCH_SECONDS
    torch.testing.assert_close(other.pull, whole.pull, rtol=1e-4, atol=1e-6 * float(whole.pull.abs().max()))
    test = other.test(STEADY)
    assert torch.allclose(test.learnt, whole.test(STEADY).learnt)
    wider = whole.test(DriftRate(rotation=1.0))  # whatever it turned may have been drift
    assert bool((wider.each.scores()["rotation"] < test.each.scores()["rotation"]).all())


def test_changes_of_a_camera_are_estimated_beside_what_wanders() -> None:
    generator = torch.Generator().manual_seed(5)
    root = torch.randn(15, 30, generator=generator, dtype=torch.float64)
    learnt, pull = root @ root.mT, torch.randn(15, generator=generator, dtype=torch.float64)
    rig = imgcal.load_rig("T4").to(torch.float64).select([0])
    test, part = OwnTest(pull[None], learnt[None], pixel_changes(rig)), CHANGES["position"]
    variance = torch.tensor([[0.3, 0.01, 2.0]], dtype=torch.float64)
    own = learnt[part, part]
    expected = torch.linalg.inv(torch.linalg.inv(own) + variance[0].diag())
    information, found = test.change("position", variance)
    torch.testing.assert_close(information[0], expected)
    torch.testing.assert_close(found[0], expected @ torch.linalg.solve(own, pull[part]))


def crept(turn: float, seconds: int, seed: int) -> tuple[RigMonitor, CameraRig, int]:
    """Follow a rig of which a camera turns slowly (rad/s) after half a minute."""
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), seed,
                  Conditions(rate=RATE, labelled=True, drift=STEADY))  # fmt: skip
    monitor, told = RigMonitor(RigFilter(made.factory, made.obj)), 0
    creep = torch.zeros(4, 15, dtype=torch.float64)
    creep[2, 1] = turn / RATE
    for first, last in ((0, 300), (300, int(seconds * RATE))):
        poses = made.poses_at(torch.arange(first, last, dtype=torch.float64) / RATE)
        observations, _ = made.labelled(first, last)
        for row in range(last - first):
            one = observations.of_snapshots([row])
            told += len(monitor.update(one, poses[row : row + 1], 1 / RATE).changes)
        made.creep = creep
    return monitor, made.rig, told


@pytest.mark.parametrize("turn", [0.0, math.radians(0.1) / 600])
def test_a_camera_that_turns_slowly_is_followed_without_alarm_and_known_to_be(turn: float) -> None:
    monitor, rig, told = crept(turn, 300, seed=3)
    assert told == 0
    pace = monitor.filter.pace
    belief = monitor.filter.belief
    error = belief.rig.local(rig).flatten()
    squared = float(error @ torch.linalg.solve(belief.covariance(), error)) / len(error)
    assert 0.4 < squared < 1.8
    assert float(pace[[0, 1, 3]].max()) < 1.5
    assert (float(pace[2, :3].max()) > 1.7) == (turn > 0)


def grown_up() -> Followed:
    """A filter whose first snapshots are no longer kept."""
    made = followed(40)
    made.filter._young = False
    return made


def test_it_begins_once_the_filter_has_grown_up_and_nothing_has_changed() -> None:
    made, learning = followed(20), DriftLearning(DriftPaces(4))
    learning.update(made.filter, made.recent, 1 / 60, quiet=True)
    assert learning.stretch is None  # young
    made = grown_up()
    learning.update(made.filter, made.recent, 1 / 60, quiet=True)
    assert learning.stretch is not None
    learning.update(made.filter, made.recent, 1 / 60, quiet=False)
    assert learning.stretch is None


def test_snapshots_are_added_to_the_stretch_and_a_stretch_to_the_paces() -> None:
    made, learning = grown_up(), DriftLearning(DriftPaces(4))
    for _ in range(ADDED_TOGETHER):
        learning.update(made.filter, made.recent, 0.1, quiet=True)
    assert learning.stretch is not None and learning.waiting == ADDED_TOGETHER - 1
    assert not learning.stretch.brought.any()
    learning.update(made.filter, made.recent, 0.1, quiet=True)
    assert learning.waiting == 0 and bool(learning.stretch.brought.any())
    known = learning.stretch
    learning.paces.squared[1] = 9.0
    learning.update(made.filter, made.recent, 20.0, quiet=True)
    assert learning.stretch is not known and learning.stretch.seconds < 20.0
    assert torch.equal(made.filter.pace, learning.paces.of_parameters(15))

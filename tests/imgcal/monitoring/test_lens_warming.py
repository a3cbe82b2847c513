"""Warming lenses explain what looks like an object of another size, at their own pace."""

import pytest
import torch

import imgcal
from imgcal.monitoring import CHANGES
from imgcal.monitoring.case import Case
from imgcal.monitoring.explanations import Steady, weigh
from imgcal.monitoring.lens_warming import LEAST_SECONDS, MOST_SECONDS, OWN_PACE, PACE, Warmed
from imgcal.monitoring.object_change import ObjectChanged
from imgcal.monitoring.rig_belief import widen_along
from tests.imgcal.monitoring.followed import Followed, followed

BEFORE, COUNT = 40, 30


@pytest.fixture(scope="module")
def warmed() -> Followed:
    """All focal lengths grow by 0.06 % a second."""
    creep = torch.zeros(4, 15, dtype=torch.float64)
    creep[:, CHANGES["focal_length"]] = 1e-5 * imgcal.load_rig("T4").focal_length
    return followed(BEFORE + COUNT, creep=creep)


def case_of(made: Followed, seconds: float = 1 / 60) -> Case:
    return Case(made.beliefs[BEFORE], made.snapshots, [seconds] * len(made.snapshots), COUNT)


def test_focal_lengths_that_grow_together_are_warmed_lenses(warmed: Followed) -> None:
    verdict = weigh(case_of(warmed))
    assert verdict.best.name == Warmed.name
    assert verdict.evidence(Warmed.name) > verdict.evidence(Steady.name) + 5
    assert verdict.evidence(Warmed.name) > verdict.evidence(ObjectChanged.name)


@pytest.mark.parametrize(("seconds", "counted"), [(1e-3, LEAST_SECONDS), (0.1, 3.0), (10.0, MOST_SECONDS)])
def test_focal_lengths_are_free_by_the_time_that_has_passed(warmed: Followed, seconds: float, counted: float) -> None:
    case = case_of(warmed, seconds)
    (make,) = Warmed().variants(case)
    before, after = (torch.cholesky_inverse(belief.factor) for belief in (case.before, make().before))
    focal = case.before.rig.focal_length
    added = ((after - before).diagonal()[: case.before.unit.numel()].view_as(case.before.unit)) * case.before.unit**2
    expected = (PACE**2 + OWN_PACE**2) * (counted * focal) ** 2
    assert torch.allclose(added[:, CHANGES["focal_length"]], expected, rtol=1e-3)


def test_knowing_less_along_a_change_adds_its_square(warmed: Followed) -> None:
    belief = warmed.beliefs[BEFORE]
    step = torch.zeros(1, *belief.unit.shape, dtype=torch.float64)
    step[0, :, CHANGES["focal_length"]] = 2.0
    rows = torch.zeros_like(belief.unit)
    rows[:, CHANGES["focal_length"]] = 2.0
    change = (rows / belief.unit).flatten()
    added = torch.cholesky_inverse(widen_along(belief, step).factor) - torch.cholesky_inverse(belief.factor)
    wide = len(change)
    assert torch.allclose(added[:wide, :wide], change[:, None] * change, atol=1e-6)

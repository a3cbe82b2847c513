import pytest
import torch

from imgcal.errors import InputError
from imgcal.evaluation import AXES, Method, Protocol, sweep
from imgcal.evaluation.methods import keep_factory_rig
from imgcal.synthesis import RelativeDrift

FACTORY = {"factory": Method(keep_factory_rig)}
FEW = Protocol(count=6, trials=1)


def test_the_error_of_the_factory_rig_grows_with_the_perturbation(conditions):
    found = sweep(FACTORY, conditions(), "kappa", FEW, (0.0, 0.01, 0.03))
    means = [evaluation.rows["factory"].alone.statistics()["mean"] for evaluation in found.evaluations]
    assert means[0] < 0.01 < means[1] < means[2]
    assert found.evaluations[1].conditions.drift == RelativeDrift(0.01, 0.01)


def test_the_angle_is_that_of_the_rig(conditions):
    known = AXES["phi"].at(conditions(), 30.0)
    assert known.pose_range.phi_deg == (30, 30)
    assert known.pose_range.theta_deg == conditions().pose_range.theta_deg


@pytest.mark.parametrize("kind", ["noise", "missing", "swapped", "false"])
def test_one_kind_of_corruption_is_varied(conditions, kind):
    before = conditions(noise=0.1, missing=0.05)
    after = AXES[kind].at(before, 0.25)
    assert vars(after.corruption) == vars(before.corruption) | {kind: 0.25}
    assert after.drift == before.drift


def test_all_points_see_the_same_rigs(conditions):
    found = sweep(FACTORY, conditions(), "noise", FEW, (0.0, 1e-6))
    first, second = (evaluation.rows["factory"].alone.re for evaluation in found.evaluations)
    assert torch.allclose(first, second, atol=1e-3)


def test_an_unknown_axis_is_refused(conditions):
    with pytest.raises(InputError, match="nearest: kappa"):
        sweep(FACTORY, conditions(), "kapa", FEW)

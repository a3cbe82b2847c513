import math
from dataclasses import replace

import pytest
import torch

from imgcal.errors import InputError, RefusedError
from imgcal.evaluation import BASELINES, Conditions, Errors, Method, Protocol, Scores, evaluate, network_method
from imgcal.evaluation.methods import Refined, keep_factory_rig
from imgcal.evaluation.metrics import KINDS
from imgcal.evaluation.protocol import LEAST_SIGMA, draw
from imgcal.synthesis import LEVELS, Degradation, ImageOptions
from tests.imgcal.evaluation.conftest import Fake, straight_down

FACTORY = {"factory": Method(keep_factory_rig)}


def of_re(values: list[float]) -> Errors:
    zeros = dict.fromkeys(KINDS, torch.ones(len(values), dtype=torch.float64))
    return Errors(**(zeros | {"re": torch.tensor(values, dtype=torch.float64)}))


def test_statistics_of_known_errors():
    found = Scores((of_re([0.0, 1.0]), of_re([0.2, 2.8])), ()).statistics()
    assert found["rigs"] == 4
    assert found["mean"] == pytest.approx(1.0)
    assert found["spread"] == pytest.approx(2**-0.5)
    assert found["trial_means"] == pytest.approx((0.5, 1.5))
    assert found["median"] == pytest.approx(0.6)
    assert found["share_under_half_px"] == found["share_under_one_px"] == 0.5  # 1 px is not under 1 px
    trial = of_re([0.0, 1.0])
    held_out = Scores((replace(trial, held_out=torch.tensor([3.0, 5.0])),), ()).statistics("held_out")
    assert (held_out["mean"], held_out["rigs"]) == (4.0, 2)
    assert Scores((of_re([0.0, 1.0]),), ()).statistics()["spread"] is None


def test_what_was_not_found_is_counted_and_is_in_no_mean():
    wild = of_re([1.0, 2e39, 3.0, torch.inf]).where(torch.tensor([True, False, True, True]))
    scores = Scores((wild, of_re([2.0])), (of_re([0.5]),))
    found = scores.statistics()
    assert (found["rigs"], found["found"], found["median"]) == (5, 0.6, 2.0)
    assert found["mean"] == 2.0 and found["spread"] == 0.0
    assert found["share_under_one_px"] == 0.0 and scores.parameters()["position"] == 1.0
    assert Scores((of_re([9.0, 1.0]).where(torch.tensor([False, True])),), (of_re([9.0, 0.5]),)).cramer_rao_ratios()[
        "re"
    ] == pytest.approx(2.0)
    nothing = Scores((of_re([1.0]).where(torch.tensor([False])),), (of_re([1.0]),))
    assert nothing.statistics()["found"] == 0.0 and math.isnan(nothing.statistics()["mean"])
    assert nothing.cramer_rao_ratios()["re"] is None


def test_refinements_that_fail_are_in_no_mean(conditions):
    known = straight_down(conditions(kappa=0.002))
    fake = network_method(Fake(known))

    def refine(prediction, given):
        refined = fake.refine(prediction, given)
        wild = refined.prediction.rig.focal_length.clone()
        wild[0] = 1e30
        rig = replace(refined.prediction.rig, focal_length=wild)
        return Refined(replace(refined.prediction, rig=rig), torch.arange(len(wild)) > 0)

    found = evaluate({"fake": replace(fake, refine=refine)}, known, Protocol(count=6, trials=2)).rows["fake"].refined
    assert found.statistics()["found"] == pytest.approx(5 / 6) and found.statistics()["mean"] < 0.02
    assert found.statistics()["share_under_one_px"] == pytest.approx(5 / 6)


def test_cramer_rao_ratios_are_of_the_rigs_that_have_a_bound():
    scores = Scores((of_re([3.0, 4.0, 100.0]),), (of_re([2.0, 1.0]),))
    assert scores.cramer_rao_ratios()["re"] == pytest.approx(5**0.5)
    assert Scores((of_re([1.0]),), (of_re([0.0]),)).cramer_rao_ratios()["re"] is None
    assert Scores((of_re([1.0]),), ()).cramer_rao_ratios()["re"] is None


def test_rigs_depend_on_the_seed_and_the_trial_but_not_on_the_methods(conditions):
    known = conditions(noise=0.1, missing=0.1)
    few = Protocol(count=7, trials=2, batch=4)
    alone = evaluate(FACTORY, known, few)
    both = evaluate({"pnp": BASELINES["MAP from PnP"]} | FACTORY, known, few)
    assert torch.equal(alone.rows["factory"].alone.re, both.rows["factory"].alone.re)
    first, second = alone.rows["factory"].alone.trials
    assert len(first) == len(second) == 7
    assert not torch.equal(first.re, second.re)
    other = evaluate(FACTORY, known, replace(few, seed=1))
    assert not torch.equal(alone.rows["factory"].alone.re, other.rows["factory"].alone.re)


def test_a_slow_method_gets_the_first_rigs_of_every_trial(conditions):
    methods = FACTORY | {"slow": replace(FACTORY["factory"], most=5)}
    found = evaluate(methods, conditions(), Protocol(count=9, trials=2, batch=4))
    for all_rigs, some in zip(found.rows["factory"].alone.trials, found.rows["slow"].alone.trials, strict=True):
        assert torch.allclose(all_rigs.re[:5], some.re, atol=1e-6)


def test_small_batches_of_a_method_change_nothing(conditions):
    methods = FACTORY | {"small": replace(FACTORY["factory"], batch=2)}
    found = evaluate(methods, conditions(noise=0.1), Protocol(count=5, trials=1))
    assert torch.allclose(found.rows["factory"].alone.re, found.rows["small"].alone.re, atol=1e-6)


def test_a_network_has_two_columns(conditions):
    known = straight_down(conditions(kappa=0.002))
    found = evaluate({"fake": network_method(Fake(known))} | FACTORY, known, Protocol(count=6, trials=1))
    row = found.rows["fake"]
    assert row.refined is not None
    assert float(row.refined.re.max()) < 0.02 < float(row.alone.re.min())
    assert found.rows["factory"].refined is None


def test_the_first_of_several_passes_has_a_column_of_its_own(conditions):
    class Improves(Fake):
        def forward(self, views):
            last = super().forward(views)[-1]
            off = replace(last.rig, principal_point=last.rig.principal_point + 50.0)
            return replace(last, rig=off), last

    known = straight_down(conditions(kappa=0.002))
    found = evaluate({"fake": network_method(Improves(known))} | FACTORY, known, Protocol(count=3, trials=1))
    row = found.rows["fake"]
    assert row.passes == 2 and row.one_pass is not None
    first, last = (scores.trials[0].principal_point for scores in (row.one_pass, row.alone))
    assert float(first.min()) > 40 > 10 > float(last.max())
    assert found.rows["factory"].one_pass is None and found.rows["factory"].passes == 1


def test_progress_counts_every_rig_of_every_method_and_of_the_reference(conditions):
    counted = []
    evaluate(FACTORY, conditions(), Protocol(count=5, trials=2, batch=3), counted.append)
    assert sum(counted) == 2 * (5 + 5)


def test_bounds_exist_where_there_is_noise(conditions):
    few = Protocol(count=3, trials=1)
    assert evaluate(FACTORY, conditions(), few).reference.cramer_rao_ratios()["re"] is None
    assert evaluate(FACTORY, conditions(noise=0.1), few).reference.cramer_rao_ratios()["re"] is not None


def test_levels_degrade_points_and_images_alike_for_everybody(conditions):
    level = conditions().at_level(3)
    assert level.corruption == LEVELS[3].points and level.degradation.points.nothing
    options = ImageOptions(size=64)
    first, again = (draw(level, 3, torch.Generator().manual_seed(1)).given(slice(0, 2)) for _ in range(2))
    assert torch.equal(first.images(options), again.images(options))
    plain = replace(first, degradation=Degradation(), drawn={})
    assert (first.images(options) - plain.images(options)).abs().mean() > 0.01  # background, blur, noise
    other = replace(first, seed=first.seed + 1, drawn={})
    assert not torch.equal(first.images(options), other.images(options))
    exact = conditions().at_level(0)
    assert exact.corruption.nothing and exact.degradation == Degradation()


def test_methods_are_told_the_noise(conditions):
    told = []

    def listen(given):
        told.append((given.sigma, given.prior_std))
        return keep_factory_rig(given)

    for noise in (0.0, 0.3):
        known: Conditions = conditions(noise=noise, kappa=0.01)
        evaluate({"listener": Method(listen)}, known, Protocol(count=1, trials=1))
    assert [sigma for sigma, _ in told] == [LEAST_SIGMA, 0.3]
    assert torch.equal(told[0][1], known.drift.std(known.rig))


@pytest.mark.parametrize("name", ["count", "trials", "batch"])
def test_nothing_to_do_is_refused(name):
    with pytest.raises(InputError, match=name):
        Protocol(**{name: 0})


def singular(given):
    raise torch.linalg.LinAlgError("the input matrix is singular")


def test_a_singular_system_is_not_blamed_on_fiducials_that_are_there(conditions):
    with pytest.raises(RefusedError, match=r"broken: .* though every rig sees at least 8 different fiducials"):
        evaluate({"broken": Method(singular)}, conditions(), Protocol(count=3, trials=1))


def test_a_singular_system_for_want_of_fiducials_is_said_to_be_one(conditions):
    with pytest.raises(InputError, match=r"missing: found 0.9, .* it leaves one rig 2 fiducials"):
        evaluate({"broken": Method(singular)}, conditions(missing=0.9), Protocol(count=9, trials=1))

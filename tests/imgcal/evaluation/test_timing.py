from imgcal.evaluation import Method, latency, network_method
from imgcal.evaluation.methods import keep_factory_rig
from imgcal.evaluation.timing import WARM
from tests.imgcal.evaluation.conftest import Fake, straight_down


def test_latency_has_a_second_figure_where_there_is_a_refinement(conditions):
    known = straight_down(conditions(kappa=0.002))
    alone = latency(Method(keep_factory_rig), known, repeats=2)
    assert 0 < alone.alone_p50 <= alone.alone_p99
    assert alone.refined_p50 is None
    both = latency(network_method(Fake(known)), known, repeats=2)
    assert both.refined_p50 is not None
    assert both.refined_p50 > both.alone_p50


def test_every_rig_is_predicted_alone_and_the_first_ones_do_not_count(conditions, monkeypatch):
    clock, sizes = iter(range(10**6)), []
    monkeypatch.setattr("imgcal.evaluation.timing.time.perf_counter", lambda: float(next(clock)))

    def predict(given):
        sizes.append(len(given.uv))
        if len(sizes) <= WARM:
            for _ in range(1000):  # slow at first
                next(clock)
        return keep_factory_rig(given)

    found = latency(Method(predict), straight_down(conditions(kappa=0.002)), repeats=4)
    assert sizes == [1] * (4 + WARM)
    assert found.alone_p50 == found.alone_p99 == 1000.0  # one tick of a second

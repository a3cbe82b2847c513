"""The rate of false alarms is the one that was asked for, and a rise is found at once."""

import numpy as np

from imgcal.monitoring import Cusum


def test_the_rate_of_false_alarms_is_as_stated() -> None:
    test, generator, alarms = Cusum(2000, reference=0.5, run_length=500.0), np.random.default_rng(1), 0
    for _ in range(500):
        alarms += int(test.update(generator.standard_normal(2000)).sum())
    assert 0.85 < alarms / 2000 < 1.1  # the first run is as long as the others


def test_a_rise_is_found_and_dated() -> None:
    test, generator = Cusum(500, reference=0.5, run_length=1e6), np.random.default_rng(2)
    for _ in range(50):
        assert not test.update(generator.standard_normal(500)).any()
    delay, dated = np.full(500, 99), np.zeros(500)
    for step in range(60):
        risen = test.update(2.0 + generator.standard_normal(500))
        dated[risen & (delay == 99)] = (step + 1 - test.found)[risen & (delay == 99)]
        delay[risen & (delay == 99)] = step
    assert np.quantile(delay, 0.99) < 20
    assert abs(np.median(dated)) <= 1
    assert not np.isnan(test.update(np.full(500, np.nan))).any()

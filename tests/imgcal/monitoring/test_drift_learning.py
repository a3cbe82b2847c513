"""Paces of drift are learnt of snapshots in which nothing else is the matter."""

import torch

from imgcal.monitoring.drift_learning import TOLD_AT_ONCE, DriftLearning
from imgcal.monitoring.drift_pace import DriftPaces
from tests.imgcal.monitoring.followed import Followed, followed


def grown_up() -> Followed:
    """A filter whose first snapshots are no longer kept."""
    made = followed(40)
    made.filter._young = False
    return made


def test_it_begins_once_the_filter_has_grown_up_and_nothing_has_changed() -> None:
    made, learning = followed(20), DriftLearning(DriftPaces(4))
    learning.take(made.filter, made.recent, 1 / 60, quiet=True)
    assert learning.stretch is None  # young
    made = grown_up()
    learning.take(made.filter, made.recent, 1 / 60, quiet=True)
    assert learning.stretch is not None
    learning.take(made.filter, made.recent, 1 / 60, quiet=False)
    assert learning.stretch is None


def test_snapshots_are_told_to_the_stretch_and_a_stretch_to_the_paces() -> None:
    made, learning = grown_up(), DriftLearning(DriftPaces(4))
    for _ in range(TOLD_AT_ONCE):
        learning.take(made.filter, made.recent, 0.1, quiet=True)
    assert learning.stretch is not None and learning.untold == TOLD_AT_ONCE - 1
    assert not learning.stretch.brought.any()
    learning.take(made.filter, made.recent, 0.1, quiet=True)
    assert learning.untold == 0 and bool(learning.stretch.brought.any())
    known = learning.stretch
    learning.paces.squared[1] = 9.0
    learning.take(made.filter, made.recent, 20.0, quiet=True)
    assert learning.stretch is not known and learning.stretch.seconds < 20.0
    assert torch.equal(made.filter.pace, learning.paces.of_parameters(15))

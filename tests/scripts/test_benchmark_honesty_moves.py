import pytest

from scripts.benchmarks import honesty_moves
from scripts.benchmarks.honesty_moves import bumped, steady, wrong_image


@pytest.mark.parametrize("kind", honesty_moves.SCENES)
def test_faults_are_named_and_steady_rigs_left_alone(kind):
    assert bumped(kind, 0.1, 0.5, 0) == "found"
    assert wrong_image(kind, "v", 0) == "found"
    assert not steady(kind, "heavy tails", 3)

from itertools import product

import pytest
import torch
from torch import Tensor

from imgcal.networks.transport import partial_transport


def best_by_trying(scores: Tensor, absent: Tensor, stray: Tensor) -> tuple[list[int], float]:
    """The assignment with the highest sum of log odds, of all there are, and its lead; the dustbin is M."""
    count, candidates = scores.shape
    tried = []
    for trial in product(range(candidates + 1), repeat=count):
        taken = [j for j in trial if j < candidates]
        if len(set(taken)) < len(taken):
            continue
        total = sum(float(scores[n, j] if j < candidates else absent[n]) for n, j in enumerate(trial))
        total += sum(float(stray[j]) for j in range(candidates) if j not in taken)
        tried.append((total, list(trial)))
    (best, chosen), (second, _) = sorted(tried, reverse=True)[:2]
    return chosen, best - second


@pytest.mark.parametrize(("count", "candidates"), [(1, 1), (2, 3), (3, 2), (3, 4), (4, 3)])
def test_sharp_scores_give_the_best_assignment_of_all(count: int, candidates: int) -> None:
    generator = torch.Generator().manual_seed(10 * count + candidates)
    decided = 0
    for _ in range(12):
        scores = torch.randn(count, candidates, generator=generator, dtype=torch.float64)
        absent = torch.randn(count, generator=generator, dtype=torch.float64)
        stray = torch.randn(candidates, generator=generator, dtype=torch.float64)
        expected, lead = best_by_trying(scores, absent, stray)
        if lead < 0.2:  # nearly a tie: Sinkhorn would need forever
            continue
        shares = partial_transport(40 * scores, 40 * absent, 40 * stray, iterations=500)
        assert shares.argmax(-1).tolist() == expected
        decided += 1
    assert decided >= 5


def test_marginals_hold() -> None:
    generator = torch.Generator().manual_seed(0)
    scores = torch.randn(2, 3, 5, generator=generator, dtype=torch.float64)
    shares = partial_transport(scores, torch.zeros(2, 3).double(), torch.zeros(2, 5).double(), iterations=300).exp()
    torch.testing.assert_close(shares.sum(-1), torch.ones(2, 3).double())
    assert bool((shares[..., :-1].sum(-2) <= 1 + 1e-6).all())


def test_what_cannot_be_gets_nothing() -> None:
    scores = torch.tensor([[2.0, -torch.inf, 1.0], [-torch.inf, -torch.inf, -torch.inf]])
    shares = partial_transport(scores, torch.zeros(2), torch.tensor([0.0, -torch.inf, 0.0])).exp()
    assert bool(shares.isfinite().all())
    assert shares[0, 1] == 0
    assert shares[1].tolist() == pytest.approx([0, 0, 0, 1])


def test_gradients() -> None:
    generator = torch.Generator().manual_seed(1)
    shapes = (3, 2), (3,), (2,)
    inputs = tuple(torch.randn(s, generator=generator, dtype=torch.float64, requires_grad=True) for s in shapes)
    assert torch.autograd.gradcheck(lambda *x: partial_transport(*x, iterations=10), inputs)

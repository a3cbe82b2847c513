import torch

from imgcal.networks import Evidence, claim

SIZE = 8


def evidence(peaks: dict[tuple[int, int, int], float], fiducials: int = 2, present: float = 6.0) -> Evidence:
    """Windows that lie on one another, flat but for logits at (fiducial, row, column)."""
    logits = torch.zeros(1, fiducials, SIZE, SIZE)
    for (n, row, column), value in peaks.items():
        logits[0, n, row, column] = value
    steps = 2.0 * torch.arange(SIZE)
    cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).expand(1, fiducials, SIZE, SIZE, 2)
    zeros = torch.zeros(1, fiducials, SIZE, SIZE)
    offset = torch.full((1, fiducials, SIZE, SIZE, 2), 0.25)
    return Evidence(logits, offset, zeros, torch.full((1, fiducials), present), cells)


def test_place_is_cell_and_offset() -> None:
    found = claim(evidence({(0, 2, 5): 15.0, (1, 6, 1): 15.0}), torch.ones(1, 2, dtype=torch.bool))
    torch.testing.assert_close(found.place[0], torch.tensor([[10.25, 4.25], [2.25, 12.25]]))
    assert bool((found.probability > 0.9).all())
    assert bool((found.sigma == 1).all())


def test_two_fiducials_never_share_a_place() -> None:
    # Both like (2, 5) best; the second one has another that is nearly as good, the first one has none.
    found = claim(evidence({(0, 2, 5): 15.0, (1, 2, 5): 15.0, (1, 6, 1): 14.5}), torch.ones(1, 2, dtype=torch.bool))
    torch.testing.assert_close(found.place[0], torch.tensor([[10.25, 4.25], [2.25, 12.25]]))
    assert bool((found.probability > 0.5).all())
    rivals = claim(evidence({(0, 2, 5): 15.0, (1, 2, 5): 15.0}), torch.ones(1, 2, dtype=torch.bool))
    assert bool((rivals.probability <= 0.5).all())


def test_absent_and_unasked_fiducials_claim_nothing() -> None:
    both = torch.ones(1, 2, dtype=torch.bool)
    assert not bool((claim(evidence({(0, 2, 5): 15.0}, present=-6.0), both).probability > 0.1).any())
    one = torch.tensor([[True, False]])
    found = claim(evidence({(0, 2, 5): 15.0, (1, 6, 1): 15.0}), one)
    assert float(found.probability[0, 1]) == 0

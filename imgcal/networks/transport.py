"""Optimal transport with a dustbin: one-to-one assignment of fiducials to candidates, with unmatched ones."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

ITERATIONS = 30


def partial_transport(scores: Tensor, absent: Tensor, stray: Tensor, iterations: int = ITERATIONS) -> Tensor:
    """Assign N fiducials to M candidates by Sinkhorn iterations in the log domain, differentiably.

    Args:
        scores: (*B, N, M) log odds of fiducial and candidate; -inf = impossible.
        absent: (*B, N) log odds that a fiducial matches no candidate.
        stray: (*B, M) log odds that a candidate matches no fiducial; -inf in a whole row and column = not present.
        iterations: of Sinkhorn; rows are normalized last.

    Returns:
        (*B, N, M + 1) log share of each fiducial in each candidate, the dustbin last: rows sum to one, and the shares
        in a candidate sum to at most one.

    Source: Sinkhorn with dustbins as in SuperGlue (Sarlin et al. 2020), with a dustbin score for each row and column.

    Examples:
        >>> scores = torch.tensor([[5.0, 4.0], [4.5, -5.0]])  # the second fiducial only fits the first candidate
        >>> partial_transport(scores, torch.zeros(2), torch.zeros(2)).exp().argmax(-1)
        tensor([1, 0])
    """
    count, candidates = scores.shape[-2:]
    full = torch.cat((torch.cat((scores, absent[..., None]), -1), functional.pad(stray, (0, 1))[..., None, :]), -2)
    # The corner takes the remaining mass of both dustbins.
    rows, columns = (torch.zeros(size + 1, dtype=full.dtype, device=full.device) for size in (count, candidates))
    rows[-1], columns[-1] = _log(candidates), _log(count)
    u, v = torch.zeros_like(full[..., 0]), torch.zeros_like(full[..., 0, :])
    for _ in range(iterations):
        v = _finite(columns - (full + u[..., None]).logsumexp(-2))
        u = _finite(rows - (full + v[..., None, :]).logsumexp(-1))
    return (full + u[..., None] + v[..., None, :])[..., :-1, :]


def _log(count: int) -> float:
    return float(torch.tensor(max(count, 1), dtype=torch.float64).log())


def _finite(values: Tensor) -> Tensor:
    """Keep rows and columns without any possible match out of the sums."""
    return torch.where(values.isfinite(), values, 0.0)

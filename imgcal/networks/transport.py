"""Optimal transport with a dustbin: which fiducial is which candidate, when each is at most one."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

ITERATIONS = 30


def partial_transport(scores: Tensor, absent: Tensor, stray: Tensor, iterations: int = ITERATIONS) -> Tensor:
    """Share out N fiducials among M candidates by Sinkhorn's iterations, in logarithms, differentiably.

    Args:
        scores: (*B, N, M) log odds of fiducial and candidate; -inf = they cannot belong together.
        absent: (*B, N) log odds that a fiducial is none of the candidates.
        stray: (*B, M) log odds that a candidate is no fiducial; -inf in a row and column alike = it does not exist.
        iterations: of Sinkhorn; rows are exact at the end.

    Returns:
        (*B, N, M + 1) logarithm of the share of each fiducial that each candidate gets, the dustbin last: rows sum to
        one, and what all fiducials get of a candidate is at most one.

    Source: Sinkhorn with dustbins as in SuperGlue (Sarlin et al. 2020), with a dustbin score for each row and column.

    Examples:
        >>> scores = torch.tensor([[5.0, 4.0], [4.5, -5.0]])  # the second fiducial can only be the first candidate
        >>> partial_transport(scores, torch.zeros(2), torch.zeros(2)).exp().argmax(-1)
        tensor([1, 0])
    """
    count, candidates = scores.shape[-2:]
    full = torch.cat((torch.cat((scores, absent[..., None]), -1), functional.pad(stray, (0, 1))[..., None, :]), -2)
    # All that is left over meets in the corner.
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
    """What nothing can belong to stays out of the sums."""
    return torch.where(values.isfinite(), values, 0.0)

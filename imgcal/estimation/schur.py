"""Block-arrow linear systems: many cameras, many snapshots, every camera coupled to every snapshot.

    [ A_1            W_11 ... W_1S ]
    [      ...                     ]      A: one block per camera, D: one block per snapshot, W: their couplings.
    [          A_C   W_C1 ... W_CS ]
    [                D_1           ]      One kind of block is eliminated (Schur complement), the other solved densely.
    [ W^T                ...  D_S  ]

A few more unknowns that couple to everything (the object's) are kept, after the others: the border.

Source: Triggs et al., "Bundle Adjustment - A Modern Synthesis", section 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Border:
    """Unknowns that couple to every block, M of them."""

    eliminated: Tensor  # (B, P, p, M) coupling with the blocks to eliminate
    kept: Tensor  # (B, Q, q, M) coupling with the blocks to keep
    own: Tensor  # (B, M, M)


@dataclass(frozen=True)
class Reduced:
    """Cholesky factorization of the block-arrow matrix with one kind of block eliminated."""

    eliminated: Tensor  # (B, P, p, p) lower factors of the eliminated blocks
    whitened: Tensor  # (B, P, p, Q q + M) inverses of those factors times the couplings
    kept: Tensor  # (B, Q q + M, Q q + M) lower factor of the Schur complement
    failed: Tensor  # (B,) bool: not positive definite


def reduce(blocks: Tensor, coupling: Tensor, kept: Tensor, border: Border | None = None) -> Reduced:
    """Eliminate `blocks` from the system.

    Args:
        blocks: (B, P, p, p) symmetric blocks to eliminate.
        coupling: (B, P, Q, p, q).
        kept: (B, Q, q, q) symmetric blocks to keep.
        border: further unknowns to keep.
    """
    count, size = kept.shape[1], kept.shape[2]
    wide = count * size
    factor, info = torch.linalg.cholesky_ex(blocks)
    right = coupling.transpose(2, 3).flatten(3)  # (B, P, p, Q q)
    if border is not None:
        right = torch.cat((right, border.eliminated), dim=-1)
    whitened = torch.linalg.solve_triangular(factor, right, upper=False)
    tall = whitened.flatten(1, 2)
    schur = -(tall.mT @ tall)
    square = schur[:, :wide, :wide].unflatten(-1, (count, size)).unflatten(-3, (count, size))
    square.diagonal(dim1=1, dim2=3).add_(kept.permute(0, 2, 3, 1))
    if border is not None:
        across = border.kept.flatten(1, 2)
        schur[:, :wide, wide:] += across
        schur[:, wide:, :wide] += across.mT
        schur[:, wide:, wide:] += border.own
    schur_factor, schur_info = torch.linalg.cholesky_ex(schur)
    return Reduced(factor, whitened, schur_factor, (info != 0).any(-1) | (schur_info != 0))


def solve(
    reduced: Reduced, right_eliminated: Tensor, right_kept: Tensor, right_border: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Solve the system for one right-hand side.

    Args:
        reduced: from `reduce`.
        right_eliminated: (B, P, p).
        right_kept: (B, Q, q).
        right_border: (B, M), None without a border.

    Returns:
        The solution in the same shapes.
    """
    border = None if right_border is None else right_border[..., None]
    eliminated, kept, border = solve_columns(reduced, right_eliminated[..., None], right_kept[..., None], border)
    return eliminated.squeeze(-1), kept.squeeze(-1), None if border is None else border.squeeze(-1)


def solve_columns(
    reduced: Reduced, right_eliminated: Tensor, right_kept: Tensor, right_border: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Solve the system for R right-hand sides at once.

    Args:
        reduced: from `reduce`.
        right_eliminated: (B, P, p, R).
        right_kept: (B, Q, q, R).
        right_border: (B, M, R), None without a border.

    Returns:
        The solutions in the same shapes.
    """
    first = torch.linalg.solve_triangular(reduced.eliminated, right_eliminated, upper=False)
    right = right_kept.flatten(1, 2)
    wide = right.shape[1]
    if right_border is not None:
        right = torch.cat((right, right_border), dim=1)
    right = right - (reduced.whitened.mT @ first).sum(1)
    kept = torch.cholesky_solve(right, reduced.kept)
    second = first - reduced.whitened @ kept.unsqueeze(1)
    eliminated = torch.linalg.solve_triangular(reduced.eliminated.mT, second, upper=True)
    border = None if right_border is None else kept[:, wide:]
    return eliminated, kept[:, :wide].reshape(right_kept.shape), border

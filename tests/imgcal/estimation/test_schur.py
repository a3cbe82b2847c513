"""Block-arrow systems against dense ones, whichever kind of block is eliminated."""

import pytest
import torch
from torch import Tensor

from imgcal.estimation import schur

SHAPES = [(1, 3, 2, 4, 2), (3, 2, 5, 3, 4), (2, 2, 2, 15, 6), (1, 1, 1, 2, 3)]


def system(batch: int, first: int, second: int, p: int, q: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blocks (B, P, p, p), coupling (B, P, Q, p, q), kept (B, Q, q, q) and the dense matrix they stand for."""
    generator = torch.Generator().manual_seed(0)
    size, split = first * p + second * q, first * p
    rows = torch.randn(batch, 3 * size, size, generator=generator, dtype=torch.float64)
    dense = rows.mT @ rows
    mask = torch.zeros(size, size, dtype=torch.bool)
    mask[:split, split:] = mask[split:, :split] = True
    mask |= torch.block_diag(*[torch.ones(p, p)] * first, *[torch.ones(q, q)] * second).bool()
    dense = dense * mask + 3 * size * torch.eye(size).double()
    blocks = torch.stack([dense[:, i * p : i * p + p, i * p : i * p + p] for i in range(first)], 1)
    kept = torch.stack([dense[:, split + i * q :, split + i * q :][:, :q, :q] for i in range(second)], 1)
    coupling = dense[:, :split, split:].unflatten(1, (first, p)).unflatten(-1, (second, q)).transpose(2, 3)
    return blocks, coupling, kept, dense


@pytest.mark.parametrize(("batch", "first", "second", "p", "q"), SHAPES)
def test_solution_equals_the_dense_one(batch: int, first: int, second: int, p: int, q: int) -> None:
    blocks, coupling, kept, dense = system(batch, first, second, p, q)
    right = torch.randn(batch, first * p + second * q, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    right_blocks, right_kept = (
        right[:, : first * p].unflatten(1, (first, p)),
        right[:, first * p :].unflatten(1, (second, q)),
    )
    expected = torch.linalg.solve(dense, right)
    eliminated, kept_part, _ = schur.solve(schur.reduce(blocks, coupling, kept), right_blocks, right_kept)
    torch.testing.assert_close(torch.cat((eliminated.flatten(1), kept_part.flatten(1)), 1), expected)
    # The other kind eliminated.
    other = schur.reduce(kept, coupling.permute(0, 2, 1, 4, 3), blocks)
    kept_part, eliminated, _ = schur.solve(other, right_kept, right_blocks)
    torch.testing.assert_close(torch.cat((eliminated.flatten(1), kept_part.flatten(1)), 1), expected)
    assert not other.failed.any()


def test_what_is_not_positive_definite_is_reported() -> None:
    blocks, coupling, kept, _ = system(3, 2, 2, 4, 3)
    blocks[1, 0] = -blocks[1, 0]
    kept[2, 1] = 0
    assert schur.reduce(blocks, coupling, kept).failed.tolist() == [False, True, True]


@pytest.mark.parametrize(("batch", "first", "second", "p", "q"), SHAPES)
def test_a_border_is_solved_with_the_rest(batch: int, first: int, second: int, p: int, q: int) -> None:
    """Three unknowns that couple to everything, whichever kind of block is eliminated."""
    blocks, coupling, kept, dense = system(batch, first, second, p, q)
    generator = torch.Generator().manual_seed(2)
    split, size = first * p, dense.shape[-1]
    across = torch.randn(batch, size, 3, generator=generator, dtype=torch.float64)
    own = 50 * size * torch.eye(3).double().expand(batch, 3, 3)
    whole = torch.cat((torch.cat((dense, across), 2), torch.cat((across.mT, own), 2)), 1)
    right = torch.randn(batch, size + 3, generator=generator, dtype=torch.float64)
    expected = torch.linalg.solve(whole, right)
    parts = across[:, :split].unflatten(1, (first, p)), across[:, split:].unflatten(1, (second, q))
    rights = right[:, :split].unflatten(1, (first, p)), right[:, split:size].unflatten(1, (second, q))
    reduced = schur.reduce(blocks, coupling, kept, schur.Border(*parts, own))
    a, b, c = schur.solve(reduced, *rights, right[:, size:])
    torch.testing.assert_close(torch.cat((a.flatten(1), b.flatten(1), c), 1), expected)
    reduced = schur.reduce(kept, coupling.permute(0, 2, 1, 4, 3), blocks, schur.Border(*parts[::-1], own))
    b, a, c = schur.solve(reduced, *rights[::-1], right[:, size:])
    torch.testing.assert_close(torch.cat((a.flatten(1), b.flatten(1), c), 1), expected)


@pytest.mark.parametrize("bordered", [False, True])
def test_columns_are_solved_as_they_are_one_by_one(bordered: bool) -> None:
    blocks, coupling, kept, _ = system(3, 2, 4, 5, 3)
    generator = torch.Generator().manual_seed(3)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    border = schur.Border(drawn(3, 2, 5, 2), drawn(3, 4, 3, 2), 500 * torch.eye(2).double().expand(3, 2, 2))
    reduced = schur.reduce(blocks, coupling, kept, border if bordered else None)
    right = (drawn(3, 2, 5, 7), drawn(3, 4, 3, 7), drawn(3, 2, 7) if bordered else None)
    found = schur.solve_columns(reduced, *right)
    for k in range(7):
        alone = schur.solve(reduced, *(None if part is None else part[..., k] for part in right))  # type: ignore[arg-type]
        for one, part in zip(alone, found, strict=True):
            assert (one is None) == (part is None) == (not bordered and part is found[2])
            if one is not None and part is not None:
                torch.testing.assert_close(part[..., k], one)

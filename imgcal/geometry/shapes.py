"""Shapes are checked before compiled loops: these read whatever lies behind an array that is smaller than expected."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from imgcal.errors import InputError


class Shaped(Protocol):
    """A tensor or an array."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""
        ...


def require_shapes(
    where: str, expected: Iterable[tuple[str, Shaped, tuple[int, ...]]], *, any_batch: bool = False
) -> None:
    """Compare arrays with the shapes that they must have; takes about a microsecond.

    Args:
        where: what they belong to, for the message.
        expected: name, array and shape of each.
        any_batch: arrays may have more leading axes than that.

    Raises:
        InputError: an array has another shape.

    Examples:
        >>> import numpy as np
        >>> require_shapes("board", [("points", np.zeros((4, 3)), (4, 3))])
    """
    for name, array, shape in expected:
        if (array.shape[-len(shape) :] if any_batch else array.shape) != shape:
            wanted = f"(..., {', '.join(map(str, shape))})" if any_batch else shape
            raise InputError(f"{where}: found {name} of shape {tuple(array.shape)}, expected {wanted}")

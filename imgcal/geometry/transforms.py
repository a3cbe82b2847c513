"""Rigid transforms, named `destination_from_source`: `cam_from_object = cam_from_rig @ rig_from_object`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.messages import brief_repr

Join = Callable[[list[Tensor]], Tensor]
"""Joins tensors: `torch.cat`, `torch.stack`, or a choice between them."""


@dataclass(frozen=True)
class RigidTransform:
    """Rotation, then translation: `points_destination = rotation @ points_source + translation`.

    Examples:
        >>> quarter_turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> rig_from_object = RigidTransform(quarter_turn, torch.tensor([0.0, 0.0, 850.0]))
        >>> rig_from_object.apply(torch.tensor([[10.0, 0.0, 0.0]]))
        tensor([[  0.,  10., 850.]])
        >>> object_from_rig = rig_from_object.inverse()
        >>> (object_from_rig @ rig_from_object).translation
        tensor([0., 0., 0.])
    """

    rotation: Tensor  # (*B, 3, 3)
    translation: Tensor  # (*B, 3) mm

    __repr__ = brief_repr

    @classmethod
    def identity(
        cls, *batch: int, dtype: torch.dtype | None = None, device: torch.device | None = None
    ) -> RigidTransform:
        """Make identity transforms of batch shape `batch`."""
        eye = torch.eye(3, dtype=dtype, device=device).expand(*batch, 3, 3)
        return cls(eye, torch.zeros(*batch, 3, dtype=dtype, device=device))

    @classmethod
    def stack(cls, parts: Sequence[RigidTransform]) -> RigidTransform:
        """Stack P transforms (*B) along a new first batch axis: (P, *B)."""
        return cls.combine(parts, torch.stack)

    @classmethod
    def cat(cls, parts: Sequence[RigidTransform]) -> RigidTransform:
        """Concatenate transforms (P, *B), (Q, *B), ... along their first batch axis: (P + Q + ..., *B)."""
        return cls.combine(parts, torch.cat)

    @classmethod
    def combine(cls, parts: Sequence[RigidTransform], join: Join) -> RigidTransform:
        """Combine `parts` into one; `join` takes the list of their rotations, then of their translations."""
        return cls(join([part.rotation for part in parts]), join([part.translation for part in parts]))

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """Chain: `a_from_b @ b_from_c` is `a_from_c`; batch axes broadcast."""
        return RigidTransform(
            self.rotation @ other.rotation,
            rotate(self.rotation, other.translation) + self.translation,
        )

    def __getitem__(self, index: object) -> RigidTransform:
        """Index the batch axes."""
        return RigidTransform(self.rotation[index], self.translation[index])  # type: ignore[index]

    def reshape(self, *batch: int) -> RigidTransform:
        """Change the batch axes to (*batch), with as many transforms."""
        return RigidTransform(self.rotation.reshape(*batch, 3, 3), self.translation.reshape(*batch, 3))

    def inverse(self) -> RigidTransform:
        """Swap source and destination: (*B)."""
        return RigidTransform(self.rotation.mT, -self.origin_image())

    def origin_image(self) -> Tensor:
        """Return `rotation^T @ translation`: (*B, 3) mm, minus the destination's origin in the source frame."""
        return rotate(self.rotation.mT, self.translation)

    def apply(self, points_source: Tensor) -> Tensor:
        """Transform points (*B, N, 3) mm; the batch axes broadcast against the transform's."""
        if points_source.dim() == 2:
            # Otherwise PyTorch computes one tall product, for which the threads of MKL wait for each other: for 97
            # transforms of eight points this takes 10 us on an idle machine, and 30 ms on a busy one.
            points_source = points_source.expand(*self.rotation.shape[:-2], -1, -1)
        return (self.rotation @ points_source.mT).mT + self.translation[..., None, :]

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> RigidTransform:
        """Change the floating-point type, move to a device, or both."""
        return RigidTransform(
            self.rotation.to(dtype=dtype, device=device), self.translation.to(dtype=dtype, device=device)
        )


def rotate(rotation: Tensor, vector: Tensor) -> Tensor:
    """Rotate one vector by each matrix: (*B, 3, 3), (*B, 3) -> (*B, 3); faster than products of tiny matrices.

    Examples:
        >>> rotate(torch.eye(3), torch.tensor([1.0, 2.0, 3.0]))
        tensor([1., 2., 3.])
    """
    first, second, third = rotation.unbind(-1)
    x, y, z = vector.split(1, dim=-1)
    return first * x + second * y + third * z

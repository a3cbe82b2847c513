"""Drift in degrees, millimetres and pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from imgcal import types
from imgcal.io import StrictRecord

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from imgcal.types import CameraRig

Spread = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]


@dataclass(frozen=True)
class PhysicalDrift(StrictRecord):
    """Gaussian drift in physical units, for real rigs; each number is one standard deviation.

    Examples:
        >>> import imgcal
        >>> PhysicalDrift(position=2.0).std(imgcal.load_rig("T4"))[0, 3:6]  # mm
        tensor([2., 2., 2.], dtype=torch.float64)
    """

    rotation_deg: Spread = 0.5  # degrees, each axis; experiments have 0 by default, and cannot combine it with kappas
    position: Spread = 2.0  # mm, each axis
    focal_length: Spread = 0.01  # relative
    principal_point: Spread = 5.0  # pixels
    distortion: Spread = 0.005  # absolute

    def apply(self, rig: CameraRig, generator: torch.Generator, *batch: int) -> CameraRig:
        """Disturb every parameter of every camera independently: (*batch, *B) rigs."""
        like = rig.focal_length
        draws = like.new_empty(rig.num_parameters, *batch, *like.shape[:-1]).normal_(generator=generator)
        return rig.retract(draws.movedim(0, -1) * self.std(rig))

    def std(self, rig: CameraRig) -> Tensor:
        """Standard deviation of each parameter: (*B, C, 15)."""
        as_prior = types.RigPrior(
            self.focal_length, self.principal_point, self.distortion, math.radians(self.rotation_deg), self.position
        )
        return as_prior.std(rig)

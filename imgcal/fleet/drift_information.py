"""What a series of calibrations says about drift, with the prior of each removed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.estimation import Estimate, whitened_covariance
from imgcal.types import PARAMETER_KINDS, CameraRig, RigPrior

KINDS = tuple(PARAMETER_KINDS)
"""Kinds of value as a rig file's `prior:` names them, and in the order in which a camera's parameters stand."""


HELD = 1e-3
"""Width of a prior, over the default one, up to which it holds a value where it is: the rest is rounding."""


def parameter_units(rig: CameraRig) -> Tensor:
    """What a spread of one means for each parameter: (C, K) rad, mm, the focal length in pixels, pixels, one.

    Zero for coefficients that a camera's lens does not have.
    """
    return RigPrior(1.0, 1.0, 1.0, 1.0, 1.0).std(rig)


@dataclass(frozen=True)
class DriftInformation:
    """How far devices are from their factory values by the images alone: a Gaussian likelihood for each.

    Directions in which they say nothing, a motion of the whole rig above all, have no information; so nothing has to
    be said about a gauge.
    """

    camera_names: tuple[str, ...]
    information: Tensor  # (D, P, P) float64, P parameters of all cameras in `parameter_units`; positive semidefinite
    score: Tensor  # (D, P) information times the offset that the images ask for

    def __post_init__(self) -> None:
        devices, size = self.score.shape
        if self.information.shape != (devices, size, size) or size % len(self.camera_names):
            raise InputError(
                f"drift information: found information {tuple(self.information.shape)} and score "
                f"{tuple(self.score.shape)}, expected (D, P, P) and (D, P) of {len(self.camera_names)} cameras"
            )

    @classmethod
    def from_estimates(cls, estimate: Estimate) -> DriftInformation:
        """Take the prior out of estimates.

        Args:
            estimate: (D) or one without batch axes.

        Raises:
            RefusedError: the information of an estimate is singular.
        """
        problem, solution = estimate.problem, estimate.solution
        return cls.from_whitened(
            estimate.rig.camera_names,
            torch.linalg.inv(whitened_covariance(solution)),
            solution.state.offset.flatten(1),
            problem.prior_std.flatten(1),
            parameter_units(problem.factory).expand(problem.prior_std.shape).flatten(1),
            torch.full((len(problem.prior_std),), estimate.mean_inflation, dtype=torch.float64),
        )

    @classmethod
    def from_whitened(
        cls,
        camera_names: tuple[str, ...],
        precision: Tensor,
        offset: Tensor,
        prior_std: Tensor,
        unit: Tensor,
        inflation: Tensor,
    ) -> DriftInformation:
        """Take the prior out of what is kept in units of it.

        Args:
            camera_names: C of them.
            precision: (D, P, P) inverse covariance, the prior's part the identity.
            offset: (D, P) estimated.
            prior_std: (D, P) standard deviations of the prior; what it holds fixed, at zero or nearly, tells nothing.
            unit: (D, P) of `parameter_units`.
            inflation: (D) factor on what noise adds to standard deviations.
        """
        data = precision - torch.eye(precision.shape[-1], dtype=precision.dtype)
        usual = torch.zeros(unit.shape[1] // len(camera_names), dtype=unit.dtype)
        for kind, part in PARAMETER_KINDS.items():
            usual[part] = getattr(RigPrior(), kind)
        free = prior_std > HELD * usual.repeat(len(camera_names)) * unit
        scale = torch.where(free, unit / prior_std.clamp_min(1e-300), 0.0) / inflation[:, None]
        information = scale[:, :, None] * data * scale[:, None, :]
        asked = scale * (precision @ offset[..., None])[..., 0] / inflation[:, None]
        return cls(camera_names, 0.5 * (information + information.mT), asked)

    @classmethod
    def concatenate(cls, parts: Sequence[DriftInformation]) -> DriftInformation:
        """Concatenate devices.

        Raises:
            InputError: none, or of different cameras.
        """
        kinds = {(part.camera_names, part.parameters) for part in parts}
        if len(kinds) != 1:
            raise InputError("drift information: found parts of different rigs or none, expected the same cameras")
        information = torch.cat([part.information for part in parts])
        return cls(parts[0].camera_names, information, torch.cat([part.score for part in parts]))

    @property
    def parameters(self) -> int:
        """Parameters of a camera."""
        return self.score.shape[1] // len(self.camera_names)

    def __len__(self) -> int:
        return len(self.score)

    def __getitem__(self, rows: Tensor | slice) -> DriftInformation:
        return DriftInformation(self.camera_names, self.information[rows], self.score[rows])

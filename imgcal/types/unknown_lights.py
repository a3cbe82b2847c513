"""`UnknownLights`: unknown markers, each of them with a place of its own in every snapshot."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from imgcal.types.calibration_object import CalibrationObject

MOST_LIGHTS = 16
"""Lights of one snapshot from which a running rig learns; of more, those that most cameras see."""


@dataclass(frozen=True, repr=False)
class UnknownLights(CalibrationObject):
    """Up to N lights at once: not a body. Fiducial n is whichever light has the number n in a snapshot.

    The pose of such an object is one place for each light: a transform (S, N) whose translation is where the light is,
    nan for a number that no light has.

    Examples:
        >>> lights = UnknownLights.of(4)
        >>> lights.num_fiducials, lights.pose_rank, lights.exact
        (4, 3, True)
    """

    @classmethod
    def of_light(cls, light: CalibrationObject) -> UnknownLights:
        """Take an object of one fiducial: a light that may be anywhere, and is the only one."""
        return cls(torch.zeros(1, 3, dtype=torch.float64), light.colours.double(), light.radius, light.name)

    @classmethod
    def of(cls, count: int = MOST_LIGHTS) -> UnknownLights:
        """Make room for so many lights."""
        return cls(torch.zeros(count, 3, dtype=torch.float64), torch.ones(count, 3, dtype=torch.float64), name="lights")

"""Base class of all networks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping

from torch import nn

from imgcal.networks.parameterization import Parameterization
from imgcal.synthesis import ImageOptions
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views


class Network(nn.Module, ABC):
    """Predict rigs from views. A network has the rig and the object that it is for, on the device of its weights.

    State dictionaries contain only weights: rig, object and drift are non-persistent buffers.
    """

    def __init__(self, parameterization: Parameterization, image_options: ImageOptions | None = None) -> None:
        """Store what all networks have.

        Args:
            parameterization: factory rig, object, and the drift that is the unit of its offsets.
            image_options: how its input images are drawn; None = its inputs are points.
        """
        super().__init__()
        self.parameterization = parameterization
        self.image_options = image_options

    @property
    def factory(self) -> CameraRig:
        """The factory rig, float32."""
        return self.parameterization.factory

    @property
    def obj(self) -> CalibrationObject:
        """The calibration object, float32."""
        return self.parameterization.obj

    @property
    def encoder(self) -> nn.Module | None:
        """The part whose output everything after it must depend on; None = there is no such part.

        `imgcal.evaluation.check_encoder` corrupts its output (a tensor, or tuples of them; the first axis is rigs, or
        rigs times cameras) and checks that the predictions get worse.
        """
        return None

    @abstractmethod
    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict (B,) rigs from (B,) views: one prediction per pass, coarse to fine."""

    @abstractmethod
    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters by group, for separate learning rates."""

"""What every network is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping

from torch import nn

from imgcal.networks.parameterization import Parameterization
from imgcal.synthesis import ImageOptions
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views


class Network(nn.Module, ABC):
    """Views in, predictions out; it knows the rig and the object that it is for, on the device where its weights are.

    State dictionaries hold weights only: rig, object and drift are buffers that are not saved with them.
    """

    def __init__(self, parameterization: Parameterization, image_options: ImageOptions | None = None) -> None:
        """Keep what all networks have.

        Args:
            parameterization: factory rig, object, and the drift that is the unit of its offsets.
            image_options: how the images are drawn that it takes; None = it takes points.
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
        """The part whose output everything behind it must live on; None = there is no such part.

        `imgcal.evaluation.check_encoder` spoils what it returns (a tensor, or tuples of them; the first axis counts
        rigs, or rigs times cameras) and sees whether that hurts.
        """
        return None

    @abstractmethod
    def forward(self, views: Views) -> tuple[Prediction, ...]:
        """Predict (B,) rigs from (B,) views: one prediction a pass, coarse to fine."""

    @abstractmethod
    def parameter_groups(self) -> Mapping[str, Iterable[nn.Parameter]]:
        """Parameters that may have their own learning rates."""

"""Conversion of a network's head outputs to rigs: the only place that defines their scales."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.geometry import Projection, RigidTransform, rotate, rotation_from_6d, rotation_from_vector
from imgcal.types import CalibrationObject, CameraRig, Prediction, unpack18

POSE_SHIFT = 10.0  # mm of the object's position per unit of a head
POSE_TURN = 0.05  # rad of the object's rotation per unit of a head, after the first pass


@dataclass(frozen=True)
class RigState:
    """A rig near the factory's and the object's pose, as networks update them."""

    offsets: Tensor  # (B, C, K) parameters minus factory values, in units of their prior standard deviation
    rotation: Tensor  # (B, 3, 3) rig_from_object
    centre: Tensor  # (B, 3) mm, the object's centroid in the rig

    def detach(self) -> RigState:
        """Detach from the graph."""
        return RigState(self.offsets.detach(), self.rotation.detach(), self.centre.detach())


class Parameterization(nn.Module):
    """Convert head outputs to predictions; has the factory rig, the object and the prior as buffers, no weights."""

    focal_length: Tensor  # (C, 2)
    principal_point: Tensor  # (C, 2)
    distortion: Tensor  # (C, D)
    rotation: Tensor  # (C, 3, 3)
    translation: Tensor  # (C, 3)
    image_size: Tensor  # (C, 2)
    has_coefficient: Tensor  # (C, D) bool
    prior_std: Tensor  # (C, K)
    points: Tensor  # (N, 3) mm
    colours: Tensor  # (N, 3)
    radius: Tensor | None  # (N,) mm
    tolerance: Tensor | None  # (N,) mm
    centroid: Tensor  # (3,) mm
    centred: Tensor  # (N, 3) mm
    level: Tensor  # (3, 3)

    def __init__(self, factory: CameraRig, obj: CalibrationObject, prior_std: Tensor) -> None:
        super().__init__()
        if factory.working_distance is None:
            raise InputError(
                f"rig {factory.name}: found no working_distance, expected the distance (mm) along the rig's z axis at "
                "which networks see the object"
            )
        self._factory, self._obj = factory, obj  # for their attributes that are not tensors
        self.working_distance = factory.working_distance
        points = obj.points.to(factory.focal_length)
        buffers = {
            "focal_length": factory.focal_length,
            "principal_point": factory.principal_point,
            "distortion": factory.distortion,
            "rotation": factory.cam_from_rig.rotation,
            "translation": factory.cam_from_rig.translation,
            "image_size": factory.image_size,
            "has_coefficient": factory.has_coefficient,
            "prior_std": prior_std.to(factory.focal_length),
            "points": points,
            "colours": obj.colours.to(points),
            "radius": None if obj.radius is None else obj.radius.to(points),
            "tolerance": None if obj.tolerance is None else obj.tolerance.to(points),
            "centroid": points.mean(0),
            "centred": points - points.mean(0),
            # The z axis of a level object below the rig points towards the cameras.
            "level": torch.diag(torch.tensor((1.0, -1.0, -1.0))),
        }
        for name, tensor in buffers.items():
            self.register_buffer(name, None if tensor is None else tensor.clone(), persistent=False)
        # Scales a fiducial's distance from the principal point, over f, to about one.
        self.unit = factory.working_distance / float(self.centred.norm(dim=-1).mean())

    @property
    def widths(self) -> dict[str, int]:
        """Number of outputs per camera by kind; with five lens coefficients, the paper's eighteen."""
        lens = self.distortion.shape[-1]
        return {"rotation": 6, "translation": 3, "focal_length": 2, "principal_point": 2, "distortion": lens}

    @property
    def num_parameters(self) -> int:
        """Free parameters per camera, K."""
        return self.prior_std.shape[-1]

    @property
    def factory(self) -> CameraRig:
        """The factory rig, float32, on the network's device."""
        return replace(
            self._factory,
            focal_length=self.focal_length,
            principal_point=self.principal_point,
            distortion=self.distortion,
            cam_from_rig=RigidTransform(self.rotation, self.translation),
            image_size=self.image_size,
        )

    @property
    def obj(self) -> CalibrationObject:
        """The calibration object, float32, on the network's device."""
        tensors = {"points": self.points, "colours": self.colours, "radius": self.radius, "tolerance": self.tolerance}
        return replace(self._obj, **tensors)  # type: ignore[arg-type]

    def normalize(self, uv: Tensor) -> Tensor:
        """Normalize pixels (B, C, N, 2) to values of about one, with the factory's intrinsics."""
        return (uv - self.principal_point[:, None]) / self.focal_length[:, None] * self.unit

    def start(self, offsets: Tensor, pose: Tensor) -> RigState:
        """Create the initial state of rigs.

        Args:
            offsets: (B, C, K) in units of `prior_std`.
            pose: (B, 9) 6D rotation relative to a level object, then a shift from the working distance.
        """
        identity = pose.new_tensor((1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
        rotation = self.level @ rotation_from_6d(pose[:, :6] + identity)
        centre = pose.new_tensor((0.0, 0.0, self.working_distance)) + POSE_SHIFT * pose[:, 6:]
        return RigState(offsets, rotation, centre)

    def move(self, state: RigState, offsets: Tensor, pose: Tensor) -> RigState:
        """Update rigs: offsets (B, C, K) in units of `prior_std`, pose (B, 6) rotation and shift."""
        rotation = rotation_from_vector(POSE_TURN * pose[:, :3]) @ state.rotation
        return RigState(state.offsets + offsets, rotation, state.centre + POSE_SHIFT * pose[:, 3:])

    def prediction(self, state: RigState) -> Prediction:
        """Convert a state to rig and pose: (B,)."""
        shift = state.centre - rotate(state.rotation, self.centroid.expand_as(state.centre))
        return Prediction(self.factory.retract(state.offsets * self.prior_std), RigidTransform(state.rotation, shift))

    def project(self, prediction: Prediction) -> Projection:
        """Project the object's fiducials, treated as points: (B, C, N), without gradient."""
        return prediction.rig.project_values(prediction.rig_from_object.apply(self.centred + self.centroid))

    def absolute(self, numbers: Tensor) -> Prediction:
        """Decode the paper's 13 + D numbers per camera (B, C, 13 + D), each camera independently in the object's frame.

        Scales are common to the rig: working distance for translations, mean focal length, mean principal point; the
        6D rotation and the distortion are unscaled. Coefficients that a lens does not have stay zero.

        Source: paper, supplementary section 1.
        """
        identity = numbers.new_tensor((1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
        packed = torch.cat(
            (
                numbers[..., :6] + identity,
                numbers[..., 6:9] * self.working_distance,
                numbers[..., 9:11] * self.focal_length.mean(),
                numbers[..., 11:13] * self.principal_point.mean(0),
                numbers[..., 13:] * self.has_coefficient,
            ),
            dim=-1,
        )
        return Prediction.from_cameras(unpack18(packed, self.factory), self.factory)

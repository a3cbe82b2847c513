"""`CameraRig`: intrinsics and extrinsics of any number of cameras, with any leading batch axes; `RigPosterior`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Literal

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import (
    LENS_MODELS,
    Join,
    ModelNames,
    Projection,
    RigidTransform,
    lens_label,
    lens_names,
    lens_width,
    project_arrays,
    project_components,
    project_cpu,
    resized_pixels,
    rotate,
    rotation_from_vector,
    vector_from_rotation,
)
from imgcal.types.volume import ConvexVolume
from renderers import is_traced
from renderers.interpreting import without_machine_code

PINHOLE = (
    "rotation_x", "rotation_y", "rotation_z", "position_x", "position_y", "position_z", "fx", "fy", "cx", "cy",
)  # fmt: skip
"""Free parameters of a camera before its lens: rotation (3, rad), position (3, mm), focal length (2, pixels), principal
point (2, pixels). The K parameters of a rig's cameras are these and the D coefficients of `distortion`. Rotation:
cam_from_rig = exp(w) cam_from_rig0. Position: of the camera in the rig."""
EXTRINSICS = 6
"""Number of a camera's first parameters: its rotation and position."""
PARAMETER_KINDS = {
    "rotation": slice(0, 3),
    "position": slice(3, 6),
    "focal_length": slice(6, 8),
    "principal_point": slice(8, 10),
    "distortion": slice(10, None),
}
"""Position of each kind of value, named as in a rig file's `prior`, among the parameters of a camera."""
SHOWN_UNITS: Mapping[str, tuple[Literal["deg", "mm", "px"], float]] = {
    "rotation": ("deg", math.degrees(1.0)), "position": ("mm", 1.0),
    "focal_length": ("px", 1.0), "principal_point": ("px", 1.0),
}  # fmt: skip
"""Unit in which people read a change of each kind, and the factor from rad, mm or pixels."""


def parameter_names(lens_models: Sequence[str], width: int | None = None) -> tuple[str, ...]:
    """Name the parameters of cameras with these lenses; see `CameraRig.parameter_names`.

    Args:
        lens_models: names of `LENS_MODELS`.
        width: D of their distortion; None = what they need.
    """
    names = dict.fromkeys(lens_models)
    fill = [""] * (lens_width(tuple(names)) if width is None else width)
    columns = zip_longest(*(LENS_MODELS[name].coefficients for name in names), fill, fillvalue="")
    return (*PINHOLE, *("/".join(dict.fromkeys(filter(None, column))) or "-" for column in columns))


PARAMETER_NAMES = parameter_names(["brown_conrady"])
"""Parameter names of a camera with a Brown-Conrady lens."""
PARAMETERS = len(PARAMETER_NAMES)


@dataclass(frozen=True)
class RigPrior:
    """One standard deviation of each factory value: how far a camera may have drifted.

    Examples:
        >>> import imgcal
        >>> rig = imgcal.load_rig("T4")
        >>> prior = RigPrior(focal_length=0.01, position=2.0)
        >>> prior.std(rig).shape  # four cameras, 10 parameters and 5 coefficients
        torch.Size([4, 15])
        >>> prior.std(rig)[0, 3:6]  # mm
        tensor([2., 2., 2.], dtype=torch.float64)
    """

    focal_length: float = 0.02  # relative
    principal_point: float = 10.0  # pixels
    distortion: float = 0.05  # absolute
    rotation: float = 0.01  # rad, each axis
    position: float = 10.0  # mm, each axis

    def std(self, rig: CameraRig) -> Tensor:
        """Standard deviations of the parameters: (*B, C, K), in the order of `CameraRig.parameter_names`.

        Zero for coefficients that a camera's lens does not have.
        """
        ones = torch.ones_like(rig.distortion)
        std = torch.cat(
            (
                ones[..., :3] * self.rotation,
                ones[..., :3] * self.position,
                rig.focal_length * self.focal_length,
                ones[..., :2] * self.principal_point,
                ones * self.distortion,
            ),
            dim=-1,
        )
        return rig.only_existing(std)


@dataclass(frozen=True)
class DriftRate:
    """How fast each value drifts while the rig is in use: one standard deviation of a random walk after an hour.

    The defaults are for cameras on a rigid mount indoors: lenses and sensors change with temperature by a few
    hundredths of a percent, and mounts creep. After four hours each deviation is twice as large.

    Examples:
        >>> import imgcal
        >>> DriftRate(position=0.5).std(imgcal.load_rig("T4"))[0, 3:6]  # mm after an hour
        tensor([0.5000, 0.5000, 0.5000], dtype=torch.float64)
    """

    focal_length: float = 3e-4  # relative
    principal_point: float = 0.3  # pixels
    distortion: float = 1e-4  # absolute
    rotation: float = 2e-4  # rad, each axis
    position: float = 0.05  # mm, each axis

    def std(self, rig: CameraRig) -> Tensor:
        """Standard deviations of the parameters after an hour: (*B, C, K); see `CameraRig.parameter_names`."""
        return RigPrior(**vars(self)).std(rig)


@dataclass(frozen=True)
class CameraRig:
    """Cameras fixed to a common frame. The factory chooses this frame: only relations between cameras matter.

    Examples:
        >>> import imgcal
        >>> rig = imgcal.load_rig("O10")
        >>> rig.num_cameras, rig.camera_names[:2], rig.focal_length.shape
        (10, ('cam01', 'cam02'), torch.Size([10, 2]))
        >>> points_rig = torch.tensor([[0.0, 0.0, 850.0]], dtype=torch.float64)
        >>> rig.project(points_rig).uv.shape  # of one point in every camera
        torch.Size([10, 1, 2])
        >>> rig.select([0, 1]).camera_names
        ('cam01', 'cam02')
    """

    focal_length: Tensor  # (*B, C, 2) pixels: fx, fy
    principal_point: Tensor  # (*B, C, 2) pixels: cx, cy
    distortion: Tensor  # (*B, C, D): coefficients in the order of each camera's lens model, padded with zeros
    cam_from_rig: RigidTransform  # (*B, C)
    image_size: Tensor  # (C, 2) pixels: width, height
    camera_names: tuple[str, ...]  # C
    name: str = "rig"
    working_distance: float | None = None  # mm, from the rig's origin along z to the object
    prior: RigPrior | None = None
    drift_rate: DriftRate | None = None  # None = the defaults
    volume: ConvexVolume | None = None  # working volume, in the rig frame
    lens_model: ModelNames = "brown_conrady"  # a name of `geometry.LENS_MODELS` for all cameras, or one for each
    posterior: Callable[[], RigPosterior] | None = field(default=None, metadata={"saved": False})
    """Uncertainty of these values, if they come from a calibration."""

    def __repr__(self) -> str:
        """Summarize: `CameraRig('O10': 10 cameras, cam01 to cam10)`; `print` shows the values of each camera."""
        batch = f" x {tuple(self.batch_shape)}" if self.batch_shape else ""
        first, last = self.camera_names[0], self.camera_names[-1]
        cameras = f"camera {first}" if first == last else f"{self.num_cameras} cameras, {first} to {last}"
        return f"CameraRig({self.name!r}{batch}: {cameras})"

    def __str__(self) -> str:
        """List the cameras, with the unit of each value, and each lens with its model and coefficients.

        A rig with batch axes is only summarized.
        """
        if self.batch_shape:
            return repr(self)
        width = max(6, *(len(name) for name in self.camera_names))
        head = f"{'camera':<{width}}  image (px)   fx, fy (px)         cx, cy (px)"
        rows = [repr(self), f"{head}          position in the rig (mm)       lens"]
        values = (self.focal_length, self.principal_point, self.distortion, self.positions.round(decimals=2) + 0.0)
        columns = zip(self.camera_names, self.image_size.tolist(), *(value.tolist() for value in values), strict=True)
        for model, (name, (w, h), focal, centre, lens, position) in zip(self.lens_models, columns, strict=True):
            pixels = "".join(f"{a:9.2f} {b:9.2f} " for a, b in (focal, centre))
            coefficients = zip(LENS_MODELS[model].coefficients, lens, strict=False)  # the rest is padding
            words = ", ".join(f"{coefficient} {value: .5f}" for coefficient, value in coefficients)
            place = " ".join(f"{x:9.2f}" for x in position)
            rows.append(f"{name:<{width}}  {w:>4} x {h:<4} {pixels} {place}  {model}: {words}")
        return "\n".join(rows)

    @property
    def batch_shape(self) -> torch.Size:
        """Leading batch axes."""
        return self.focal_length.shape[:-2]

    @property
    def num_cameras(self) -> int:
        """Number of cameras, C."""
        return len(self.camera_names)

    @property
    def lens_models(self) -> tuple[str, ...]:
        """Name of each camera's lens model: C."""
        return lens_names(self.lens_model, self.num_cameras)

    @property
    def num_parameters(self) -> int:
        """Number of parameters of a camera, K: ten plus the width D of the distortion."""
        return len(PINHOLE) + self.distortion.shape[-1]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the K parameters; coefficients that differ between lens models have both names: "p1/k3".

        Examples:
            >>> import imgcal
            >>> imgcal.load_rig("T4").parameter_names[6:]
            ('fx', 'fy', 'cx', 'cy', 'k1', 'k2', 'p1', 'p2', 'k3')
        """
        return parameter_names(self.lens_models, self.distortion.shape[-1])

    def parameter_names_of(self, camera: int) -> tuple[str, ...]:
        """Names of the K parameters of one camera; "-" for coefficients that its lens does not have."""
        return parameter_names([self.lens_models[camera]], self.distortion.shape[-1])

    @property
    def has_coefficient(self) -> Tensor:
        """Tell which of the distortion's entries are coefficients of the camera's lens: (C, D) bool."""
        count = torch.tensor([len(LENS_MODELS[name].coefficients) for name in self.lens_models])
        return (torch.arange(self.distortion.shape[-1]) < count[:, None]).to(self.distortion.device)

    def only_existing(self, std: Tensor) -> Tensor:
        """Set standard deviations (*B, C, K) to zero where a camera's lens has no such coefficient."""
        names = (self.lens_model,) if isinstance(self.lens_model, str) else self.lens_model
        if all(len(LENS_MODELS[name].coefficients) == self.distortion.shape[-1] for name in names):
            return std
        return torch.cat((std[..., : len(PINHOLE)], std[..., len(PINHOLE) :] * self.has_coefficient), dim=-1)

    @property
    def positions(self) -> Tensor:
        """Camera centres in the rig frame: (*B, C, 3) mm."""
        return -self.cam_from_rig.origin_image()

    def project(self, points_rig: Tensor, radius: Tensor | None = None) -> Projection:
        """Project points into every camera.

        Args:
            points_rig: (*B, N, 3) mm, points in the rig frame; batch axes broadcast against the rig's.
            radius: (N,) mm of spherical fiducials, whose apparent centres are projected; None = points.

        Returns:
            uv (*B, C, N, 2), depth and visible (*B, C, N); differentiable.
        """
        # Separate components, and fiducials first in memory: each step then runs over one long row of all cameras.
        components = points_rig.movedim((-1, -2), (0, 1)).contiguous().unsqueeze(-1)  # (3, N, *B, 1)
        x, y, z = components.expand(*components.shape[:-1], self.num_cameras).contiguous().movedim(1, -1)  # (*B, C, N)
        rows = self.cam_from_rig.rotation.unsqueeze(-3).unbind(-2)
        shifts = self.cam_from_rig.translation.unsqueeze(-2).unbind(-1)
        points_cam = []
        for row, shift in zip(rows, shifts, strict=True):
            by_x, by_y, by_z = row.unbind(-1)  # (*B, C, 1)
            points_cam.append(torch.addcmul(torch.addcmul(torch.addcmul(shift, x, by_x), y, by_y), z, by_z))
        lens = (self.focal_length, self.principal_point, self.distortion)
        return project_components(tuple(points_cam), *lens, self.image_size, radius, self.lens_model)

    def project_values(self, points_rig: Tensor, radius: Tensor | None = None) -> Projection:
        """Project like `project` but without gradients: several times faster on the CPU.

        Args:
            points_rig: (*B, N, 3) mm, one set for each of the (*B) rigs; same floating-point type.
            radius: (N,) mm of spherical fiducials; None = points.

        Raises:
            InputError: the points have other batch axes than the rigs, or shapes do not fit together.
        """
        if points_rig.shape[:-2] != self.batch_shape:
            expected = ", ".join(map(str, (*self.batch_shape, "N", 3)))
            raise InputError(f"points: found shape {tuple(points_rig.shape)}, expected ({expected}) as for the rigs")
        if points_rig.device.type != "cpu" or is_traced():
            with torch.no_grad():
                return self.project(points_rig, radius)
        if missing := without_machine_code(project_arrays):
            return missing.call_twin(torch.no_grad()(self.project), points_rig, radius)
        lens = (self.focal_length, self.principal_point, self.distortion)
        return project_cpu(points_rig, self.cam_from_rig, *lens, self.image_size, radius, self.lens_model)

    def from_object(self, rig_from_object: RigidTransform) -> CameraRig:
        """Express the rig in the frame of an object: `cam_from_rig` of the result is `cam_from_object`.

        Args:
            rig_from_object: (*B) transforms.

        Returns:
            The same cameras; batch axes broadcast.
        """
        expanded = RigidTransform(rig_from_object.rotation[..., None, :, :], rig_from_object.translation[..., None, :])
        cam_from_object = self.cam_from_rig @ expanded
        batch = cam_from_object.rotation.shape[:-3]
        return replace(
            self,
            focal_length=self.focal_length.expand(*batch, -1, -1),
            principal_point=self.principal_point.expand(*batch, -1, -1),
            distortion=self.distortion.expand(*batch, -1, -1),
            cam_from_rig=cam_from_object,
        )

    def retract(self, step: Tensor) -> CameraRig:
        """Add a step to the parameters: (*B, C, K), in the order of `parameter_names`."""
        rotation = rotation_from_vector(step[..., 0:3]) @ self.cam_from_rig.rotation
        positions = self.positions + step[..., 3:6]
        return replace(
            self,
            focal_length=self.focal_length + step[..., 6:8],
            principal_point=self.principal_point + step[..., 8:10],
            distortion=self.distortion + step[..., 10:],
            cam_from_rig=RigidTransform(rotation, -rotate(rotation, positions)),
        )

    def local(self, reference: CameraRig) -> Tensor:
        """Invert `retract`: the step (*B, C, K) that takes `reference` to this rig."""
        rotation = self.cam_from_rig.rotation @ reference.cam_from_rig.rotation.mT
        parts = (
            vector_from_rotation(rotation),
            self.positions - reference.positions,
            self.focal_length - reference.focal_length,
            self.principal_point - reference.principal_point,
            self.distortion - reference.distortion,
        )
        batch = torch.broadcast_tensors(*(part[..., 0] for part in parts))[0].shape  # broadcast_shapes loads sympy
        return torch.cat([part.expand(*batch, -1) for part in parts], dim=-1)

    def resized(self, image_size: Tensor) -> CameraRig:
        """Scale the intrinsics to images of another size by the pixel-centre rule u' + 1/2 = s (u + 1/2).

        Args:
            image_size: (C, 2) or (2,) pixels: new width, height.
        """
        image_size = image_size.expand(self.num_cameras, 2)
        scale = image_size.to(self.focal_length) / self.image_size.to(self.focal_length)
        return replace(
            self,
            focal_length=self.focal_length * scale,
            principal_point=resized_pixels(self.principal_point, scale),
            image_size=image_size,
        )

    def select(self, cameras: Sequence[int]) -> CameraRig:
        """Keep the cameras of the given indices, in the given order."""
        index = list(cameras)
        return replace(
            self,
            focal_length=self.focal_length[..., index, :],
            principal_point=self.principal_point[..., index, :],
            distortion=self.distortion[..., index, :],
            cam_from_rig=RigidTransform(
                self.cam_from_rig.rotation[..., index, :, :], self.cam_from_rig.translation[..., index, :]
            ),
            image_size=self.image_size[index],
            camera_names=tuple(self.camera_names[i] for i in index),
            lens_model=lens_label([self.lens_models[i] for i in index]),
        )

    @classmethod
    def stack(cls, parts: Sequence[CameraRig]) -> CameraRig:
        """Stack several along a new first batch axis."""
        return cls.combine(parts, torch.stack)

    @classmethod
    def cat(cls, parts: Sequence[CameraRig]) -> CameraRig:
        """Concatenate several along their first batch axis."""
        return cls.combine(parts, torch.cat)

    @classmethod
    def combine(cls, rigs: Sequence[CameraRig], join: Join) -> CameraRig:
        """Combine `rigs` into one; `join` takes the list of focal lengths, and so on. The rest is from the first."""
        return replace(
            rigs[0],
            focal_length=join([rig.focal_length for rig in rigs]),
            principal_point=join([rig.principal_point for rig in rigs]),
            distortion=join([rig.distortion for rig in rigs]),
            cam_from_rig=RigidTransform.combine([rig.cam_from_rig for rig in rigs], join),
        )

    def __getitem__(self, index: object) -> CameraRig:
        """Index the batch axes."""
        return self.map_tensors(lambda tensor, _: tensor[index])  # type: ignore[index]

    def expand(self, *batch: int) -> CameraRig:
        """Repeat the rig over leading batch axes without copying."""
        return self.map_tensors(lambda tensor, axes: tensor.expand(*batch, *tensor.shape[-axes:]))

    def reshape(self, *batch: int) -> CameraRig:
        """Change the batch axes to another shape with as many rigs."""
        return self.map_tensors(lambda tensor, axes: tensor.reshape(*batch, *tensor.shape[-axes:]))

    def map_tensors(self, function: Callable[[Tensor, int], Tensor]) -> CameraRig:
        """Apply `function(tensor, number of its last axes that are not batch)` to every tensor with batch axes *B."""
        return replace(
            self,
            focal_length=function(self.focal_length, 2),
            principal_point=function(self.principal_point, 2),
            distortion=function(self.distortion, 2),
            cam_from_rig=RigidTransform(
                function(self.cam_from_rig.rotation, 3), function(self.cam_from_rig.translation, 2)
            ),
        )

    def as_constant(self) -> CameraRig:
        """Copy in double precision, detached from the graph: for code that computes no gradients."""
        return self.map_tensors(lambda tensor, _: tensor.detach().to(torch.float64))

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> CameraRig:
        """Change the floating-point type, move to a device, or both."""
        moved = self.map_tensors(lambda tensor, _: tensor.to(dtype=dtype, device=device))
        return replace(moved, image_size=self.image_size.to(device=device))


SINGLE = 5e-7
"""Relative difference of values that were kept in single precision."""


@dataclass(frozen=True)
class RigPosterior:
    """Joint posterior of a rig's values and the object's shape, in the form of `monitoring.RigBelief`.

    D = K C + M errors: K for each of C cameras, in units of `unit`, and M for the object, in standard deviations.
    """

    rig: CameraRig  # the most probable one, float64, without batch axes
    points: Tensor  # (N, 3) mm, fiducials from the object's file
    tolerance: Tensor  # (N,) mm, one standard deviation of each coordinate; zeros = exact
    scale_tolerance: float
    object_offset: Tensor  # (M,) in standard deviations of that tolerance; M = 0 where the object is exact
    factor: Tensor  # (D, D) lower Cholesky factor of the information
    unit: Tensor  # (C, K) rad, mm, pixels, 1
    snapshots: int  # number of snapshots that it is based on
    time: float | None = None  # s since the epoch, when it was made; None = unknown

    def of_cameras(self, names: Sequence[str]) -> RigPosterior | None:
        """Keep some cameras, in this order, whatever the others' values are; None = it does not know all of them."""
        known, (cameras, size) = self.rig.camera_names, self.unit.shape
        if tuple(names) == known:
            return self
        if not set(names) <= set(known):
            return None
        index = [known.index(name) for name in names]
        rows = torch.arange(cameras * size).view(cameras, size)[index].flatten()
        rows = torch.cat((rows, torch.arange(cameras * size, len(self.factor))))
        covariance = torch.cholesky_inverse(self.factor)[rows][:, rows]
        factor = torch.linalg.cholesky(torch.cholesky_inverse(torch.linalg.cholesky(covariance)))
        return replace(self, rig=self.rig.select(index), factor=factor, unit=self.unit[index])

    def belongs_to(self, rig: CameraRig) -> bool:
        """Tell whether this describes a rig with these values, to single precision, not one changed since."""
        mine, others = (
            (one.cam_from_rig.rotation, one.cam_from_rig.translation, one.focal_length, one.principal_point,
             one.distortion)
            for one in (self.rig, rig)
        )  # fmt: skip
        return all(
            a.shape == b.shape and bool((a.double() - b.double()).abs().max() <= SINGLE * (1 + a.double().abs().max()))
            for a, b in zip(mine, others, strict=True)
        )

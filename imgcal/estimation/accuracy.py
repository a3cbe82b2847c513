"""Predicted errors of a recalibrated rig over the working volume, in pixels and in mm."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.estimation import Estimate, camera_covariance
from imgcal.estimation.rig_uncertainty import RigUncertainty, uncertainty_over
from imgcal.geometry import rotate, undistort
from imgcal.types import CameraRig

GRID = 7
"""Cells along each side of the working volume; odd, so that one lies at the centre."""
ANCHORS = 4
"""Cells along each side of the coarser grid on which the true and the estimated rig are aligned."""
MAP_SIZE = (16, 24)
"""Rows and columns of each camera's error map, which covers the whole image."""
MAP_DEPTHS = (0.05, 0.5, 0.95)
"""Depths of the maps, as quantiles of the depths at which a camera sees the working volume."""
SAME_DISTANCE = 1.5
"""Ratio of distances within which a place is at the cameras' working distance."""

EXCEPTIONAL = 2.0
"""Multiple of the median camera's error beyond which a camera is an exception."""


@dataclass(frozen=True)
class WorkingVolume:
    """A box along the axes of the rig frame.

    Examples:
        >>> volume = WorkingVolume(torch.tensor([-100.0, -100.0, 700.0]), torch.tensor([100.0, 100.0, 1000.0]))
        >>> volume.grid(3).shape, volume.contains(torch.tensor([0.0, 0.0, 850.0]))
        (torch.Size([3, 3, 3, 3]), tensor(True))
    """

    low: Tensor  # (3,) mm
    high: Tensor  # (3,) mm

    def grid(self, count: int = GRID) -> Tensor:
        """Centres of equal cells that fill the box: (count, count, count, 3) mm, indexed by x, y, z."""
        steps = (torch.arange(count, dtype=self.low.dtype, device=self.low.device) + 0.5) / count
        share = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1)
        return self.low + share * (self.high - self.low)

    def contains(self, points: Tensor) -> Tensor:
        """Check which points (..., 3) lie inside: (...) bool."""
        return ((points >= self.low) & (points <= self.high)).all(-1)


@dataclass(frozen=True)
class ErrorMaps:
    """Predicted errors over whole images, at some depths of each camera."""

    px: Tensor  # (C, D, H, W) pixels; nan where a pixel has no ray
    depths: Tensor  # (C, D) mm; nan for a camera that sees none of the volume
    inside: Tensor  # (C, D, H, W) bool, in the working volume


@dataclass(frozen=True)
class PredictedError:
    """Expected errors of a rig, after the rigid motion of the whole rig that minimizes them.

    All are expected (RMS) lengths, and come from the calibration's errors alone unless stated otherwise. Pixels: image
    of a point by the true rig against that by this one. Millimetres: a point seen by all cameras that have it in view,
    without noise, triangulated with this rig, against the true point.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> from imgcal.types import Observations
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
        >>> observations = Observations(truth.uv, torch.full(seen.shape, 0.05), seen)
        >>> error = predicted_error(imgcal.estimate(observations, factory, obj))
        >>> 0 < error.median_mm < error.p95_mm, 0 < error.median_px < error.p95_px
        (True, True)
    """

    volume: WorkingVolume
    camera_names: tuple[str, ...]  # C
    uncertainty: RigUncertainty  # predicts the same errors at any point
    px: Tensor  # (C, X, Y, Z) pixels over `volume.grid()`; nan where the camera does not see the point
    mm: Tensor  # (X, Y, Z) mm; nan where fewer than two cameras see the point
    mm_with_noise: Tensor  # (X, Y, Z) mm, with pixel noise of standard deviation `noise` included
    noise: float  # px, median standard deviation of the observations, per axis

    def __repr__(self) -> str:
        """Show the medians: `PredictedError(0.003 mm, 0.002 px, 10 cameras)`."""
        return f"PredictedError({self.median_mm:.2g} mm, {self.median_px:.2g} px, {len(self.camera_names)} cameras)"

    @property
    def median_px(self) -> float:
        """Median over cameras and the points that they see."""
        return _quantile(self.px, 0.5)

    @property
    def p95_px(self) -> float:
        """95th percentile over cameras and the points that they see."""
        return _quantile(self.px, 0.95)

    @property
    def median_mm(self) -> float:
        """Median over the part of the volume that at least two cameras see."""
        return _quantile(self.mm, 0.5)

    @property
    def p95_mm(self) -> float:
        """95th percentile over the part of the volume that at least two cameras see."""
        return _quantile(self.mm, 0.95)

    @property
    def median_mm_with_noise(self) -> float:
        """Median error of one triangulated point, pixel noise included."""
        return _quantile(self.mm_with_noise, 0.5)

    @property
    def camera_px(self) -> tuple[float, ...]:
        """Median of each camera over the part of the volume that it sees, C; nan if it sees none."""
        return tuple(_quantile(camera, 0.5) for camera in self.px)

    @property
    def worst_camera(self) -> int:
        """Index of the camera with the largest median error."""
        return int(torch.tensor(self.camera_px).nan_to_num(-1.0).argmax())

    @property
    def exceptions(self) -> tuple[int, ...]:
        """Indices of the cameras with much larger errors than the others, the worst first."""
        known = torch.tensor(self.camera_px)
        usual = _quantile(known, 0.5)
        return tuple(int(i) for i in known.nan_to_num(-1.0).argsort(descending=True) if known[i] > EXCEPTIONAL * usual)

    @cached_property
    def mm_without_exceptions(self) -> Tensor:
        """`mm` with the exceptions excluded from triangulation: (X, Y, Z)."""
        others = self.uncertainty.drop_cameras(self.exceptions)
        return others.point_error(self.volume.grid().flatten(0, -2)).view(self.mm.shape)

    @cached_property
    def maps(self) -> ErrorMaps:
        """Errors over each camera's whole image; computed on first access."""
        projection = self.uncertainty.rig.project(self.volume.grid().flatten(0, -2))
        return _maps(self.uncertainty, self.volume, torch.where(projection.visible, projection.depth, torch.nan))

    @property
    def seen_share(self) -> float:
        """Share of the volume that at least two cameras see."""
        return float(self.mm.isfinite().double().mean())

    def summary(self) -> dict[str, Any]:
        """Plain values for `result.json`; unknown values are None."""
        worst = self.worst_camera
        return {
            "median_px": _none_if_nan(self.median_px),
            "p95_px": _none_if_nan(self.p95_px),
            "median_mm": _none_if_nan(self.median_mm),
            "p95_mm": _none_if_nan(self.p95_mm),
            "noise_px": self.noise,
            "median_mm_with_noise": _none_if_nan(self.median_mm_with_noise),
            "worst_camera": self.camera_names[worst],
            "worst_camera_px": _none_if_nan(self.camera_px[worst]),
            "exceptions": [self.camera_names[i] for i in self.exceptions],
            "median_mm_without_exceptions": _none_if_nan(_quantile(self.mm_without_exceptions, 0.5)),
            "per_camera_px": {n: _none_if_nan(px) for n, px in zip(self.camera_names, self.camera_px, strict=True)},
            "volume_mm": {"low": self.volume.low.tolist(), "high": self.volume.high.tolist()},
            "seen_by_two_cameras": self.seen_share,
        }


class HasEstimate(Protocol):
    """An object with an `estimate`, for instance a `Calibration`."""

    @property
    def estimate(self) -> Estimate:
        """The estimate."""


def predicted_error(
    calibration: Estimate | HasEstimate, *, volume: WorkingVolume | None = None, covariance: Tensor | None = None
) -> PredictedError:
    """Predict the errors of a recalibrated rig where it is used.

    Args:
        calibration: the result of `calibrate` or `estimate`, without batch axes.
        volume: where the rig is used; None = `working_volume(calibration)`.
        covariance: (K C, K C) of all cameras' parameters; None = `joint_covariance(calibration)`.

    Raises:
        InputError: an estimate with batch axes.
        RefusedError: the information is singular.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> from imgcal.types import Observations
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
        >>> observations = Observations(truth.uv, torch.full(seen.shape, 0.05), seen)
        >>> result = imgcal.estimate(observations, factory, obj)
        >>> low, high = torch.tensor([[-50.0, -50.0, 800.0], [50.0, 50.0, 900.0]], dtype=torch.float64)
        >>> volume = WorkingVolume(low, high)
        >>> predicted_error(result, volume=volume).median_px < 0.1
        True
    """
    found = calibration if isinstance(calibration, Estimate) else calibration.estimate
    if found.rig.batch_shape:
        raise InputError(
            f"predicted error: found a batch of {tuple(found.rig.batch_shape)} rigs, expected one rig without "
            "batch axes"
        )
    rig = found.rig.as_constant()
    volume = working_volume(found) if volume is None else volume
    volume = replace(volume, low=volume.low.to(rig.focal_length), high=volume.high.to(rig.focal_length))
    covariance = joint_covariance(found) if covariance is None else covariance
    grid = volume.grid()
    shape, points = grid.shape[:-1], grid.flatten(0, -2)
    anchors = volume.grid(ANCHORS).flatten(0, -2)
    uncertainty = uncertainty_over(rig, covariance.detach().to(points), anchors)
    projection = rig.project(points)
    seen, noise = projection.visible, _noise(found)
    px, mm, mm_with_noise = uncertainty.errors(points, seen, noise)
    return PredictedError(
        volume=volume,
        camera_names=rig.camera_names,
        uncertainty=uncertainty,
        px=torch.where(seen, px, torch.nan).unflatten(1, shape),
        mm=mm.view(shape),
        mm_with_noise=mm_with_noise.view(shape),
        noise=noise,
    )


def joint_covariance(calibration: Estimate) -> Tensor:
    """Covariance of all cameras' parameters for the prediction: (K C, K C).

    This is the first-order covariance. The second-order part of `camera_covariance` is mostly due to motions of the
    whole rig, which only the prior constrains: they change the parameters nonlinearly. Such a motion is no error, but a
    linear projection cannot remove it. For the rest, first order is enough (docs/benchmarks/tables.md, "Honesty").
    """
    return camera_covariance(calibration, curved=False)


def working_volume(calibration: Estimate) -> WorkingVolume:
    """The volume where the rig is used, inferred from a calibration.

    Returns:
        The box that holds the object, in any orientation, about every place where it was seen. If the rig has a working
        distance, the place at that distance counts, too, unless the rig's frame is another than the convention says; a
        single snapshot then gives a useful box.
    """
    problem, rig = calibration.problem, calibration.rig.as_constant()
    pose = calibration.rig_from_object.to(torch.float64)
    centres = rotate(pose.rotation.detach(), problem.centroid.detach().to(pose.rotation)) + pose.translation.detach()
    if (usual := _usual_place(rig)) is not None:
        centres = torch.cat((centres, usual[None]))
    reach = float(problem.points.norm(dim=-1).max())
    return WorkingVolume(centres.amin(0) - reach, centres.amax(0) + reach)


def _usual_place(rig: CameraRig) -> Tensor | None:
    """Where a rig's working distance puts the object: (3,) mm. None = it has none, or its frame is not of that kind.

    By convention the cameras are near the origin and look along z: then they see this place, and are as far from it.
    """
    if rig.working_distance is None:
        return None
    place = rig.positions.new_tensor((0.0, 0.0, rig.working_distance))
    distance = float((rig.positions - place).norm(dim=-1).median())
    as_far = 1 / SAME_DISTANCE < distance / rig.working_distance < SAME_DISTANCE
    seen = rig.project(place[None]).visible.to(place).mean()
    return place if as_far and float(seen) > 0.5 else None


def _maps(uncertainty: RigUncertainty, volume: WorkingVolume, depths: Tensor) -> ErrorMaps:
    """Compute errors over whole images at some depths.

    Args:
        uncertainty: of the rig.
        volume: where the rig is used.
        depths: (C, P) mm at which cameras see the volume; nan where a point is not visible.
    """
    rig = uncertainty.rig
    shown = torch.nanquantile(depths, depths.new_tensor(MAP_DEPTHS), dim=1).mT  # (C, D)
    on_plane, valid = _rays(rig, MAP_SIZE)
    rays = torch.cat((on_plane, torch.ones_like(on_plane[..., :1])), -1)  # (C, H W, 3)
    in_camera = (rays[:, None] * shown[..., None, None]).flatten(1, 2)  # (C, D H W, 3)
    points = rig.cam_from_rig.inverse().apply(in_camera)
    shape = (len(MAP_DEPTHS), *MAP_SIZE)
    error = uncertainty.pixel_error(points).unflatten(1, shape)
    inside = volume.contains(points).unflatten(1, shape)
    return ErrorMaps(torch.where(valid.unflatten(1, MAP_SIZE)[:, None], error, torch.nan), shown, inside)


def _rays(rig: CameraRig, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Undistorted cell centres of each image: (C, H W, 2) on the z = 1 plane, (C, H W) bool whether they are valid."""
    rows, columns = ((torch.arange(n, dtype=torch.float64, device=rig.focal_length.device) + 0.5) / n for n in size)
    share = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).flatten(0, 1)
    uv = share * rig.image_size[:, None] - 0.5
    xy = (uv - rig.principal_point[:, None]) / rig.focal_length[:, None]
    return undistort(xy, rig.distortion, rig.lens_model)


def _noise(calibration: Estimate) -> float:
    weight = calibration.problem.root_weight
    return float((1 / weight[weight > 0].double()).median())


def _quantile(values: Tensor, share: float) -> float:
    known = values[values.isfinite()]
    return float(known.quantile(share)) if len(known) else float("nan")


def _none_if_nan(value: float) -> float | None:
    return value if value == value else None

"""What a calibration does not know because the object was not there: coverage, undetermined values, where to go."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from imgcal.pipeline.calibration import Calibration

FIELDS = 8
"""An image is divided into 8 x 8 fields to count how much of it was reached."""
UNDETERMINED = 0.8
"""A value is not determined by the data when its standard deviation is still this share of the prior's."""
HELD = 1e-5
"""A value whose prior is narrower is fixed: the data are not asked for it."""
LITTLE = 0.5
"""Share of its image that a camera has seen the object in, below which it is said where to go."""
LEAST_SEEN = 4
"""Fiducials that two cameras must see where the object is sent."""
MOST_POINTS = 64  # of the object, that are looked at
STEPS = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)  # half widths of what the cameras see, from where it was


@dataclass(frozen=True)
class Place:
    """Where the object would show something new."""

    rig_from_centre: tuple[float, float, float]  # mm, the middle of the object in the rig's frame
    offset: tuple[float, float, float]  # mm, from the middle of where it has been
    fields: int  # of the images, of 64 in each, that it would reach for the first time
    cameras: int  # whose fields these are

    def __str__(self) -> str:
        """Say it in words, along the axes of the rig."""
        parts = [
            f"{value:+.0f} mm in {axis}" for axis, value in zip("xyz", self.offset, strict=True) if abs(value) >= 1
        ]
        return f"{', '.join(parts) or 'where it was'} ({self.fields} new fields in {self.cameras} cameras)"


@dataclass(frozen=True)
class Coverage:
    """What is known of the lenses, and what is not."""

    camera_names: tuple[str, ...]  # C
    coverage: tuple[float, ...]  # C, share of each image's fields in which fiducials were used
    undetermined: dict[str, tuple[str, ...]]  # parameter of the lens or sensor -> cameras in which it is the factory's
    places: tuple[Place, ...]  # the one that shows most first
    from_scratch: bool = False  # what stands where the data say nothing is no factory's

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is not known, in words; empty where the images were reached and all values are determined."""
        words, count = [], len(self.camera_names)
        if self.undetermined:
            by_cameras: dict[tuple[str, ...], list[str]] = {}
            for name, cameras in self.undetermined.items():
                by_cameras.setdefault(cameras, []).append(name)
            parts = [f"{', '.join(names)} in {_cameras(cameras, count)}" for cameras, names in by_cameras.items()]
            stands = "what was assumed stands" if self.from_scratch else "the factory's values stand"
            words.append(f"Not determined by these data, {stands}: {'; '.join(parts)}.")
        low, high = (round(100 * f(self.coverage)) for f in (min, max))
        if low < 100 * LITTLE:
            share = f"{low}" if low == high else f"{low} to {high}"
            words.append(f"The object was seen in {share} % of the images: elsewhere the lenses are extrapolated.")
        return tuple(words)

    @property
    def advice(self) -> str:
        """Where to move the object, in words; empty where nothing is missing."""
        if not self.sentences or not self.places:
            return ""
        places = "; ".join(map(str, self.places))
        return f"Move the object, along the axes of the rig and from where it was, by {places}; tilt it, too."


def measure_coverage(calibration: Calibration, std: Tensor) -> Coverage:
    """Count what was reached, and look for places that would reach more.

    Args:
        calibration: what was found.
        std: (C, K) one standard deviation of each value.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> result = imgcal.calibrate(true_detections(truth), factory, obj)
        >>> known = measure_coverage(result, result.estimate.covariance(0).diagonal().unflatten(0, (-1, 15)).sqrt())
        >>> max(known.coverage) < 0.5, len(known.places)
        (True, 3)
    """
    rig = calibration.rig
    prior = calibration.estimate.problem.prior_std[0]
    unknown = ((std > UNDETERMINED * prior) & (prior > HELD))[:, 6:]
    undetermined: dict[str, tuple[str, ...]] = {}
    for number, camera in unknown.mT.nonzero().tolist():
        name = rig.parameter_names_of(camera)[6 + number]  # lenses differ in what a number means
        undetermined[name] = (*undetermined.get(name, ()), rig.camera_names[camera])
    reached = _fields(calibration.observations.uv, calibration.observations.seen, rig.image_size)
    shares = tuple(reached.double().mean(-1).tolist())
    places = _places(calibration, reached)
    return Coverage(rig.camera_names, shares, undetermined, places, calibration.from_scratch)


def _fields(uv: Tensor, seen: Tensor, image_size: Tensor) -> Tensor:
    """Mark the fields of each image that hold something seen: (S, C, N, 2), (S, C, N) -> (C, FIELDS^2) bool."""
    return _fields_each(uv, seen, image_size).any(0)


def _fields_each(uv: Tensor, seen: Tensor, image_size: Tensor) -> Tensor:
    """The same for each of the first axis: (K, C, FIELDS^2) bool."""
    place = ((uv + 0.5) / image_size[:, None] * FIELDS).clamp(0, FIELDS - 1).nan_to_num(0.0).long()
    number = place[..., 1] * FIELDS + place[..., 0]
    marked = torch.zeros(*number.shape[:-1], FIELDS**2, dtype=torch.int32)
    return marked.scatter_add_(-1, number, seen.int()) > 0


def _places(calibration: Calibration, reached: Tensor, count: int = 3) -> tuple[Place, ...]:
    """Choose, one after the other, where the object would reach most fields that nothing has reached yet."""
    rig, poses = calibration.rig, calibration.rig_from_object
    of_largest = np.flatnonzero(calibration.obj.part_of == np.bincount(calibration.obj.part_of).argmax())
    fiducials = len(of_largest)
    chosen = int(of_largest[0]) + torch.linspace(0, fiducials - 1, min(fiducials, MOST_POINTS)).long()
    body = calibration.points_object[chosen].double()
    centres = poses.apply(body).mean(1)  # (S, 3)
    middle = centres.mean(0)
    depth = float((rig.positions - middle).norm(dim=-1).median())
    half = depth * float((rig.image_size[:, 0] / rig.focal_length[:, 0]).median()) / 2
    steps = torch.tensor(STEPS, dtype=torch.float64) * half
    offsets = torch.cartesian_prod(steps, steps, steps)  # (K, 3)
    around = poses.rotation[0] @ (body - body.mean(0)).mT  # turned as in the first snapshot
    points = around.mT + (middle + offsets)[:, None]
    radius = None if calibration.obj.radius is None else calibration.obj.radius[chosen]
    projection = replace(rig, prior=None).expand(len(points)).project_values(points, radius)
    seen = projection.visible
    pose_known = (seen.sum(-1) >= LEAST_SEEN).sum(-1) >= min(2, rig.num_cameras)
    shown = _fields_each(projection.uv, seen, rig.image_size) & pose_known[:, None, None]
    places, reached = [], reached.clone()
    for _ in range(count):
        new = shown & ~reached
        best = int(new.flatten(1).sum(1).argmax())
        fields = int(new[best].sum())
        if fields == 0:
            break
        where, offset = (middle + offsets[best]).tolist(), offsets[best].tolist()
        cameras = int(new[best].any(-1).sum())
        places.append(Place((where[0], where[1], where[2]), (offset[0], offset[1], offset[2]), fields, cameras))
        reached |= shown[best]
    return tuple(places)


def _cameras(cameras: tuple[str, ...], count: int) -> str:
    if len(cameras) == count and count > 1:
        return "all cameras"
    return ", ".join(cameras[:3]) + (f" and {len(cameras) - 3} more" if len(cameras) > 3 else "")

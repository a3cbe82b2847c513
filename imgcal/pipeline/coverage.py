"""Values that a calibration could not determine because the object was not there: coverage, and where to go."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from imgcal.messages import plural
from imgcal.pipeline.calibration import Calibration

FIELDS = 8
"""An image is divided into 8 x 8 fields to measure its coverage."""
UNDETERMINED = 0.8
"""A value is undetermined by the data if its standard deviation is still this share of the prior's."""
HELD = 1e-5
"""A value with a narrower prior is fixed, so it is not counted."""
LITTLE = 0.5
"""Coverage of an image below which advice is given."""
LEAST_SEEN = 4
"""Number of fiducials that two cameras must see at a recommended place."""
MOST_POINTS = 64  # maximum number of the object's fiducials to use
STEPS = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)  # half widths of the view, from the earlier place


@dataclass(frozen=True)
class Place:
    """A place where the object would add coverage."""

    rig_from_centre: tuple[float, float, float]  # mm, centre of the object in the rig's frame
    offset: tuple[float, float, float]  # mm, relative to the centre of its earlier places
    fields: int  # number of new image fields, of 64 in each image
    cameras: int  # number of cameras with such fields

    def __str__(self) -> str:
        """Describe it in words, along the axes of the rig."""
        parts = [
            f"{value:+.0f} mm in {axis}" for axis, value in zip("xyz", self.offset, strict=True) if abs(value) >= 1
        ]
        new = f"{plural(self.fields, 'new image cell')} in {plural(self.cameras, 'camera')}"
        return f"{', '.join(parts) or 'where it was'} ({new})"


@dataclass(frozen=True)
class Coverage:
    """What is known about the lenses, and what is not."""

    camera_names: tuple[str, ...]  # C
    coverage: tuple[float, ...]  # C, share of each image's fields with fiducials
    undetermined: dict[str, tuple[str, ...]]  # parameter of the lens or sensor -> cameras that keep the factory's
    places: tuple[Place, ...]  # the most useful first
    from_scratch: bool = False  # undetermined values are assumptions, not the factory's

    @property
    def sentences(self) -> tuple[str, ...]:
        """Describe what is not known; empty if the images were covered and all values are determined."""
        words, count = [], len(self.camera_names)
        if self.undetermined:
            by_cameras: dict[tuple[str, ...], list[str]] = {}
            for name, cameras in self.undetermined.items():
                by_cameras.setdefault(cameras, []).append(name)
            parts = [f"{', '.join(names)} in {_cameras(cameras, count)}" for cameras, names in by_cameras.items()]
            kept = "assumed" if self.from_scratch else "factory"
            words.append(f"Not determined by these data ({kept} values kept): {'; '.join(parts)}.")
        low, high = (round(100 * f(self.coverage)) for f in (min, max))
        if low < 100 * LITTLE:
            share = f"{low}" if low == high else f"{low} to {high}"
            words.append(f"The object was seen in {share} % of the images: elsewhere the lenses are extrapolated.")
        return tuple(words)

    @property
    def advice(self) -> str:
        """Describe where to move the object; empty if nothing is missing."""
        if not self.sentences or not self.places:
            return ""
        places = "; ".join(map(str, self.places))
        return f"From where it was, move the object along the rig's axes by {places}; tilt it, too."


def measure_coverage(calibration: Calibration, std: Tensor) -> Coverage:
    """Measure the coverage, and find places that would increase it.

    Args:
        calibration: the calibration.
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
        name = rig.parameter_names_of(camera)[6 + number]  # the meaning of a number depends on the lens
        undetermined[name] = (*undetermined.get(name, ()), rig.camera_names[camera])
    reached = _fields(calibration.observations.uv, calibration.observations.seen, rig.image_size)
    shares = tuple(reached.double().mean(-1).tolist())
    places = _places(calibration, reached)
    return Coverage(rig.camera_names, shares, undetermined, places, calibration.from_scratch)


def _fields(uv: Tensor, seen: Tensor, image_size: Tensor) -> Tensor:
    """Mark the fields of each image that contain something seen: (S, C, N, 2), (S, C, N) -> (C, FIELDS^2) bool."""
    return _fields_each(uv, seen, image_size).any(0)


def _fields_each(uv: Tensor, seen: Tensor, image_size: Tensor) -> Tensor:
    """The same for each element of the first axis: (K, C, FIELDS^2) bool."""
    place = ((uv + 0.5) / image_size[:, None] * FIELDS).clamp(0, FIELDS - 1).nan_to_num(0.0).long()
    number = place[..., 1] * FIELDS + place[..., 0]
    marked = torch.zeros(*number.shape[:-1], FIELDS**2, dtype=torch.int32)
    return marked.scatter_add_(-1, number, seen.int()) > 0


def _places(calibration: Calibration, reached: Tensor, count: int = 3) -> tuple[Place, ...]:
    """Choose places greedily: each reaches as many new fields as possible."""
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
    around = poses.rotation[0] @ (body - body.mean(0)).mT  # oriented as in the first snapshot
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

"""Candidate poses from the maps: around a known one, or anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from imgcal.association import pattern_prior
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.matching.correlation import Scores, correlate, gains
from imgcal.matching.maps import Maps
from imgcal.types import CalibrationObject, CameraRig

NEAR = 0.31  # rad: largest rotation from a known pose
STEP = 0.105  # rad: between the rotations tried around it
CLIMBS = (0.07, 0.035, 0.017)
"""Radians: step sizes of the search for the best rotation."""
OFF = 60.0  # mm: standard deviation of the position of a candidate pose


@dataclass(frozen=True)
class Scene:
    """The inputs of the search."""

    rig: CameraRig
    obj: CalibrationObject
    std: Tensor  # (C, parameters)
    distance: float  # mm, approximate, from the cameras to the object

    @cached_property
    def drift(self) -> NDArray[np.float64]:
        """Standard deviation of the image shift that drift causes: (C,) pixels."""
        return pattern_prior(self.std, self.rig, self.distance).shift

    @property
    def pixels_per_mm(self) -> float:
        """Scale of the images at the object."""
        return float(self.rig.focal_length.mean()) / self.distance


@dataclass(frozen=True)
class Ranked:
    """Poses with their scores."""

    poses: RigidTransform  # (K,)
    scores: Scores  # (K, C)

    def select(self, rows: NDArray[np.int64]) -> Ranked:
        """Select poses, in the given order."""
        return Ranked(self.poses[torch.from_numpy(rows)], self.scores.select(rows))

    def best(self, count: int) -> Ranked:
        """Select the best poses, in order."""
        return self.select(np.argsort(-self.scores.total, kind="stable")[:count])

    def choose_better(self, other: Ranked) -> Ranked:
        """Choose the better pose of each pair from two equally long sets."""
        count = len(self.poses.rotation)
        take = np.where(other.scores.total > self.scores.total, count, 0)
        return (self + other).select(take + np.arange(count))

    def __add__(self, other: Ranked) -> Ranked:
        return Ranked(RigidTransform.cat([self.poses, other.poses]), self.scores + other.scores)


@dataclass(frozen=True)
class Matcher:
    """Match the object with maps of one scale."""

    scene: Scene
    maps: Maps
    gain: NDArray[np.float32]  # (C, H, W)
    reach: NDArray[np.float64]  # (C,) pixels, largest shift of each image

    @classmethod
    def on(cls, scene: Scene, maps: Maps, reach: NDArray[np.float64]) -> Matcher:
        """Prepare maps."""
        return cls(scene, maps, gains(maps), reach)

    def rank(self, poses: RigidTransform) -> Ranked:
        """Score poses (K,), keeping their order."""
        return Ranked(poses, correlate(self.maps, self.gain, self.scene.rig, self.scene.obj, poses, self.reach))

    def climb(self, found: Ranked, steps: Sequence[float] = CLIMBS) -> Ranked:
        """Rotate and move each pose to where it fits best: (K,), keeping their order."""
        turns = _axes(found.poses.rotation)
        for step in steps:
            found = found.choose_better(self.rank(move_object(found, self.scene)))
            count = len(found.poses.rotation)
            tried = found.poses[torch.arange(count).repeat(len(turns))]
            scored = self.rank(turn_object(tried, step * turns.repeat_interleave(count, 0), self.scene.obj))
            best = scored.scores.total.reshape(len(turns), count).argmax(0)
            found = found.choose_better(scored.select(best * count + np.arange(count)))
        return found.choose_better(self.rank(move_object(found, self.scene)))


def turns_around(pose: RigidTransform, obj: CalibrationObject) -> RigidTransform:
    """Rotate a pose about the object's centre in all directions, the smallest rotations first: (K,)."""
    steps = np.arange(-NEAR, NEAR + 1e-9, STEP)
    vectors = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    size = np.linalg.norm(vectors, axis=1)
    vectors = vectors[np.argsort(size, kind="stable")][: int((size <= NEAR).sum())]
    vectors = np.concatenate((np.zeros((1, 3)), vectors))
    return turn_object(pose, torch.from_numpy(vectors).to(pose.rotation), obj)


def turn_object(poses: RigidTransform, vectors: Tensor, obj: CalibrationObject) -> RigidTransform:
    """Rotate the object in poses (K,) about its centre by rotation vectors (K, 3) or (3,), in the object's axes."""
    rotation = poses.rotation @ rotation_from_vector(vectors)
    centre = obj.points.mean(0).to(rotation)
    place = poses.rotation @ centre + poses.translation
    return RigidTransform(rotation, place - rotation @ centre)


def move_object(found: Ranked, scene: Scene) -> RigidTransform:
    """Move the object to where most cameras see it, after allowing for drift in their image shifts."""
    rotation = found.poses.rotation
    centre = scene.obj.points.mean(0).to(rotation)
    places = rotation @ centre + found.poses.translation  # (K, 3)
    offsets = torch.cat((torch.zeros(1, 3), torch.eye(3))).to(rotation)
    count = len(places)
    uv = scene.rig.expand(count).project_values(places[:, None] + offsets).uv  # (K, C, 4, 2)
    slope = (uv[:, :, 1:] - uv[:, :, :1]).mT.nan_to_num()  # (K, C, 2, 3) pixels per mm
    sure = torch.from_numpy(found.scores.log_odds > 3.0)
    weight = torch.where(sure, 1 / torch.from_numpy(scene.drift).square(), 0.0)[..., None, None]
    normal = (slope.mT @ slope * weight).sum(1) + torch.eye(3).to(slope) / OFF**2
    right = (slope.mT @ torch.from_numpy(found.scores.shift)[..., None] * weight).sum(1)
    step = torch.linalg.solve(normal, right)[..., 0]
    return RigidTransform(rotation, places + step - rotation @ centre)


@lru_cache(maxsize=8)
def all_turns(count: int) -> NDArray[np.float64]:
    """Sample rotations uniformly: (count, 3, 3).

    Source: Alexa 2022, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)".
    """
    s = np.arange(count) + 0.5
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    r, big = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.stack((r * np.sin(alpha), r * np.cos(alpha), big * np.sin(beta), big * np.cos(beta)), axis=1)
    return Rotation.from_quat(quaternions).as_matrix()


def distinct_turns(obj: CalibrationObject, count: int) -> NDArray[np.float64]:
    """Sample rotations uniformly, without equivalent ones of a symmetric object: about (count / order, 3, 3)."""
    turns = all_turns(count)
    if len(obj.symmetries) == 1:
        return turns
    alike = np.stack([motion.rotation for motion in obj.symmetries])
    # Of equivalent rotations, keep the one with the smallest angle, which has the largest trace.
    traces = np.einsum("kij,gji->gk", turns, alike)
    return turns[traces[0] >= traces.max(0) - 1e-9] if len(alike) else turns


def search_one_camera(matcher: Matcher, camera: int, turns: NDArray[np.float64], count: int) -> RigidTransform:
    """Search for the object in the whole image of one camera, at the usual distance: the best poses (count,).

    Args:
        matcher: on coarse maps.
        camera: index of the camera.
        turns: (K, 3, 3) rotations of the object relative to that camera.
        count: number of poses to return.
    """
    scene = matcher.scene
    alone = Matcher(
        Scene(scene.rig.select([camera]), scene.obj, scene.std[[camera]], scene.distance),
        matcher.maps.select([camera]),
        matcher.gain[[camera]],
        np.full(1, matcher.maps.factor * matcher.maps.size[camera].max() / 2),
    )
    cam_from_rig = scene.rig.cam_from_rig[camera]
    # Start in the centre of the image, at the usual distance; the shift corrects the direction.
    lens = scene.rig.select([camera])
    middle = (lens.image_size[0].to(lens.focal_length) / 2 - lens.principal_point[0]) / lens.focal_length[0]
    ray = torch.cat((middle, middle.new_ones(1)))
    place = ray * (scene.distance / ray.norm())
    centre = scene.obj.points.mean(0).to(place)
    rotation = torch.from_numpy(turns).to(place)
    cam_from_object = RigidTransform(rotation, place - rotation @ centre)
    inverse = cam_from_rig.inverse()
    found = alone.rank(inverse @ cam_from_object)
    best = np.argsort(-found.scores.total, kind="stable")[:count]
    shift = torch.from_numpy(found.scores.shift[best, 0])
    ray = torch.cat((middle + shift / lens.focal_length[0], middle.new_ones(count, 1)), dim=1)
    place = ray * (scene.distance / ray.norm(dim=1, keepdim=True))
    # Away from the centre, the object is seen from another side.
    straight = torch.cat((middle, middle.new_ones(1))).expand(count, 3)
    rotation = _smallest_rotations(straight, ray) @ rotation[torch.from_numpy(best)]
    return inverse @ RigidTransform(rotation, place - rotation @ centre)


def _smallest_rotations(first: Tensor, second: Tensor) -> Tensor:
    """Smallest rotations that take directions (K, 3) to others: (K, 3, 3)."""
    a, b = (x / x.norm(dim=-1, keepdim=True) for x in (first, second))
    axis = torch.linalg.cross(a, b)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (a * b).sum(-1, keepdim=True))
    return rotation_from_vector(axis / sine.clamp_min(1e-12) * angle)


def _axes(like: Tensor) -> Tensor:
    """Both directions of the three axes: (6, 3)."""
    return torch.cat((torch.eye(3), -torch.eye(3))).to(like)

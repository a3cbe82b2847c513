"""Find which blobs of a snapshot show the same light, and cameras that see the lights in the wrong place.

A camera that was bumped no longer agrees with the light positions that the other cameras agree on: all its blobs are
shifted alike. The search is for the shift with which most of them fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Lights, associate_lights, undistort
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.messages import plural
from imgcal.online.camera_visibility import well_inside
from imgcal.online.keeper_memory import KeeperMemory
from imgcal.online.label_consistency import MOST_APART, Checked
from imgcal.online.light_points import FoundLights, distance_errors
from imgcal.online.light_tracks import LightTracks
from imgcal.online.shape_labels import LightDistances, find_shapes
from imgcal.types import CameraRig, Detections

Array = NDArray[np.float64]

LEAST_MARGIN = 5.0
"""Log odds of a light against the best other light that uses one of its blobs."""
FAR_SECONDS, FAR_BLOBS = 2.0, 3
"""Seconds, and number of blobs away from all lights, after which a camera may be reported to have moved far."""
WINDOW = 60.0
"""Maximum image shift (px) in the search."""
ALIKE, STRETCH = 1.5, 0.1
"""Distance (px, and share of the shift) allowed between a blob and its light after the shift is undone."""
FOLLOWED = 3.0
"""Radius (px) around a camera's last shift that is searched first."""
WENT, TOGETHER = 20.0, 3
"""Distance (px) that lights must move in the image while their shift stays the same, or number of lights that it must
fit together; otherwise a fit may be chance."""
LEAST_FITTING = 0.5
"""Share of the visible lights that must fit without a shift; otherwise a shift is searched for."""


def label_lights(memory: KeeperMemory, tracks: LightTracks, blobs: Detections) -> tuple[Checked, frozenset[int]]:
    """Label the blobs of a snapshot with the numbers of their lights; markers of known objects have their own.

    Args:
        memory: what is known about the rig.
        tracks: the tracked lights; updated.
        blobs: of one snapshot; their labels are ignored.

    Returns:
        The labels, and the cameras that see blobs where no light is, at any shift of their image.

    Raises:
        RefusedError: no three cameras agree on a light.
    """
    rig, time = memory.belief.rig, memory.time
    error = np.hypot(memory.options.identity_error, memory.noise.additive)
    moving = ~tracks.is_still(blobs.camera, blobs.uv)
    rows = np.flatnonzero(moving)
    found = associate_lights(blobs.select(rows), rig, error)
    found = found.select((found.margin >= LEAST_MARGIN) & (found.cameras >= 3))
    found = found.select(np.argsort(-found.cameras, kind="stable"))
    if not len(found):
        tracks.mark_still(blobs.camera, blobs.uv, np.zeros(len(blobs), dtype=bool), time)
        some = len(np.unique(blobs.camera[rows]))
        seen = f"moving blobs are seen by {plural(some, 'camera')}" if some else "no moving blob is seen"
        raise RefusedError(f"identity: found no light on which three cameras agree: {seen}")
    earlier = tracks.place.copy()
    numbers = tracks.number_lights(found.point, time)
    scene = _Scene(rig, blobs, found, rows)
    lights = FoundLights(blobs, scene.label.copy(), found.point)  # also those that are more than a rig learns from
    if memory.obj.known_parts:
        numbers = _number_shapes(memory, lights, numbers, np.where(np.isfinite(tracks.velocity), earlier, np.nan))
    tracks.mark_still(blobs.camera, blobs.uv, scene.label >= 0, time)
    usual, sought = scene.usual_shift(), scene.misfits()
    lost, off = np.zeros((2, rig.num_cameras), dtype=bool)
    for camera in sought:
        found_at = scene.find_shift(camera, tracks.shift[camera])
        if found_at is None:
            lost[camera] = scene.bare(camera) >= FAR_BLOBS
            continue
        shift, labels = found_at
        middle = scene.expected[camera, labels[labels >= 0]].mean(0)
        followed = np.linalg.norm(shift - tracks.shift[camera]) < FOLLOWED
        if not followed:
            tracks.shift_at[camera] = middle
        tracks.shift[camera] = shift
        together = (labels >= 0).sum() >= TOGETHER
        if followed and (together or np.linalg.norm(middle - tracks.shift_at[camera]) >= WENT):
            scene.label[blobs.camera == camera] = labels
            off[camera] = np.linalg.norm(shift) > memory.options.identity_error + MOST_APART * usual
    fits = np.bincount(blobs.camera[scene.label >= 0], minlength=len(off)) > 0
    fits[sought] = False
    tracks.shift[fits] = 0.0
    tracks.astray = np.where(lost, np.where(tracks.astray <= time, tracks.astray, time), np.nan)
    astray = frozenset(np.flatnonzero(time - tracks.astray >= FAR_SECONDS).tolist())
    named = np.where(scene.label >= 0, numbers[scene.label], -1)
    place = np.full((memory.obj.num_fiducials, 3), np.nan)
    place[numbers[numbers >= 0]] = found.point[numbers >= 0]
    pose = RigidTransform(torch.eye(3, dtype=torch.float64).expand(1, len(place), 3, 3), torch.from_numpy(place)[None])
    labelled = replace(blobs, fiducial=named)
    return Checked(labelled, labelled, pose, off, usual, int((named >= 0).sum()), lights), astray


def _number_shapes(
    memory: KeeperMemory, lights: FoundLights, tracked: NDArray[np.int64], earlier: Array
) -> NDArray[np.int64]:
    """Number the lights (L,) that are markers of known objects; others go behind these.

    Args:
        memory: what is known about the rig.
        lights: of the snapshot.
        tracked: (L,) their numbers from snapshot to snapshot; -1 = none.
        earlier: (N, 3) mm, where each number was in the previous snapshot; nan = nowhere.
    """
    parts = memory.obj.known_parts
    error = distance_errors(memory.belief, lights, memory.noise.additive)
    before = np.where((tracked >= 0)[:, None], earlier[tracked], np.nan)
    found = find_shapes(parts, LightDistances(lights.point, before, error))
    count = sum(len(points) for _, points in parts)
    return np.where(found >= 0, found, np.where(tracked >= 0, tracked + count, -1))


class _Scene:
    """A snapshot: where its lights should be in every camera, and which blobs are labelled."""

    def __init__(self, rig: CameraRig, blobs: Detections, lights: Lights, rows: NDArray[np.int64]) -> None:
        """Start with the lights found among some rows of the blobs."""
        self.camera, self.count = blobs.camera, len(lights)
        self.straight = np.full((len(blobs), 2), np.nan)  # (M, 2) px without distortion; nan = no light
        usable = rows[blobs.usable[rows]]
        self.straight[usable] = undistort(blobs.uv[usable], blobs.camera[usable], rig)
        self.straight[~np.isfinite(self.straight).all(1)] = np.nan
        self.label = np.full(len(blobs), -1, dtype=np.int64)  # (M,) number among the lights
        light, camera = np.nonzero(lights.row >= 0)
        self.label[rows[lights.row[light, camera]]] = light
        points = torch.from_numpy(lights.point)
        in_camera = rig.cam_from_rig.apply(points).numpy()  # (C, L, 3)
        focal = rig.focal_length.mean(-1).numpy()[:, None, None]
        depth = np.where(in_camera[..., 2:] > 1.0, in_camera[..., 2:], np.nan)
        self.expected = focal * in_camera[..., :2] / depth  # (C, L, 2) px without distortion
        uv = rig.project_values(points).uv.numpy()
        self.inside = well_inside(np.where(np.isfinite(self.expected), uv, np.nan), rig)

    def bare(self, camera: int) -> int:
        """Number of a camera's blobs that may be lights but have no label."""
        return int(((self.camera == camera) & (self.label < 0) & np.isfinite(self.straight[:, 0])).sum())

    def usual_shift(self) -> float:
        """Median image shift (px) of all cameras; smaller shifts are left to the filter."""
        rows = np.flatnonzero(self.label >= 0)
        camera = self.camera[rows]
        rest = self.straight[rows] - self.expected[camera, self.label[rows]]
        count = np.bincount(camera, minlength=len(self.expected))
        shift = np.stack([np.bincount(camera, rest[:, axis], len(count)) for axis in (0, 1)], -1)
        return float(np.median(np.linalg.norm(shift[count > 0], axis=-1) / count[count > 0]))

    def misfits(self) -> list[int]:
        """Cameras that, given their blobs, show fewer lights than they should."""
        cameras = len(self.expected)
        labelled = np.bincount(self.camera[self.label >= 0], minlength=cameras)
        bare = np.array([self.bare(camera) for camera in range(cameras)])
        could = np.minimum(self.inside.sum(1), labelled + bare)
        return np.flatnonzero((labelled < LEAST_FITTING * could) & (bare > 0)).tolist()

    def find_shift(self, camera: int, last: Array) -> tuple[Array, NDArray[np.int64]] | None:
        """Find the shift (2,) px with which most blobs of a camera are lights, and those blobs; None = there is none.

        Lights that depend on this camera are left out unless two others agree on them. The shift must fit more lights
        than any other, or be close to the last one.
        """
        rows = np.flatnonzero((self.camera == camera) & np.isfinite(self.straight[:, 0]))
        others = np.bincount(self.label[(self.label >= 0) & (self.camera != camera)], minlength=self.count)
        lights = np.flatnonzero((others >= 3) & np.isfinite(self.expected[camera, :, 0]))
        if not len(rows) or not len(lights):
            return None
        way = self.straight[rows][:, None] - self.expected[camera, lights]  # (B, L, 2)
        tried = way.reshape(-1, 2)
        size = np.linalg.norm(tried, axis=1)
        tried = tried[size < WINDOW]
        if not len(tried):
            return None
        followed = bool(last.any()) and bool((np.linalg.norm(tried - last, axis=1) < FOLLOWED).any())
        if followed:
            tried = tried[np.linalg.norm(tried - last, axis=1) < FOLLOWED]
        reach = ALIKE + STRETCH * np.linalg.norm(tried, axis=1)
        near = np.linalg.norm(way[None] - tried[:, None, None], axis=-1) < reach[:, None, None]  # (T, B, L)
        count = np.minimum(near.any(1).sum(1), near.any(2).sum(1))
        best = int(count.argmax())
        apart = np.linalg.norm(tried - tried[best], axis=1) > 2 * reach[best]
        inside = int(self.inside[camera, lights].sum())
        if not followed and (apart & (count >= count[best])).any():
            return None
        if count[best] < max(1, min(2, inside, len(rows))):
            return None
        shift = np.median(way[near[best]], axis=0)
        distance = np.linalg.norm(way - shift, axis=-1)
        labels = np.full(int((self.camera == camera).sum()), -1, dtype=np.int64)
        mine = np.searchsorted(np.flatnonzero(self.camera == camera), rows)
        for b, light in enumerate(distance.argmin(1).tolist()):
            if distance[b, light] < reach[best] and distance[:, light].argmin() == b:
                labels[mine[b]] = lights[light]
        return shift, labels

"""Place cameras anew that have turned far: linear steps from the old pose do not lead there.

From a pose that is off by more than 90 degrees, they lead to a negative focal length, whose image is that of a camera
turned by 180 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from imgcal.estimation import has_poses, initial_pose
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.monitoring.case import Snapshot
from imgcal.monitoring.rig_belief import RigBelief
from imgcal.types import CalibrationObject, CameraRig, Observations

FAR_TURN = math.radians(30.0)
"""Rotation from which on a change is not linear. What else has changed cannot be told then: in an image that is read
upside down, the principal point is mirrored, too."""
LARGEST_SHARE = 0.1
"""Largest median distance of the blobs from their fiducials in a new pose, as a share of that in the old one."""


def have_turned_far(rig: CameraRig, other: CameraRig) -> Tensor:
    """Tell which cameras are turned far from their poses in another rig: (C,) bool."""
    return geodesic_angle(rig.cam_from_rig.rotation, other.cam_from_rig.rotation) > FAR_TURN


def place_cameras(belief: RigBelief, rig: CameraRig, cameras: Collection[int]) -> RigBelief:
    """Move those of some cameras that are turned far in another rig to their poses there; what is known stays."""
    far = have_turned_far(belief.rig, rig)
    chosen = [camera for camera in cameras if bool(far[camera])]
    if not chosen:
        return belief
    poses, there = belief.rig.cam_from_rig, rig.cam_from_rig
    rotation, translation = poses.rotation.clone(), poses.translation.clone()
    rotation[chosen], translation[chosen] = there.rotation[chosen], there.translation[chosen]
    return replace(belief, rig=replace(belief.rig, cam_from_rig=RigidTransform(rotation, translation)))


def resect_cameras(belief: RigBelief, snapshots: Sequence[Snapshot], cameras: Collection[int]) -> CameraRig:
    """Find the poses of cameras by their labels in some snapshots, with the object's poses there.

    Args:
        belief: its rig gives the lenses, and all other poses.
        snapshots: the labels, and poses by the other cameras.
        cameras: those to place. One whose labels do not determine a pose, or agree with none, keeps its own.

    Returns:
        The rig with these poses.
    """
    rig, poses = belief.rig, belief.rig.cam_from_rig
    rotation, translation = poses.rotation.clone(), poses.translation.clone()
    for camera in cameras if snapshots else ():
        shown = [(one.seen[0, camera], one.uv[0, camera], belief.points_at(pose)[0]) for one, pose in snapshots]
        cloud = torch.cat([points[seen] for seen, _, points in shown])
        uv = torch.cat([uv[seen] for seen, uv, _ in shown]).double()
        every = torch.ones(1, 1, len(cloud), dtype=torch.bool)
        if not bool(cloud.isfinite().all()) or not has_poses(every.numpy(), cloud)[0]:
            continue
        alone = rig.select([camera])
        observations = Observations(uv[None, None], torch.ones_like(uv[None, None, :, 0]), every)
        pose = initial_pose(observations, alone, CalibrationObject(cloud, torch.ones_like(cloud)))
        placed = replace(alone, cam_from_rig=alone.cam_from_rig @ pose)
        off = _distance(placed, cloud, uv)
        if math.isfinite(off) and off <= LARGEST_SHARE * _distance(alone, cloud, uv):
            rotation[camera], translation[camera] = placed.cam_from_rig.rotation[0], placed.cam_from_rig.translation[0]
    return replace(rig, cam_from_rig=RigidTransform(rotation, translation))


def far_turned_cameras(belief: RigBelief, snapshots: Sequence[Snapshot], cameras: Collection[int]) -> set[int]:
    """Find the cameras, out of some, that some snapshots show turned far from their poses; see `resect_cameras`."""
    placed = resect_cameras(belief, snapshots, cameras)
    return set(have_turned_far(belief.rig, placed).nonzero().flatten().tolist())


def _distance(camera: CameraRig, cloud: Tensor, uv: Tensor) -> float:
    """Median distance (px) of blobs (P, 2) from the images of points (P, 3); infinite if most are behind the camera."""
    projection = camera.project(cloud)
    off = (projection.uv[0] - uv).norm(dim=-1)
    return float(torch.where((projection.depth[0] > 0) & off.isfinite(), off, torch.inf).median())

"""Resolve the orientation of a symmetric object by a given pose, if one is near enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from imgcal.association.result import Identity
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.types import CalibrationObject

CLEAR = 0.5
"""Maximum ratio of the angles of the nearest and the second nearest orientation for a given pose to decide."""


def orient(identity: Identity, obj: CalibrationObject, given: RigidTransform) -> Identity:
    """Choose, among the labellings that the object's symmetry allows, the one whose orientation is nearest to a given
    pose.

    Args:
        identity: accepted.
        obj: the calibration object.
        given: approximate rig_from_object of this snapshot; all these labellings have the same centre, so only its
            rotation counts.

    Returns:
        `by_prior` if one is clearly nearest, otherwise unchanged: `ambiguous`.
    """
    pose = identity.rig_from_object
    assert pose is not None  # an accepted identity has one
    turns = torch.stack([torch.from_numpy(motion.rotation) for motion in obj.symmetries]).to(pose.rotation)
    angle = geodesic_angle(pose.rotation @ turns.mT, given.rotation.to(pose.rotation)).numpy()
    order = np.argsort(angle, kind="stable")
    if len(order) > 1 and angle[order[0]] > CLEAR * angle[order[1]]:
        return replace(identity, status="ambiguous", alternatives=len(order))
    motion = obj.symmetries[order[0]]
    rotation = pose.rotation @ turns[order[0]].mT
    shift = rotation @ torch.from_numpy(motion.translation).to(rotation)
    return replace(
        identity,
        labels=np.append(motion.permutation, -1)[identity.labels],
        rig_from_object=RigidTransform(rotation, pose.translation - shift),
        status="by_prior",
        alternatives=1,
    )

"""Which way round an object is that can be turned into itself: a pose that was given decides, if it is near one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from imgcal.association.result import Identity
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.types import CalibrationObject

CLEAR = 0.5
"""Part of the second nearest turn's angle that the nearest one must not exceed for a given pose to decide."""


def orient(identity: Identity, obj: CalibrationObject, given: RigidTransform) -> Identity:
    """Choose, of the labellings that the object's symmetry allows, the one whose turn is nearest to a given pose.

    Args:
        identity: accepted.
        obj: the calibration object.
        given: rig_from_object of this snapshot, roughly; all these labellings have the same centre, so only its
            rotation counts.

    Returns:
        `by_prior` where one is clearly nearest, else as it was: `ambiguous`.
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

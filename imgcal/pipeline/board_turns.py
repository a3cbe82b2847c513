"""Resolve the orientation of a symmetric board: all cameras of a snapshot must agree on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from imgcal.association import to_observations
from imgcal.errors import RefusedError
from imgcal.estimation import single_camera_poses
from imgcal.types import CalibrationObject, CameraRig, Detections


def settle_turns(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Detections:
    """Turn the labels of each camera so that all cameras of a snapshot agree on the board's orientation.

    Which orientation that is does not matter for the rig. The first camera's is used, and the others follow by the
    factory rig, which knows the cameras' directions far better than half a turn.

    Args:
        detections: points of a board, with an arbitrary orientation in each image.
        rig: what is known before.
        obj: the object; one without a board, or whose images show its orientation, is left alone.
    """
    if obj.board is None or len(obj.board.turns) == 1 or rig.num_cameras == 1:
        return detections
    cam_from_object, known = single_camera_poses(to_observations(detections, rig, obj), rig, obj)
    rotation = rig.cam_from_rig.rotation.double().mT @ cam_from_object.rotation.double()  # board in the rig frame
    fiducial = detections.fiducial.copy()
    angles = [angle for angle, _ in obj.board.turns]
    for row, snapshot in enumerate(np.unique(detections.snapshot)):
        cameras = np.flatnonzero(known[row])
        for camera in cameras[1:].tolist():
            between = rotation[row, cameras[0]].mT @ rotation[row, camera]
            turn = float(torch.atan2(between[1, 0], between[0, 0]))
            away = [abs(np.angle(np.exp(1j * (turn - angle)))) for angle in angles]
            motion = obj.board.turns[int(np.argmin(away))][1]
            rows = (detections.snapshot == snapshot) & (detections.camera == camera) & (fiducial >= 0)
            fiducial[rows] = motion[fiducial[rows]]
    return replace(detections, fiducial=fiducial)


def require_one_turn(cameras: CameraRig, obj: CalibrationObject) -> None:
    """Raise `RefusedError` if the board's orientation in several cameras cannot be made consistent."""
    if obj.board is not None and len(obj.board.turns) > 1 and cameras.num_cameras > 1:
        raise RefusedError(
            f"object: a {obj.board} looks the same when turned, so without a factory calibration its points cannot be "
            "matched between cameras: use a ChArUco board, or one with an even and an odd number of squares"
        )

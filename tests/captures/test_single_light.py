"""One real light in front of five cameras with rough focal lengths calibrates as well as careful adjustment."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.io import load_detections
from imgcal.pipeline import calibrate_from_scratch, rms_length, score
from imgcal.types import CalibrationObject, CameraRig, RigPrior

ODD_FITTED, MOST_PX = 1, 0.23
"""Snapshots that are fitted; RMS of the others: a careful adjustment by hand has 0.228, what was published 0.326."""


LIGHT = CalibrationObject(torch.zeros(1, 3).double(), torch.ones(1, 3), name="light")


def rough_cameras(names):
    count = len(names)
    return CameraRig(
        focal_length=torch.full((count, 2), 1200.0).double(),
        principal_point=torch.tensor([327.5, 245.0]).double().expand(count, 2).clone(),
        distortion=torch.zeros(count, 5).double(),
        cam_from_rig=RigidTransform.identity(count, dtype=torch.float64),
        image_size=torch.tensor([656, 491]).expand(count, 2).clone(),
        camera_names=names,
        name="five",
        prior=RigPrior(0.15, 25.0, 0.1),
    )


def every_other(blobs, rest):
    kept = blobs.select(blobs.snapshot % 2 == rest)
    numbers, snapshot = np.unique(kept.snapshot, return_inverse=True)
    return replace(kept, snapshot=snapshot, snapshot_names=tuple(kept.snapshot_names[n] for n in numbers))


def test_a_light_calibrates_five_cameras_from_nothing(captures):
    blobs = load_detections(captures / "single-light-five-cameras" / "detections.csv")
    found = calibrate_from_scratch(every_other(blobs, ODD_FITTED), rough_cameras(blobs.camera_names), LIGHT)
    assert found.scale.source == "none"
    held_out = every_other(blobs, 1 - ODD_FITTED)
    every = replace(held_out, fiducial=np.zeros(len(held_out), dtype=int))  # each blob counts, however far off it is
    scored = score(every, found.rig, LIGHT)
    seen = scored.seen & (scored.seen.sum(1, keepdim=True) >= 3)
    assert int(seen.sum()) > 1050
    assert rms_length(scored.residual, seen) < MOST_PX


def test_a_focal_length_that_four_cameras_leave_open_is_the_reason_for_refusing(captures):
    blobs = every_other(load_detections(captures / "single-light-five-cameras" / "detections.csv"), ODD_FITTED)
    names = tuple(name for number, name in enumerate(blobs.camera_names) if number != 3)
    rest = blobs.select(blobs.camera != 3)
    rest = replace(rest, camera=rest.camera - (rest.camera > 3), camera_names=names)
    with pytest.raises(RefusedError, match="the data say too little about the focal length of camera cam5_0"):
        calibrate_from_scratch(rest, rough_cameras(names), LIGHT)

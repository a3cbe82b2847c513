"""Values out of a state file whose arrays do not belong together are refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.online.state_checks import CHECKS
from imgcal.types import CameraRig, Detections, Observations

RIG, OBJ = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
POSE = RigidTransform(torch.eye(3).double().expand(2, 3, 3), torch.zeros(2, 3).double())


def belief(**changes) -> RigBelief:
    return replace(RigBelief.of_prior(RIG, OBJ), **changes)


def seen(**changes) -> Observations:
    made = Observations(torch.zeros(1, 4, 8, 2).double(), torch.ones(1, 4, 8).double(), torch.ones(1, 4, 8).bool())
    vars(made).update(changes)
    return made


def blobs(**changes) -> Detections:
    of_row = {name: np.zeros(3, dtype=np.int64) for name in ("camera", "snapshot", "fiducial")}
    made = Detections(
        np.zeros((3, 2)), np.ones(3), **of_row, radius=np.ones(3), flags=np.zeros(3, dtype=np.uint8),
        camera_names=("a",), snapshot_names=("s",),
    )  # fmt: skip
    vars(made).update(changes)
    return made


def test_what_belongs_together_is_taken() -> None:
    for value in (RIG, OBJ, POSE, belief(), seen(), blobs()):
        CHECKS[type(value)](value)


def narrow(rig: CameraRig) -> CameraRig:
    """With one camera fewer in one array."""
    return replace(rig, focal_length=rig.focal_length[:3])


@pytest.mark.parametrize(
    "value",
    [
        narrow(RIG),
        replace(RIG, focal_length=-RIG.focal_length),
        replace(OBJ, points=OBJ.points * 1e30),
        RigidTransform(POSE.rotation, POSE.translation[:1]),
        RigidTransform(POSE.rotation[..., :2], POSE.translation),
        belief(unit=torch.ones(3, 15)),
        belief(object_offset=torch.zeros(25)),
        belief(factor=torch.zeros(60, 60).double()),
        belief(factor=torch.full((60, 60), torch.nan).double()),
        belief(factor=torch.eye(61).double()),
        belief(rig=imgcal.load_rig("U7")),
        seen(uv=torch.zeros(1, 4, 7, 2)),
        seen(seen=torch.ones(1, 4, 8)),
        seen(sigma=torch.ones(1, 4)),
        blobs(uv=np.zeros((4, 2))),
        blobs(sigma=np.ones(2)),
        blobs(camera=np.full(3, 1)),
        blobs(fiducial=np.full(3, -2)),
    ],
)
def test_what_does_not_belong_together_is_refused(value) -> None:
    with pytest.raises((ValueError, InputError)):
        CHECKS[type(value)](value)

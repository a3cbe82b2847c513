"""Motion in a state is free of a motion of the whole rig, and so is its standard deviation."""

import re
from pathlib import Path
from typing import get_args

import numpy as np
import torch

import imgcal
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.monitoring import RigBelief
from imgcal.online import CameraHealth, RigState
from imgcal.types import Detections


def state(rig: imgcal.CameraRig, belief: RigBelief) -> RigState:
    none = np.zeros(0, dtype=np.int64)
    blobs = Detections(
        np.zeros((0, 2)), np.zeros(0), none, none, none, np.zeros(0), np.zeros(0, np.uint8), rig.camera_names, ("0",)
    )  # fmt: skip
    empty = np.full((rig.num_cameras, 8, 2), np.nan)
    values = belief, rig, {}, "", None, blobs, np.zeros((len(blobs), 2)), empty, empty[:, 0, 0], None, ()
    return RigState(0.0, 0, *values, *5 * (empty[:, 0, 0],))


def test_a_motion_of_the_whole_rig_is_none() -> None:
    factory, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    turn = rotation_from_vector(torch.tensor([[0.02, -0.01, 0.03]], dtype=torch.float64))
    whole = RigidTransform(turn, torch.tensor([[5.0, -3.0, 2.0]], dtype=torch.float64))
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[2, 0] = 0.01
    moved = factory.retract(step)
    moved = moved.__class__(**{**vars(moved), "cam_from_rig": moved.cam_from_rig @ whole})
    made = state(factory, RigBelief.of_prior(moved, obj))
    torch.testing.assert_close(made.moved, step, atol=1e-4, rtol=0)
    assert made.rig is made.belief.rig


def test_standard_deviations_leave_out_what_all_cameras_share() -> None:
    factory, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    made = state(factory, RigBelief.of_prior(factory, obj))
    absolute = made.belief.std()
    torch.testing.assert_close(made.std[:, 6:], absolute[:, 6:])
    assert (made.std[:, :6] < 1.2 * absolute[:, :6]).all()
    assert (made.std[:, :6] > 0.5 * absolute[:, :6]).all()


def test_the_documents_and_the_class_say_what_every_state_of_a_camera_means():
    text = (Path(__file__).parents[3] / "docs" / "live.md").read_text()
    text = text.partition("`state.cameras[name]`")[2].partition("| event |")[0]
    rows = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    assert set(rows) == set(get_args(CameraHealth)) and len(rows) == len(set(rows))

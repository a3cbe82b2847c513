"""Rigs and objects in metres are noticed; those that ship are not."""

from dataclasses import replace

import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, load_rig
from imgcal.pipeline import calibrate
from imgcal.pipeline.units import unit_doubt
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections

RIGS = ("O10", "O6", "U7", "T4", "room10")


def in_metres(rig):
    motion = RigidTransform(rig.cam_from_rig.rotation, rig.cam_from_rig.translation / 1000)
    distance = rig.working_distance and rig.working_distance / 1000
    return replace(rig, cam_from_rig=motion, working_distance=distance)


def object_in_metres(obj):
    return replace(obj, points=obj.points / 1000, radius=None if obj.radius is None else obj.radius / 1000)


@pytest.mark.parametrize("distance_known", [True, False])
@pytest.mark.parametrize("name", RIGS)
def test_which_one_is_in_metres_is_said(name, distance_known):
    rig, obj = load_rig(name), load_object("asymmetric8")
    rig = rig if distance_known else replace(rig, working_distance=None)
    assert unit_doubt(rig, obj) == ""
    assert unit_doubt(in_metres(rig), obj).startswith("the rig seems to be in metres")
    assert unit_doubt(rig, object_in_metres(obj)).startswith("the object seems to be in metres")
    assert unit_doubt(in_metres(rig), object_in_metres(obj)).startswith("rig and object seem to be in metres")


@pytest.mark.parametrize("name", ["cube27", "sphere64", "wand4"])
def test_all_objects_that_ship_are_in_millimetres(name):
    assert not any(unit_doubt(load_rig(rig), load_object(name)) for rig in RIGS)


def test_a_small_board_close_to_one_camera_is_no_doubt():
    rig = replace(load_rig("T4"), working_distance=60.0)
    obj = load_object("asymmetric8")
    assert unit_doubt(rig, replace(obj, points=obj.points / 40)) == ""
    assert unit_doubt(replace(load_rig("T4"), working_distance=None).select([0]), obj) == ""


def test_a_refusal_begins_with_the_unit():
    rig, obj = load_rig("T4"), load_object("asymmetric8")
    blobs = true_detections(simulate_truth(rig, obj, 2, torch.Generator().manual_seed(0), PhysicalDrift()))
    blobs = replace(blobs, fiducial=blobs.fiducial * 0 - 1)
    with pytest.raises(RefusedError, match=r"^the rig seems to be in metres.*; so "):
        calibrate(blobs, in_metres(rig), obj)

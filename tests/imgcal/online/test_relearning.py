"""Reports about a camera that moved, and when it is known again."""

import math

import pytest
import torch

import imgcal
from imgcal.monitoring import Change, RigBelief, widen
from imgcal.online.relearning import Relearning, change_sigma, relative_std


def test_a_camera_is_known_again_when_it_is_known_as_well_as_before() -> None:
    rig, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    known = RigBelief.of_prior(rig, obj)
    relearning = Relearning(rig.camera_names)
    first = relearning.report_change(Change(1, 0, "unknown", math.nan, math.nan), 1.0, 1.1, 4, known, rig)
    assert (first.camera, first.change, first.size, first.message) == ("cam02", "unknown", None, "cam02 moved")
    assert first.evidence is None  # JSON knows no nan
    change = Change(1, 0, "rotation", math.radians(0.3), math.radians(0.01), evidence=812.0)
    told = relearning.report_change(change, 1.0, 1.2, 8, known, rig)
    assert (told.change, told.unit, told.evidence) == ("rotation", "deg", 812.0)
    assert told.size == pytest.approx(0.3)
    assert told.message == "cam02 turned 0.3 +- 0.01 deg"
    variance = torch.zeros(4, 15, dtype=torch.float64)
    variance[1, :3] = 0.05**2
    wide = widen(known, variance)
    assert relearning.report_relearnt(wide, frozenset(), frozenset(), 1.3, 12) == []
    assert relearning.report_relearnt(known, frozenset({1}), frozenset(), 1.3, 12) == []
    (learnt,) = relearning.report_relearnt(known, frozenset(), frozenset(), 1.4, 16)
    assert (learnt.kind, learnt.camera, learnt.since, learnt.snapshot) == ("relearnt", "cam02", 1.0, 16)
    assert (learnt.size, learnt.sigma) == (told.size, told.sigma)  # the size is no better known than before
    accuracy = change_sigma(relative_std(known)[1], "rotation")
    assert learnt.message == f"cam02 turned 0.3 +- 0.01 deg; known again to +- {accuracy:.2g} deg"
    assert relearning.events == {}


def test_of_two_cameras_it_is_said_that_it_may_be_the_other() -> None:
    rig, obj = imgcal.load_rig("T4").to(torch.float64).select([0, 2]), imgcal.load_object("asymmetric8")
    change = Change(1, 0, "unknown", math.nan, math.nan)
    told = Relearning(rig.camera_names).report_change(change, 1.0, 1.1, 4, RigBelief.of_prior(rig, obj), rig)
    assert told.message == "cam03 moved, or cam01: with two cameras it is impossible to tell which"


def test_a_shift_beside_a_turn_is_reported_in_the_message() -> None:
    rig, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    change = Change(1, 0, "rotation", math.radians(5), math.radians(0.02), also=(("position", 12.34, 0.52),))
    told = Relearning(rig.camera_names).report_change(change, 1.0, 1.1, 4, RigBelief.of_prior(rig, obj), rig)
    assert told.message == "cam02 turned 5 +- 0.02 deg and was shifted by 12.3 +- 0.5 mm"
    assert (told.change, told.unit) == ("rotation", "deg")


def test_images_that_are_turned_by_180_degrees_are_named() -> None:
    rig, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[1, 2] = math.pi
    change = Change(1, 0, "rotation", math.pi, math.radians(0.02))
    known = RigBelief.of_prior(rig, obj)
    told = Relearning(rig.camera_names).report_change(change, 1.0, 1.1, 4, known, rig.retract(step))
    assert told.message == "cam02 turned 180 +- 0.02 deg: its images are turned by 180 degrees"
    step[1, 2] = math.pi / 2
    told = Relearning(rig.camera_names).report_change(change, 1.0, 1.1, 4, known, rig.retract(step))
    assert told.message == "cam02 turned 180 +- 0.02 deg"


def test_a_camera_that_may_be_anywhere_makes_no_other_one_uncertain() -> None:
    """Others were "known again" to seven degrees, as well as before."""
    rig, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    belief, variance = RigBelief.of_prior(rig, obj), torch.zeros(4, 15, dtype=torch.float64)
    variance[2, :6] = 1.0
    free, usual = (relative_std(one)[:, 0] for one in (widen(belief, variance), belief))
    others = [0, 1, 3]
    assert torch.allclose(free[others], usual[others], rtol=0.2) and float(free[2]) > 0.9

"""Values in other units than millimetres, radians and pixels are noticed; rigs and objects that ship are not."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate, score, unit_doubt
from imgcal.pipeline.units import image_doubt
from imgcal.synthesis import PhysicalDrift, simulate_truth, simulate_volume, true_detections
from imgcal.types import MovedError
from scripts.benchmarks import camera_faults as damage
from tests.imgcal.pipeline.short_search import SHORT

RIGS = ("O10", "O6", "U7", "T4", "room10")


def rig_times(factor):
    def change(rig, obj):
        motion = RigidTransform(rig.cam_from_rig.rotation, factor * rig.cam_from_rig.translation)
        distance = rig.working_distance and factor * rig.working_distance
        return replace(rig, cam_from_rig=motion, working_distance=distance), obj

    return change


def object_times(factor):
    def change(rig, obj):
        radius = None if obj.radius is None else factor * obj.radius
        return rig, replace(obj, points=factor * obj.points, radius=radius)

    return change


def rotations_in_degrees(rig, obj):
    vectors = torch.rad2deg(vector_from_rotation(rig.cam_from_rig.rotation))
    return replace(rig, cam_from_rig=RigidTransform(rotation_from_vector(vectors), rig.cam_from_rig.translation)), obj


def focal_times(factor):
    return lambda rig, obj: (replace(rig, focal_length=factor * rig.focal_length), obj)


def in_metres(rig):
    return rig_times(1e-3)(rig, None)[0]


def object_in_metres(obj):
    return object_times(1e-3)(None, obj)[1]


MISTAKES = {
    "rig in metres": (rig_times(1e-3), "the rig is .* times too small for the object, as if it were in metres"),
    "rig in centimetres": (rig_times(0.1), "the rig is .* times too small for the object, as if it were in centim"),
    "rig in inches": (rig_times(1 / 25.4), "the rig is .* times too small for the object, as if it were in inches"),
    "rig in micrometres": (rig_times(1e3), "the object is .* times too small for the rig, as if it were in metres"),
    "object in metres": (object_times(1e-3), "the object is .* times too small for the rig, as if it were in metres"),
    "object in centimetres": (object_times(0.1), "the object is .* times too small for the rig, as if it were in cent"),
    "object in inches": (object_times(1 / 25.4), "the object is .* times too small for the rig, as if it were in inch"),
    "object in micrometres": (object_times(1e3), "the rig is .* times too small for the object, as if it were in metr"),
    "rotations in degrees": (rotations_in_degrees, "(the rotations between cameras|with the rig.s rotations)"),
    "focal length in millimetres": (focal_times(0.0055), "the focal length of camera .* seems to be in millimetres"),
    "focal length as a share": (focal_times(1 / 2048), "the focal length of camera .* seems to be relative to the wid"),
}


@cache
def seen(rig, obj):
    truth = simulate_truth(rig_of(rig), load_object(obj), 6, torch.Generator().manual_seed(0), PhysicalDrift())
    blobs = true_detections(truth)
    return replace(blobs, uv=blobs.uv + 0.05 * np.random.default_rng(0).standard_normal(blobs.uv.shape))


def unlabelled(blobs, snapshots=2):
    """The first snapshots without their labels: where no pose explains them, each takes long."""
    few = replace(blobs.select(blobs.snapshot < snapshots), snapshot_names=blobs.snapshot_names[:snapshots])
    return replace(few, fiducial=np.full_like(few.fiducial, -1))


@cache
def rig_of(name):
    return read_rig(name)


# Every mistake with every rig and with every object, a third of all combinations; with and without a known distance.
CASES = [
    (rig, obj, mistake, (850.14, None)[(r if r < 2 else m) % 2])
    for r, rig in enumerate(("O10", "U7", "T4"))
    for o, obj in enumerate(("asymmetric8", "cube8", "wand4"))
    for m, mistake in enumerate(MISTAKES)
    if (r + o + m) % 3 == 0
]


@pytest.mark.parametrize(("rig", "obj", "mistake", "distance"), CASES)
def test_a_mistaken_unit_is_refused_and_named(rig, obj, mistake, distance):
    change, expected = MISTAKES[mistake]
    wrong = change(replace(rig_of(rig), working_distance=distance), load_object(obj))
    with pytest.raises(RefusedError, match=f"^{expected}.*; so "):
        calibrate(seen(rig, obj), *wrong, SHORT)


@pytest.mark.parametrize("mistake", ["rig in metres", "object in centimetres", "rotations in degrees"])
def test_a_mistaken_unit_is_named_where_no_blob_has_a_label(mistake):
    change, expected = MISTAKES[mistake]
    blobs = unlabelled(seen("T4", "asymmetric8"))
    with pytest.raises(RefusedError, match=f"^{expected}.*; .*; so "):
        calibrate(blobs, *change(rig_of("T4"), load_object("asymmetric8")), SHORT)


def test_snapshots_of_one_camera_at_the_start_hide_no_unit():
    change, expected = MISTAKES["rig in metres"]
    rig, obj = change(rig_of("T4"), load_object("asymmetric8"))
    truth = simulate_truth(rig_of("T4"), load_object("asymmetric8"), 12, torch.Generator().manual_seed(0), None)
    blobs = true_detections(truth)
    blobs = blobs.select((blobs.camera == 0) | (blobs.snapshot >= 8))
    assert re.match(expected, image_doubt(blobs, rig, obj))


@pytest.mark.parametrize("mistake", ["object in metres", "rotations in degrees", "focal length in millimetres"])
def test_a_score_names_the_unit_too(mistake):
    change, expected = MISTAKES[mistake]
    with pytest.raises(RefusedError, match=f"^{expected}.*; so "):
        score(seen("T4", "wand4"), *change(rig_of("T4"), load_object("wand4")))


def test_a_refusal_for_another_reason_names_no_unit():
    rig, obj, blobs = rig_of("T4"), load_object("asymmetric8"), seen("T4", "asymmetric8")
    exchanged = replace(blobs, camera=np.where(blobs.camera < 2, 1 - blobs.camera, blobs.camera))
    noisy = replace(blobs, uv=blobs.uv + 8 * np.random.default_rng(0).standard_normal(blobs.uv.shape))
    for wrong in (exchanged, noisy, unlabelled(noisy)):
        with pytest.raises(RefusedError, match=r"^(estimation|identity|camera)"):
            calibrate(wrong, rig, obj, SHORT)


@pytest.mark.parametrize("mistake", ["fiducials exchanged", "object mirrored", "another object", "cameras exchanged"])
def test_wrong_labels_objects_and_names_do_not_blame_the_rotations(mistake):
    rig, obj, blobs = rig_of("T4"), load_object("asymmetric8"), seen("T4", "asymmetric8")
    if mistake == "fiducials exchanged":
        blobs = replace(blobs, fiducial=np.array([3, 2, 1, 0, 4, 5, 6, 7])[blobs.fiducial])
    elif mistake == "object mirrored":
        obj = replace(obj, points=obj.points * torch.tensor([1.0, 1.0, -1.0]))
    elif mistake == "another object":
        obj = replace(obj, points=obj.points[:, [2, 1, 0]] * torch.tensor([1.0, 1.3, 1.0]))
    else:
        blobs = replace(blobs, camera=np.array([0, 3, 2, 1])[blobs.camera])
    assert image_doubt(blobs, rig, obj) == ""


@pytest.mark.parametrize("distance_known", [True, False])
@pytest.mark.parametrize("name", RIGS)
def test_which_one_is_in_metres_is_said(name, distance_known):
    rig, obj = read_rig(name), load_object("asymmetric8")
    rig = rig if distance_known else replace(rig, working_distance=None)
    assert unit_doubt(rig, obj) == ""
    assert unit_doubt(in_metres(rig), obj).startswith("the rig seems to be in metres")
    assert unit_doubt(rig, object_in_metres(obj)).startswith("the object seems to be in metres")
    assert unit_doubt(in_metres(rig), object_in_metres(obj)).startswith("rig and object seem to be in metres")
    large = object_times(1e3)(*rig_times(1e3)(rig, obj))
    assert unit_doubt(*large).startswith("rig and object seem to be in micrometres")


@pytest.mark.parametrize("name", ["cube27", "sphere64", "wand4"])
def test_all_objects_that_ship_are_in_millimetres(name):
    assert not any(unit_doubt(read_rig(rig), load_object(name)) for rig in RIGS)


def test_a_small_board_close_to_one_camera_is_no_doubt():
    rig = replace(read_rig("T4"), working_distance=60.0)
    obj = load_object("asymmetric8")
    assert unit_doubt(rig, replace(obj, points=obj.points / 40)) == ""
    assert unit_doubt(replace(read_rig("T4"), working_distance=None).select([0]), obj) == ""


def scaled(factor, rig, obj):
    return object_times(factor)(*rig_times(factor)(rig, obj))


def test_rigs_as_small_as_endoscopes_and_microscopes_are_no_doubt():
    """An endoscope sees 3 mm across from 15 mm, a microscope a tenth of that from 10 mm through a narrow field."""
    rig, obj = replace(rig_of("T4"), working_distance=15.0), load_object("asymmetric8")
    assert unit_doubt(rig, object_times(1.3 / obj.size)(rig, obj)[1]) == ""
    narrow = replace(rig, working_distance=10.0, focal_length=15 * rig.focal_length)
    assert unit_doubt(narrow, object_times(0.3 / obj.size)(rig, obj)[1]) == ""
    assert unit_doubt(narrow, load_object("lights")) == ""


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_and_an_object_both_in_inches_look_like_smaller_ones(name):
    """Images show no lengths, and a rig 25 times as small is plausible: the docs say that this is not noticed."""
    assert unit_doubt(*scaled(1 / 25.4, rig_of(name), load_object("asymmetric8"))) == ""


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_in_metres_is_noticed_where_nothing_is_known_of_the_markers(name):
    lights, doubt = load_object("lights"), "the rig seems to be in metres, expected millimetres: the markers are "
    assert unit_doubt(rig_of(name), lights) == ""
    assert unit_doubt(in_metres(rig_of(name)), lights).startswith(doubt)
    assert unit_doubt(in_metres(rig_of(name)), object_in_metres(load_object("wand4"))) != ""


def test_a_refusal_of_unknown_markers_or_a_stick_names_the_unit():
    rig, stick = rig_of("room10").select([0, 2, 5, 7]), load_object("wand4")
    few = true_detections(simulate_volume(rig, stick, 6, torch.Generator().manual_seed(0), PhysicalDrift()))
    with pytest.raises(RefusedError, match=r"^the rig seems to be in metres, .*; so unknown markers: "):
        calibrate(few, in_metres(rig), load_object("lights"))
    stick = replace(stick, points=torch.tensor([[0.0, 0, 0], [200, 0, 0], [500, 0, 0]]), colours=torch.ones(3, 3))
    stick = replace(stick, radius=None, fiducial_names=())
    blobs = true_detections(simulate_volume(rig, stick, 20, torch.Generator().manual_seed(0), PhysicalDrift()))
    with pytest.raises(RefusedError, match=r"^the object seems to be in metres, .*; so "):
        calibrate(blobs, rig, object_in_metres(stick))


def test_reflections_beside_a_body_make_no_unit_of_a_move():
    rig, obj, truth = damage.wand_in_a_room(30, 1)
    moved = damage.changed_from(truth, obj, 3, 15, lambda r: damage.turned(r, 3, 1.0))
    table = damage.blobs(moved, 1, clutter=2.0, missed=0.4)
    with pytest.raises(MovedError, match=r"^camera cam04 moved before snapshot"):
        calibrate(table, rig, obj)

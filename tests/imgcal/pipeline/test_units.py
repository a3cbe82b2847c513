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
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import MovedError
from scripts.benchmarks import camera_faults as damage
from tests.imgcal.association.stick_scenes import TRIPLE, capture

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
        calibrate(seen(rig, obj), *wrong)


@pytest.mark.parametrize("mistake", ["rig in metres", "object in centimetres", "rotations in degrees"])
def test_a_mistaken_unit_is_named_where_no_blob_has_a_label(mistake):
    change, expected = MISTAKES[mistake]
    blobs = seen("T4", "asymmetric8")
    with pytest.raises(RefusedError, match=f"^{expected}.*; so "):
        calibrate(
            replace(blobs, fiducial=np.full_like(blobs.fiducial, -1)), *change(rig_of("T4"), load_object("asymmetric8"))
        )


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
    for wrong in (exchanged, noisy, replace(noisy, fiducial=np.full_like(noisy.fiducial, -1))):
        with pytest.raises(RefusedError, match=r"^(estimation|identity|camera)"):
            calibrate(wrong, rig, obj)


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


def test_a_refusal_begins_with_the_unit():
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    blobs = true_detections(simulate_truth(rig, obj, 2, torch.Generator().manual_seed(0), PhysicalDrift()))
    blobs = replace(blobs, fiducial=blobs.fiducial * 0 - 1)
    with pytest.raises(
        RefusedError, match=r"^the rig is .* times too small for the object, as if it were in metres; .*; so "
    ):
        calibrate(blobs, in_metres(rig), obj)


@pytest.mark.parametrize(
    ("change", "expected"),
    [(object_times(1e-3), "the object seems to be in metres"), (rig_times(1e-3), "the rig seems to be in metres")],
)
def test_the_lengths_of_a_stick_and_its_rig_show_a_unit(change, expected):
    rig, obj, blobs, _ = capture(TRIPLE, 4, false=0)
    with pytest.raises(RefusedError, match=f"^{expected}, expected millimetres: .*; so "):
        calibrate(blobs, *change(rig, obj))


def test_a_light_shows_the_unit_of_the_rig():
    rig, obj, blobs, _ = capture(((0.0, 0.0, 0.0),), 24, false=0)
    with pytest.raises(RefusedError, match=r"^the rig seems to be in metres, expected millimetres: its cameras"):
        calibrate(blobs, in_metres(rig), obj)
    assert unit_doubt(rig, obj) == "" == unit_doubt(in_metres(rig), obj, from_scratch=True)


def test_reflections_beside_a_body_make_no_unit_of_a_move():
    rig, obj, truth = damage.wand_in_a_room(30, 1)
    moved = damage.changed_from(truth, obj, 3, 15, lambda r: damage.turned(r, 3, 1.0))
    table = damage.blobs(moved, 1, clutter=2.0, missed=0.4)
    with pytest.raises(MovedError, match=r"^camera cam04 moved before snapshot"):
        calibrate(table, rig, obj)

"""Cameras that move during a capture are named, with the time, the kind and the size; steady ones are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import PipelineOptions, associate
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object
from imgcal.pipeline import calibrate, score
from imgcal.pipeline.motion_check import list_moves
from imgcal.synthesis import Truth
from imgcal.types import MovedError, RigPrior
from scripts.benchmarks import camera_faults as damage
from scripts.benchmarks import merging_wands
from tests.imgcal.pipeline.short_search import SHORT

CAMERA = 3
MAKE = {"room": damage.wand_in_a_room, "ring": damage.object_before_a_ring}
AFTER = PipelineOptions(after_last_move=True)


def capture(kind, snapshots, first, change, seed=1, **what):
    rig, obj, truth = MAKE[kind](snapshots, seed)
    return damage.blobs(damage.changed_from(truth, obj, CAMERA, first, change), seed, **what), rig, obj, truth


@pytest.mark.parametrize(
    ("kind", "snapshots", "first", "degrees"),
    [
        ("room", 30, 27, 1.0),  # a bump in the last tenth: no label fits afterwards
        ("room", 30, 3, 1.0),  # in the first tenth
        ("room", 30, 15, 0.1),  # half of the labels would be outliers
        ("room", 40, 20, 0.02),  # below the gate of outliers, and the estimate in between
        ("ring", 20, 18, 1.0),
        ("ring", 12, 6, 0.1),
    ],
)
def test_a_bump_is_named_with_its_time_and_size(kind, snapshots, first, degrees):
    table, rig, obj, _ = capture(kind, snapshots, first, lambda r: damage.turned(r, CAMERA, degrees))
    with pytest.raises(MovedError) as found:
        calibrate(table, rig, obj, SHORT)
    (move,) = found.value.moved
    assert (move.camera, move.snapshot, move.kind, move.unit) == ("cam04", f"{first:05d}", "rotation", "deg")
    assert abs(move.size - degrees) < 5 * move.sigma + 0.02 * degrees
    assert move.sigma < 0.2 * degrees
    assert f"camera cam04 moved before snapshot {first:05d}" in str(found.value)
    assert "PipelineOptions(after_last_move=True)" in str(found.value)
    assert "--after-last-move" in found.value.for_command


def test_a_move_beyond_what_the_prior_expects_is_named_without_a_size():
    table, rig, obj, _ = capture("ring", 12, 6, lambda r: damage.turned(r, CAMERA, 8.0))
    with pytest.raises(MovedError, match="camera cam04 moved before snapshot 00006: no rig is right"):
        calibrate(table, rig, obj, SHORT)


@pytest.mark.parametrize(
    ("change", "kind", "size"),
    [
        (lambda r: damage.shifted(r, CAMERA, 5.0), "position", 5.0),
        (lambda r: damage.longer_lens(r, CAMERA, 1.004), "focal_length", 4.03),
    ],
)
def test_the_kind_of_a_move_is_told(change, kind, size):
    table, rig, obj, _ = capture("room", 40, 20, change)
    with pytest.raises(MovedError) as found:
        calibrate(table, rig, obj, SHORT)
    (move,) = found.value.moved
    assert (move.kind, move.snapshot) == (kind, "00020")
    assert abs(move.size - size) < 5 * move.sigma + 0.03 * size


def test_the_pose_at_the_start_says_nothing_of_the_object_after_a_move():
    """By then it has turned so far that another of its symmetric orientations is nearer to the first pose."""
    cube = load_object("cube8")
    rig, _, truth = damage.object_before_a_ring(28, 1)
    count, first = len(truth.uv), 16
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, 1.0]) * 0.055 * torch.arange(count).double()[:, None])
    rotation, centre = truth.rig_from_object.rotation[:1] @ turn, cube.points.double().mean(0)
    place = truth.rig_from_object.apply(centre[None, None].expand(count, 1, 3))[:1, 0] - rotation @ centre
    poses = RigidTransform(rotation, place)
    image = truth.rig.expand(count).project(poses.apply(cube.points.double()), cube.radius)
    truth = Truth(truth.rig, poses, image.uv, image.visible)
    bumped = damage.changed_from(truth, cube, CAMERA, first, lambda r: damage.turned(r, CAMERA, 0.5))
    coded = damage.blobs(bumped, 1, clutter=0.0, labelled=True)
    options = replace(AFTER, start_pose=poses[0])
    found = calibrate(replace(coded, fiducial=np.full(len(coded), -1)), rig, cube, options).labelled.detections
    labelled = found.fiducial >= 0
    assert labelled.sum() > 600
    np.testing.assert_array_equal(found.fiducial[labelled], coded.fiducial[labelled])


@pytest.mark.parametrize("degrees", [0.1, 1.0])
def test_the_rig_as_it_is_now(degrees):
    table, rig, obj, _ = capture("room", 60, 24, lambda r: damage.turned(r, CAMERA, degrees))
    result = calibrate(table.of_snapshots(0, 44), rig, obj, AFTER)
    assert [move.camera for move in result.moved] == ["cam04"]
    assert len(result.labelled.used) == 20 and len(result.labelled.snapshots) == 44
    assert {s.reason for s in result.labelled.snapshots[:24]} == {"taken before a camera moved"}
    assert len(result.tally.blobs) == 44 and result.tally.kept[:24].sum() == 0
    later = table.of_snapshots(44, 60)
    stale = calibrate(table.of_snapshots(0, 24), rig, obj).rig
    now, before = (score(later, found, obj) for found in (result.rig, stale))
    assert now.distances.square().mean().sqrt() < 0.3
    assert before.distances.square().mean().sqrt() > 0.4 or int(before.seen[:, CAMERA].sum()) == 0


def test_two_cameras_are_both_named():
    rig, obj, truth = damage.wand_in_a_room(30, 1)
    truth = damage.changed_from(truth, obj, 3, 12, lambda r: damage.turned(r, 3, 0.3))
    truth = damage.changed_from(truth, obj, 5, 20, lambda r: damage.turned(r, 5, 0.2, axis=1))
    result = calibrate(damage.blobs(truth), rig, obj, AFTER)
    assert [(m.camera, m.snapshot) for m in result.moved] == [("cam04", "00012"), ("cam06", "00020")]
    assert len(result.labelled.used) == 10


def test_of_two_cameras_alone_nobody_knows_which_one_moved():
    rig, obj, truth = damage.object_before_a_ring(12, 1)
    pair = Truth(truth.rig.select([0, 3]), truth.rig_from_object, truth.uv[:, [0, 3]])
    pair = damage.changed_from(pair, obj, 1, 6, lambda r: damage.turned(r, 1, 0.2))
    with pytest.raises(MovedError) as found:
        calibrate(damage.blobs(pair), rig.select([0, 3]), obj, SHORT)
    assert {m.camera for m in found.value.moved} <= {"cam01 or cam04", "cam04 or cam01"}


def test_a_camera_that_cannot_be_labelled_after_a_move_is_named_without_a_size():
    rig, obj, truth = damage.wand_in_a_room(30, 1)
    table = damage.blobs(truth, 1)
    mirrored = damage.mirrored(table, rig, CAMERA, "u")
    first = damage.joined(table.select(table.snapshot < 18), mirrored.select(mirrored.snapshot >= 18))
    with pytest.raises(MovedError, match=r"cam04 moved before snapshot 00018:") as found:
        calibrate(first, rig, obj, SHORT)
    assert found.value.moved[0].kind == "unknown" and found.value.moved[0].size is None


def test_one_last_snapshot_alone_may_be_a_slip():
    table, rig, obj, _ = capture("ring", 10, 9, lambda r: damage.turned(r, CAMERA, 1.0))
    assert calibrate(table, rig, obj).moved == ()


@pytest.mark.parametrize("fault", ["none", "heavy tails", "outliers", "sigma", "drift", "slow"])
@pytest.mark.parametrize("kind", MAKE)
def test_a_steady_rig_is_left_alone(kind, fault):
    alarms = 0
    for seed, snapshots in enumerate((5, 8, 12, 25)):
        rig, obj, truth = MAKE[kind](snapshots, seed)
        if fault == "slow":  # errors of the lens that go with the place, and so with time
            truth = damage.from_one_end_to_the_other(damage.with_lens_errors(truth, seed))
        table, draw = damage.blobs(truth, seed, labelled=True), np.random.default_rng(seed)
        if fault == "heavy tails":
            table.uv[:] += 0.15 * draw.standard_t(2.5, table.uv.shape)
        elif fault == "outliers":
            table.uv[draw.random(len(table)) < 0.1] += (6.0, -5.0)
        elif fault == "sigma":
            table.sigma[:] *= (0.2, 0.5, 2.0, 5.0)[seed]
        elif fault == "drift":
            rig = rig.retract(3 * RigPrior().std(rig) * torch.from_numpy(draw.uniform(-1, 1, (10, 15))))
        alarms += len(list_moves(associate(table, rig, obj), rig, obj, PipelineOptions()))
    assert alarms == 0


def test_after_a_move_what_is_left_must_decide():
    table, rig, obj, _ = capture("room", 12, 10, lambda r: damage.turned(r, CAMERA, 1.0))
    table = table.select((table.snapshot < 10) | (table.camera != 7))
    with pytest.raises(RefusedError, match="cam08"):
        calibrate(table, rig, obj, AFTER)


@pytest.mark.parametrize("seed", [0, 4, 12, 16, 17, 29, 39])
def test_errors_of_the_lens_that_go_with_time_are_no_motion(seed):
    rig, obj, truth = damage.wand_in_a_room(35, seed)
    truth = damage.from_one_end_to_the_other(damage.with_lens_errors(truth, seed))
    labelled = associate(damage.blobs(truth, seed, labelled=True), rig, obj)
    assert list_moves(labelled, rig, obj, PipelineOptions()) == ()


def test_a_camera_that_is_off_now_and_then_has_not_moved():
    rig, obj, truth = damage.wand_in_a_room(20, 1)
    table = damage.blobs(truth, labelled=True)
    table.uv[(table.camera == CAMERA) & (table.fiducial >= 0) & (table.snapshot % 5 == 0)] += (9.0, -7.0)
    assert list_moves(associate(table, rig, obj), rig, obj, PipelineOptions()) == ()


def with_lasting_errors(table, seed):
    """Shift each camera's image by errors of 0.06 px that last some two snapshots."""
    draw, shift = np.random.default_rng(seed), np.zeros((len(table.snapshot_names), len(table.camera_names), 2))
    for row in range(len(shift)):
        shift[row] = 0.5 * shift[row - 1] + 0.06 * 0.75**0.5 * draw.standard_normal(shift.shape[1:])
    table.uv[:] += shift[table.snapshot, table.camera]
    return table


def test_an_error_of_the_last_snapshots_is_a_doubt_and_no_motion():
    rig, obj, truth = damage.wand_in_a_room(60, 1)
    table = with_lasting_errors(damage.blobs(truth, 1, labelled=True), 1)
    for row, shift in enumerate((1.0, 3.0, 3.5), 57):  # no longer than a transient error may last
        table.uv[(table.camera == CAMERA) & (table.snapshot == row)] += (shift, -shift)
    result = calibrate(table, rig, obj)
    assert result.moved == ()
    assert [doubt.camera for doubt in result.doubtful] == ["cam04"]


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("kind", MAKE)
def test_labels_at_the_end_that_no_place_of_the_camera_explains_are_no_motion(kind, count):
    rig, obj, truth = MAKE[kind](40, 1)
    table, draw = damage.blobs(truth, 1, labelled=True), np.random.default_rng(1)
    wrong = (table.camera == CAMERA) & (table.snapshot >= 40 - count) & (table.fiducial >= 0)
    table.uv[wrong] -= np.array([1.8, 0.9]) * (1 + 0.5 * draw.standard_normal((wrong.sum(), 1)))  # one way, uneven
    assert list_moves(associate(table, rig, obj), rig, obj, PipelineOptions()) == ()


@pytest.mark.parametrize("seed", [94, 100, 145])  # named with a size, twice, and without one
def test_markers_that_merge_are_no_motion(seed):
    made, _ = merging_wands.capture(seed)
    assert made.merged > 1
    assert calibrate(made.detections, made.factory, made.obj).moved == ()


def test_a_camera_that_fits_on_one_side_only_is_not_said_to_have_moved_for_sure():
    """Its image is mirrored before some moment: no motion does that, and the later part must not confirm one."""
    rig, obj, truth = damage.wand_in_a_room(30, 1)
    table = damage.blobs(truth, 1)
    wrong = damage.mirrored(table, rig, CAMERA, "u")
    both = damage.joined(wrong.select(wrong.snapshot < 8), table.select(table.snapshot >= 8))
    for options in (PipelineOptions(), AFTER):
        with pytest.raises(MovedError, match="a motion alone does not explain them") as found:
            calibrate(both, rig, obj, options)
        assert "after_last_move" not in str(found.value) and "--after-last-move" not in found.value.for_command

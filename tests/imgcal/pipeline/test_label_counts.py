"""A camera whose blobs cannot be labelled is refused by name; one that sees many other things is not."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.association import associate
from imgcal.errors import RefusedError
from imgcal.pipeline import LabelCounts, calibrate, fit_labelled
from scripts.benchmarks import camera_faults as damage
from tests.imgcal.pipeline.short_search import SHORT

CAMERA = 3
BLIND = replace(SHORT, blind_cameras=True)  # a camera without any label is refused otherwise, as one that sees nothing
WAYS = {
    "u": "mirrored left to right",
    "v": "mirrored top to bottom",
    "both": "turned by 180 degrees",
    "turned": "turned counterclockwise by 90 degrees",
}
MAKE = {"room": damage.wand_in_a_room, "ring": damage.object_before_a_ring}


def wrong(kind, how):
    rig, obj, truth = MAKE[kind](8)
    if how == "lens":
        truth = damage.with_camera(truth, obj, CAMERA, lambda r: damage.longer_lens(r, CAMERA))
    elif how == "place":  # a camera of another rig
        truth = damage.with_camera(truth, obj, CAMERA, lambda r: r.select([*range(CAMERA), 7, *range(CAMERA + 1, 10)]))
    table = damage.blobs(truth)
    if how == "late":
        table = damage.late(table, CAMERA)
    elif how == "swapped":
        table = damage.swapped(table, CAMERA, 5)
    elif how in ("u", "v", "both", "turned"):
        table = damage.mirrored(table, rig, CAMERA, how)
    return table, rig, obj


WRONG = ("u", "v", "both", "turned", "lens", "place", "late", "swapped")


# Every mistake in both scenes, and with both options.
@pytest.mark.parametrize(("kind", "how", "options"), [
    (kind, how, (SHORT, BLIND)[(number + (kind == "ring")) % 2])
    for number, how in enumerate(WRONG)
    for kind in MAKE
])  # fmt: skip
def test_a_camera_whose_image_is_not_what_it_is_said_to_be_is_refused_by_name(kind, how, options):
    table, rig, obj = wrong(kind, how)
    told = r"the other cameras put \d+ fiducials|its frames show what the other cameras see one snapshot earlier"
    if how in WAYS:
        told = rf"the other cameras put \d+ fiducials.*once the image is {WAYS[how]}"
    told = rf"cameras? .*cam04.*: .*({told}).*rig\.select"
    if how == "swapped":
        told += "|cameras cam04 and .* seem to be exchanged"
    with pytest.raises(RefusedError, match=rf"^({told})") as refused:
        calibrate(table, rig, obj, options)
    assert how in WAYS or "once the image is" not in str(refused.value)


def test_labels_do_not_hide_that_an_image_is_turned():
    rig, obj, truth = damage.wand_in_a_room(8)
    table = damage.mirrored(damage.blobs(truth, labelled=True), rig, CAMERA, "both")
    with pytest.raises(RefusedError, match=r"^camera cam04: .*once the image is turned by 180 degrees"):
        calibrate(table, rig, obj, SHORT)


@pytest.mark.parametrize("crowd", [0, 5, 40])
@pytest.mark.parametrize("kind", MAKE)
def test_false_blobs_do_not_count_against_a_camera(kind, crowd):
    rig, obj, truth = MAKE[kind](8)
    found = calibrate(damage.blobs(truth, crowded=(CAMERA, crowd)), rig, obj).tally
    assert found.kept[:, CAMERA].sum() > 0.9 * found.expected[:, CAMERA].sum()
    assert found.unexplained.sum() < 0.05 * found.kept.sum()


@pytest.mark.parametrize("shown", [2, 1])
@pytest.mark.parametrize("kind", MAKE)
def test_a_camera_that_is_hidden_again_and_again_among_reflections_is_accepted(kind, shown):
    rig, obj, truth = MAKE[kind](9)
    table = damage.blobs(truth, labelled=True, crowded=(CAMERA, 6))
    hidden = (table.camera == CAMERA) & (table.snapshot % 3 >= shown) & (table.fiducial >= 0)
    table = table.select(~hidden)
    table.fiducial[:] = -1
    assert calibrate(table, rig, obj).tally.kept[::3, CAMERA].sum() > 0


@pytest.mark.parametrize("kind", MAKE)
def test_a_camera_whose_frames_are_mostly_of_other_moments_is_refused(kind):
    rig, obj, truth = MAKE[kind](9)
    table = damage.blobs(truth, crowded=(CAMERA, 6))
    late, wrong = damage.late(table, CAMERA), (table.camera == CAMERA) & (table.snapshot % 3 > 0)
    table = damage.joined(table.select(~wrong), late.select((late.camera == CAMERA) & (late.snapshot % 3 > 0)))
    with pytest.raises(RefusedError, match="cam04"):
        calibrate(table, rig, obj, SHORT)


def test_counts_add_up():
    rig, obj, truth = damage.wand_in_a_room(6)
    table = damage.blobs(truth)
    result = calibrate(table, rig, obj)
    found = result.tally
    assert found.blobs.shape == (6, 10) and found.blobs.sum() == len(table)
    assert found.labelled.sum() == (result.labelled.detections.fiducial >= 0).sum()
    assert found.outliers.sum() == result.outliers
    assert found.kept.sum() == int(result.observations.seen.sum())
    assert (found.usable <= found.blobs).all()  # merged ones are not usable
    assert found.usable.sum() > 0.9 * found.blobs.sum()


def test_a_covered_camera_with_one_reflection_counts_as_blind():
    rig, obj, truth = damage.wand_in_a_room(6)
    table = damage.blobs(truth)
    own = np.flatnonzero(table.camera == CAMERA)
    first = own[np.unique(table.snapshot[own], return_index=True)[1]]
    table.uv[first] = (100.0, 200.0)
    table = table.select(np.setdiff1d(np.arange(len(table)), np.setdiff1d(own, first)))
    with pytest.raises(RefusedError, match="found no fiducial in any snapshot"):
        calibrate(table, rig, obj)
    assert calibrate(table, rig, obj, BLIND).tally.kept[:, CAMERA].sum() == 0


def test_where_a_frame_was_looked_at_false_blobs_as_usual_are_no_witness():
    def seen(usable, kept, found, crowd):
        row = {"blobs": usable, "usable": usable, "labelled": kept, "kept": kept, "placed": 0, "expected": 8}
        row["crowd"] = crowd
        return LabelCounts(found=np.array([[found]]), **{name: np.full((1, 1), number) for name, number in row.items()})

    assert seen(30, 4, True, 0).unexplained == 0  # the pattern was found: what is missing is hidden
    assert seen(30, 4, False, 0).unexplained == 4
    assert seen(24, 0, False, 25).unexplained == 0  # as many false blobs as other frames have
    assert seen(10, 0, False, 3).unexplained == 7  # more than that: the object may be elsewhere


def test_blobs_without_a_label_that_are_where_fiducials_should_be_are_no_witness():
    rig, obj, truth = damage.wand_in_a_room(8)
    table = damage.blobs(truth, clutter=0.0)
    labelled = associate(table, rig, obj)
    taken = (labelled.detections.camera == CAMERA) & (labelled.detections.snapshot < 3)
    fiducial = np.where(taken, -1, labelled.detections.fiducial)
    bare = replace(labelled, detections=replace(labelled.detections, fiducial=fiducial))
    found = fit_labelled(bare, rig, obj).tally
    assert found.labelled[:3, CAMERA].sum() == 0 and found.placed[:3, CAMERA].sum() > 6
    assert found.unexplained[:3, CAMERA].sum() == 0


def test_nobody_is_blamed_if_all_images_are_turned():
    rig, obj, truth = damage.wand_in_a_room(8)
    table = damage.blobs(truth)
    for camera in range(rig.num_cameras):
        table = damage.mirrored(table, rig, camera, "both")
    with pytest.raises(RefusedError) as refused:
        calibrate(table, rig, obj)
    assert "once the image is" not in str(refused.value)

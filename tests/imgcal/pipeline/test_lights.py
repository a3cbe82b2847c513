"""Calibration from unknown markers: correct results, and one-line refusals."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal import Detections, InputError, PipelineOptions, RefusedError
from imgcal.association import associate
from imgcal.geometry import rotation_from_vector
from imgcal.pipeline.motion_check import _prepend_earlier
from imgcal.types import MovedError
from scripts.benchmarks import camera_faults
from scripts.benchmarks.lights import LIGHTS, Scene, simulate, triangulation_error, turned_from
from tests.imgcal.association.stick_scenes import BODY, capture, several


@pytest.fixture(scope="module")
def scene() -> Scene:
    return simulate(markers=12, moments=24, drift=1.0, seed=2)


@pytest.fixture(scope="module")
def result(scene: Scene) -> imgcal.Calibration:
    return imgcal.calibrate(scene.detections, scene.factory, LIGHTS)


def test_rig_is_found(scene: Scene, result: imgcal.Calibration) -> None:
    assert triangulation_error(scene.factory, scene) > 4
    assert triangulation_error(result.rig, scene) < 2
    assert 0.9 < float(result.chi2_per_dof) < 1.1
    assert result.labelled.moment_counts == (24, 24)
    assert result.scale.source == "cameras"


def test_rows_know_their_moment(result: imgcal.Calibration) -> None:
    labelled = result.labelled
    assert (np.diff(labelled.moments) >= 0).all()
    names = np.array(labelled.detections.snapshot_names).astype(int)
    assert (names == labelled.moments).all()
    assert (labelled.before_rows == -1).all()  # of twelve markers, which one was which before is not known
    assert result.untimed == ()
    assert labelled.by_moment().snapshot_names == tuple(f"{moment:05d}" for moment in range(24))


def test_a_moment_without_a_marker_is_a_row_that_was_refused(scene: Scene, result: imgcal.Calibration) -> None:
    fewer = scene.detections.select(scene.detections.snapshot != 5)
    found = imgcal.calibrate(fewer, result.rig, LIGHTS).labelled
    assert found.moment_counts == (23, 24)
    (empty,) = np.flatnonzero(found.moments == 5)
    assert (found.snapshots[empty].name, found.snapshots[empty].status) == ("00005", "refused")
    assert "three cameras" in found.snapshots[empty].reason


def test_after_a_move_rows_keep_their_moments(scene: Scene, result: imgcal.Calibration) -> None:
    labelled = result.labelled
    first = labelled.detections.snapshot_names.index("00010")
    later = labelled.detections.of_snapshots(first, len(labelled.snapshots))
    whole = _prepend_earlier(associate(later, scene.factory, LIGHTS), labelled, "00010")
    assert (whole.moments == labelled.moments).all()
    assert set(whole.moments[whole.used]) == set(range(10, 24))


def test_labels_hold_at_their_moment(scene: Scene, result: imgcal.Calibration) -> None:
    labelled = result.labelled_detections
    assert len(labelled) == len(scene.detections)
    kept = labelled.fiducial >= 0
    assert kept.sum() > 0.95 * (scene.fiducial >= 0).sum()
    assert (scene.fiducial[kept] >= 0).mean() > 0.995
    rows = np.stack((labelled.snapshot, labelled.camera, labelled.fiducial))[:, kept]
    assert len(np.unique(rows, axis=1).T) == kept.sum()  # one blob a camera, moment and marker


def test_held_out_moments_and_cameras_agree(result: imgcal.Calibration) -> None:
    assert result.lights is not None
    agreement = result.lights.agreement
    assert agreement.agrees.all()
    assert (agreement.found > 0.6).all()
    assert (np.abs(agreement.near_misses) < 0.05).all()


def test_a_recalibrated_rig_is_right_at_once(scene: Scene, result: imgcal.Calibration) -> None:
    again = imgcal.calibrate(scene.detections, result.rig, LIGHTS)
    assert again.lights is not None
    assert again.lights.starts == 0


def test_labels_of_the_input_are_not_looked_at(scene: Scene, result: imgcal.Calibration) -> None:
    misled = replace(scene.detections, fiducial=np.arange(len(scene.detections)) % 7)
    found = imgcal.calibrate(misled, scene.factory, LIGHTS)
    assert torch.equal(found.rig.focal_length, result.rig.focal_length)


def test_score(scene: Scene, result: imgcal.Calibration) -> None:
    good, poor = (imgcal.score(scene.detections, rig, LIGHTS) for rig in (result.rig, scene.factory))
    assert float(good.distances.median()) < 0.15
    assert float(poor.distances.median()) > 4
    assert good.labelled.moment_counts == (24, 24)


def test_blobs_of_nothing_are_refused(scene: Scene) -> None:
    random = np.random.default_rng(0)
    noise = replace(scene.detections, uv=random.random(scene.detections.uv.shape) * [1279, 1023])
    with pytest.raises(RefusedError, match="unknown markers: "):
        imgcal.calibrate(noise, scene.factory, LIGHTS)


def test_a_camera_of_another_moment_is_refused(scene: Scene) -> None:
    late = scene.detections.camera == 5
    snapshot = np.where(late, (scene.detections.snapshot + 1) % 24, scene.detections.snapshot)
    with pytest.raises(RefusedError, match=r"unknown markers: camera .*cam06"):
        imgcal.calibrate(replace(scene.detections, snapshot=snapshot), scene.factory, LIGHTS)


def test_a_camera_whose_image_is_turned_is_named(scene: Scene) -> None:
    turned = camera_faults.mirrored(scene.detections, scene.factory, 5, "both")
    with pytest.raises(RefusedError, match=r"^camera cam06: .*once the image is turned by 180 degrees"):
        imgcal.calibrate(turned, scene.factory, LIGHTS)


def test_one_light_alone_is_not_advised_where_it_is_one() -> None:
    rig, obj, blobs, _ = capture(((0.0, 0.0, 0.0),), 24, false=0)
    with pytest.raises(RefusedError, match=r"^unknown markers: camera cam04: of .*use --cameras|cam04") as refused:
        imgcal.calibrate(blobs, camera_faults.turned(rig, 3, 15.0), obj)
    assert "one light" not in refused.value.for_command and "use --cameras" in refused.value.for_command


def test_few_snapshots_are_refused(scene: Scene) -> None:
    with pytest.raises(RefusedError, match="found 4 snapshots, expected at least 8"):
        imgcal.calibrate(scene.detections.of_snapshots(0, 4), scene.factory, LIGHTS)


def test_a_pattern_to_look_for_is_asked_for(scene: Scene) -> None:
    with pytest.raises(InputError, match="unknown markers"):
        imgcal.calibrate(scene.detections, scene.factory, LIGHTS, detector="matched")


def test_an_object_of_one_marker_is_an_unknown_marker() -> None:
    rig, obj, blobs, true = capture([(30.0, 0.0, 0.0)], 40)
    found = imgcal.calibrate(blobs, rig, obj)
    kept = found.labelled_detections.fiducial >= 0
    assert (true[kept] >= 0).mean() > 0.99 and kept.sum() > 0.9 * (true >= 0).sum()
    assert torch.equal(found.rig.focal_length, imgcal.calibrate(blobs, rig, LIGHTS).rig.focal_length)
    moment, pose = next(iter(found.poses_by_object["object0"].items()))
    row = [snapshot.name for snapshot in found.labelled.snapshots].index(moment)
    there = pose.apply(torch.tensor([[30.0, 0.0, 0.0]]).double())
    assert torch.allclose(there, found.rig_from_object.translation[found.labelled.used.index(row)])


def test_labels_say_which_blobs_are_the_one_marker() -> None:
    rig, obj, blobs, true = capture([(0.0, 0.0, 0.0)], 24)
    found = imgcal.calibrate(replace(blobs, fiducial=true), rig, obj)
    assert found.lights is None and found.identity == "coded"
    assert (found.labelled_detections.fiducial == true).all()


def test_unknown_markers_beside_a_known_object_take_part() -> None:
    light = ((0.0, 0.0, 0.0),)
    rig, body, blobs, true = several([BODY, light, light], 24, seed=2)
    alone, found = (imgcal.calibrate(blobs, rig, obj) for obj in (body, [body, LIGHTS]))
    rows = found.labelled
    shown = rows.detections.fiducial == len(BODY)
    assert (true[shown] >= 0).mean() > 0.99 and shown.sum() > 0.8 * (true >= len(BODY)).sum()
    assert (np.diff(rows.moments) >= 0).all() and rows.moment_counts == (24, 24)
    assert (rows.by_moment().snapshot == blobs.snapshot).all()
    names = [rows.snapshots[row].name for row in rows.detections.snapshot[shown]]
    assert names == [blobs.snapshot_names[s] for s in blobs.snapshot[shown]]
    assert not (found.labelled_detections.fiducial[shown] >= 0).any()  # they have no name that lasts
    assert found.predicted_error.median_mm < 1.1 * alone.predicted_error.median_mm
    assert 0.9 < float(found.chi2_per_dof) < 1.1
    assert {row.part for row in rows.snapshots if row.status != "refused"} == {0, 1}


def test_first_poses_belong_to_the_rig_of_the_labels(scene: Scene, result: imgcal.Calibration) -> None:
    assert result.lights is not None
    labelled = result.lights.labelled
    assert labelled.rig is not None
    blobs, last = labelled.detections, scene.factory.num_cameras - 1
    rows = np.flatnonzero((blobs.camera == last) & (blobs.fiducial == 0))
    poses = [labelled.snapshots[row].rig_from_object for row in blobs.snapshot[rows]]
    points = torch.stack([pose.translation for pose in poses if pose is not None])
    off = labelled.rig.project(points).uv[last] - torch.from_numpy(blobs.uv[rows])
    assert float(off.norm(dim=-1).median()) < 1
    assert float((scene.factory.project(points).uv[last] - torch.from_numpy(blobs.uv[rows])).norm(dim=-1).median()) > 5


def shifted(scene: Scene, camera: int, moments: range) -> imgcal.Detections:
    """Shift the blobs of one camera by half a pixel in some moments."""
    rows = (scene.detections.camera == camera) & np.isin(scene.detections.snapshot, moments)
    return replace(scene.detections, uv=scene.detections.uv + np.where(rows[:, None], (0.4, -0.3), 0.0))


@pytest.mark.parametrize("markers", [1, 5])
def test_a_camera_that_shows_the_markers_elsewhere_has_moved(markers: int) -> None:
    scene = simulate(markers=markers, moments=80, drift=0.3, seed=4)
    blobs = turned_from(scene, 4, 40, 1.0)
    with pytest.raises(
        MovedError, match=r"camera cam05 moved before snapshot 000(39|4\d).* from the (3\d|4[01]) since"
    ):
        imgcal.calibrate(blobs, scene.factory, LIGHTS)
    found = imgcal.calibrate(blobs, scene.factory, LIGHTS, PipelineOptions(after_last_move=True))
    assert [move.camera for move in found.moved] == ["cam05"]
    used = found.labelled.moments[found.labelled.used]
    assert used.min() >= 39 and found.labelled.moment_counts[1] == 80


def test_reflections_beside_hidden_markers_are_no_motion() -> None:
    scene = simulate(markers=1, moments=80, drift=0.3, seed=4)
    blobs, late = scene.detections, np.arange(40, 80)
    count = len(late)
    reflection = Detections(
        uv=np.column_stack((300 + 2.0 * late, 500 + 0.5 * late)),
        sigma=np.full(count, 0.1),
        camera=np.full(count, 4),
        snapshot=late,
        fiducial=np.full(count, -1),
        radius=np.full(count, np.nan),
        flags=np.zeros(count, dtype=np.uint8),
        camera_names=blobs.camera_names,
        snapshot_names=blobs.snapshot_names,
    )
    seen = blobs.select(~((blobs.camera == 4) & (blobs.snapshot >= 40)))
    found = imgcal.calibrate(camera_faults.joined(seen, reflection), scene.factory, LIGHTS)
    assert found.moved == () and triangulation_error(found.rig, scene) < 1


def test_an_error_that_ends_is_no_motion() -> None:
    scene = simulate(markers=5, moments=60, drift=0.3, seed=4)
    found = imgcal.calibrate(shifted(scene, 4, range(56, 59)), scene.factory, LIGHTS)
    assert found.moved == ()
    assert triangulation_error(found.rig, scene) < 1
    with pytest.raises(RefusedError, match=r"cam05 moved before snapshot 000(39|40|41).* all 60 snapshots"):
        imgcal.calibrate(shifted(scene, 4, range(40, 60)), scene.factory, LIGHTS)


def opaque_body(rig: imgcal.CameraRig, moments: int, seed: int) -> imgcal.Detections:
    """Blobs of twenty markers on a ball of 300 mm that is carried around and turned; it hides those behind it."""
    random = np.random.default_rng(seed)
    normal = random.standard_normal((20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert rig.volume is not None
    low, high = np.array(rig.volume.low), np.array(rig.volume.high)
    centre = (low + high) / 2 + 0.3 * (high - low) * random.uniform(-1, 1, (moments, 3))
    turns = rotation_from_vector(torch.from_numpy(random.uniform(-1.5, 1.5, (moments, 3)))).numpy()
    normals = normal @ turns.transpose(0, 2, 1)  # (S, N, 3)
    points = centre[:, None] + 300 * normals
    to_camera = rig.positions.numpy()[:, None, None] - points  # (C, S, N, 3)
    facing = (to_camera * normals).sum(-1) > 0.1 * np.linalg.norm(to_camera, axis=-1)
    image = rig.project(torch.from_numpy(points.reshape(-1, 3)))
    shown = image.visible.numpy().reshape(facing.shape) & facing & (random.random(facing.shape) > 0.1)
    camera, snapshot, marker = np.nonzero(shown)
    uv = image.uv.numpy().reshape(*facing.shape, 2)[camera, snapshot, marker]
    order = np.lexsort((random.random(len(uv)), camera, snapshot))
    uv = (uv + 0.1 * random.standard_normal(uv.shape))[order]
    count, names = len(uv), tuple(f"{number:05d}" for number in range(moments))
    return imgcal.Detections(
        uv, np.full(count, 0.1), camera[order], snapshot[order], np.full(count, -1), np.full(count, np.nan),
        np.zeros(count, np.uint8), rig.camera_names, names,
    )  # fmt: skip


def test_markers_that_a_body_hides_from_half_of_the_cameras_calibrate(scene: Scene) -> None:
    """Few of the markers that the others find are in view of a camera on the other side; those few are in place."""
    found = imgcal.calibrate(opaque_body(scene.rig, 60, seed=0), scene.factory, LIGHTS)
    assert triangulation_error(found.rig, scene) < 0.4 * triangulation_error(scene.factory, scene)

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal import InputError, PipelineOptions, calibrate, estimate, predicted_error
from imgcal.cli.common import select_cameras
from imgcal.estimation import MAP_DEPTHS, MAP_SIZE, WorkingVolume
from imgcal.estimation.accuracy import GRID, joint_covariance, working_volume
from imgcal.geometry import RigidTransform, undistort
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import Observations

F64 = torch.float64


def captured(rig, obj, snapshots, noise=0.05, seed=0):
    truth = simulate_truth(rig, obj, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())
    table = true_detections(truth)
    table.uv[:] += noise * np.random.default_rng(seed).standard_normal(table.uv.shape)
    table.sigma[:] = noise
    return table


@pytest.fixture(scope="module")
def calibration(o10, asymmetric8):
    return calibrate(captured(o10, asymmetric8, 5), o10, asymmetric8).estimate


@pytest.fixture(scope="module")
def predicted(calibration):
    return predicted_error(calibration)


def test_shapes(predicted):
    assert predicted.px.shape == (10, GRID, GRID, GRID) and predicted.mm.shape == (GRID, GRID, GRID)
    assert predicted.maps.px.shape == (10, len(MAP_DEPTHS), *MAP_SIZE) == predicted.maps.inside.shape
    assert predicted.maps.depths.shape == (10, len(MAP_DEPTHS))
    assert (predicted.maps.depths.diff(dim=1) > 0).all()


def test_the_summary_is_plain_and_in_order(predicted):
    summary = json.loads(json.dumps(predicted.summary(), allow_nan=False))
    assert 0 < summary["median_px"] < summary["p95_px"]
    assert 0 < summary["median_mm"] < summary["p95_mm"]
    assert summary["median_mm"] < summary["median_mm_with_noise"]
    assert summary["exceptions"] == [] and summary["median_mm_without_exceptions"] == summary["median_mm"]
    assert summary["noise_px"] == pytest.approx(0.05)
    assert summary["worst_camera_px"] == max(summary["per_camera_px"].values())
    assert summary["per_camera_px"][summary["worst_camera"]] == summary["worst_camera_px"]


def test_medians_are_those_of_the_whole_volume(predicted):
    points = torch.lerp(
        predicted.volume.low,
        predicted.volume.high,
        torch.rand(5000, 3, generator=torch.Generator().manual_seed(0), dtype=F64),
    )
    projection = predicted.uncertainty.rig.project(points)
    px = torch.where(projection.visible, predicted.uncertainty.pixel_error(points), torch.nan)
    mm = predicted.uncertainty.point_error(points, projection.visible)
    assert predicted.median_px == pytest.approx(float(px.nanmedian()), rel=0.05)
    assert predicted.median_mm == pytest.approx(float(mm.nanmedian()), rel=0.05)
    assert predicted.p95_px == pytest.approx(float(px.nanquantile(0.95)), rel=0.08)
    assert predicted.p95_mm == pytest.approx(float(mm.nanquantile(0.95)), rel=0.08)


def test_more_snapshots_say_more(predicted, o10, asymmetric8):
    more = predicted_error(calibrate(captured(o10, asymmetric8, 20), o10, asymmetric8).estimate)
    assert more.median_px < 0.7 * predicted.median_px and more.median_mm < 0.7 * predicted.median_mm


def test_the_corners_of_images_are_known_worse_than_their_middle(predicted):
    middle, corner = predicted.maps.px[:, 1, 8, 12], predicted.maps.px[:, 1, 0, 0]
    assert (corner > 10 * middle).all()
    assert predicted.maps.inside[:, 1, 8, 12].all() and not predicted.maps.inside[:, 1, 0, 0].any()


def test_maps_say_the_same_as_the_uncertainty_at_a_point(predicted):
    rig, camera, depth, row, column = predicted.uncertainty.rig, 4, 2, 3, 13
    uv = torch.tensor([(column + 0.5) / 24 * 2048 - 0.5, (row + 0.5) / 16 * 1088 - 0.5], dtype=F64)
    one = rig.select([camera])
    xy, _ = undistort(((uv - one.principal_point) / one.focal_length)[:, None], one.distortion)
    point = torch.cat((xy[0], torch.ones(1, 1, dtype=F64)), 1) * predicted.maps.depths[camera, depth]
    point = one.cam_from_rig[0].inverse().apply(point)
    torch.testing.assert_close(one.project(point).uv[0, 0], uv)
    found = predicted.uncertainty.pixel_error(point)[camera, 0]
    torch.testing.assert_close(predicted.maps.px[camera, depth, row, column], found)


def test_the_working_volume_holds_the_object_and_its_place(calibration, asymmetric8):
    volume = working_volume(calibration)
    assert volume.contains(calibration.rig_from_object.apply(asymmetric8.points)).all()
    aside = replace(calibration, rig=replace(calibration.rig, working_distance=1500.0))
    assert working_volume(aside).contains(torch.tensor([0.0, 0.0, 1500.0], dtype=F64))
    nowhere = replace(calibration, rig=replace(calibration.rig, working_distance=None))
    reach = (asymmetric8.points - asymmetric8.points.mean(0)).norm(dim=1).max()
    assert (working_volume(nowhere).high - working_volume(nowhere).low >= 2 * reach - 1e-9).all()


@pytest.mark.parametrize("origin", [(0.0, 0.0, 850.0), (2000.0, 1500.0, 0.0)])  # at the object, in a corner of the room
def test_a_working_distance_from_another_origin_says_nothing_of_the_volume(origin, o10, asymmetric8):
    back = RigidTransform(torch.eye(3, dtype=F64), torch.tensor(origin, dtype=F64))
    moved = replace(o10, cam_from_rig=o10.cam_from_rig.to(F64) @ back)
    table = captured(o10, asymmetric8, 5)
    usual, elsewhere = (calibrate(table, rig, asymmetric8).estimate for rig in (o10, moved))
    low, high = (getattr(working_volume(elsewhere), name) + back.translation for name in ("low", "high"))
    around = working_volume(replace(usual, rig=replace(usual.rig, working_distance=None)))
    torch.testing.assert_close(low, around.low, atol=1.0, rtol=0)
    torch.testing.assert_close(high, around.high, atol=1.0, rtol=0)


def test_a_volume_of_ones_own(calibration, predicted):
    far = WorkingVolume(torch.tensor([-100.0, -100, 1400], dtype=F64), torch.tensor([100.0, 100, 1600], dtype=F64))
    assert predicted_error(calibration, volume=far).median_mm > 2 * predicted.median_mm


def test_a_volume_of_ones_own_in_single_precision(calibration, predicted):
    volume = predicted.volume
    single = replace(volume, low=volume.low.float(), high=volume.high.float())
    assert predicted_error(calibration, volume=single).median_mm == pytest.approx(predicted.median_mm, rel=1e-4)


def test_a_covariance_of_ones_own(calibration, predicted):
    twice = predicted_error(calibration, covariance=4 * joint_covariance(calibration))
    torch.testing.assert_close(twice.px, 2 * predicted.px, equal_nan=True)
    torch.testing.assert_close(twice.mm, 2 * predicted.mm, equal_nan=True)


def test_an_estimate_will_do(o10, asymmetric8, predicted):
    truth = simulate_truth(o10, asymmetric8, 5, torch.Generator().manual_seed(0), PhysicalDrift())
    seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
    observations = Observations(truth.uv, torch.full_like(truth.uv[..., 0], 0.05), seen)
    found = predicted_error(estimate(observations, o10, asymmetric8))
    assert found.median_mm == pytest.approx(predicted.median_mm, rel=0.05)
    batch = Observations(observations.uv[None], observations.sigma[None], observations.seen[None])
    with pytest.raises(InputError, match="batch"):
        predicted_error(estimate(batch, o10, asymmetric8))


def test_one_camera_triangulates_nothing(o10, asymmetric8):
    rig = o10.select([0])
    found = predicted_error(calibrate(captured(rig, asymmetric8, 5), rig, asymmetric8).estimate).summary()
    assert found["median_px"] > 0 and found["seen_by_two_cameras"] == 0
    assert found["median_mm"] is None and found["p95_mm"] is None
    json.dumps(found, allow_nan=False)


def test_a_blind_camera_has_the_factorys_errors(o10, asymmetric8):
    table = captured(o10, asymmetric8, 5)
    table = table.select(table.camera != 6)
    found = predicted_error(calibrate(table, o10, asymmetric8, PipelineOptions(blind_cameras=True)).estimate)
    px = np.array(found.camera_px)
    assert found.camera_names[found.worst_camera] == "cam07"
    assert px[6] > 5 and (np.delete(px, 6) < 0.1).all()
    # All cameras alike in the triangulation: the blind one spoils it, and without it all is well.
    assert [found.camera_names[i] for i in found.exceptions] == ["cam07"]
    nine = o10.select([i for i in range(10) if i != 6])
    others = predicted_error(calibrate(select_cameras(table, nine), nine, asymmetric8).estimate)
    without = float(found.mm_without_exceptions.median())
    assert without == pytest.approx(others.median_mm, rel=0.02)
    assert without < found.median_mm / 10


def test_a_calibration_is_as_good_as_its_estimate(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, 3, torch.Generator().manual_seed(1), PhysicalDrift())
    found = calibrate(true_detections(truth), o10, asymmetric8)
    assert predicted_error(found).median_px == predicted_error(found.estimate).median_px

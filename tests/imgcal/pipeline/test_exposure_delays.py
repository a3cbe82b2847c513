"""Constant differences of exposure times are measured and corrected, and other errors are not taken for them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import associate
from imgcal.estimation import camera_covariance, joint_information
from imgcal.pipeline.exposure_delays import Delays, Motion, find_delays
from imgcal.types import Detections
from scripts.benchmarks.rig_streams import Conditions, Stream

COUNT = 60
RIG = imgcal.load_rig("T4").to(torch.float64)
OBJECT = imgcal.load_object("asymmetric8")


@cache
def stream(seed: int) -> Stream:
    return Stream(RIG, OBJECT, seed, Conditions(rate=20.0, labelled=True, clutter=0.0, hidden=0.0))


def capture(delays: tuple[float, ...] | np.ndarray, seed: int = 2, noise: float = 0.1) -> Detections:
    """Labelled snapshots of cameras that expose later by a share of an interval, (C,) or (S, C)."""
    made, rng = stream(seed), np.random.default_rng(seed)
    late = torch.from_numpy(np.broadcast_to(np.asarray(delays, dtype=np.float64), (COUNT, RIG.num_cameras)).copy())
    parts = []
    for number in range(COUNT):
        now = made.snapshot(number)
        points = made.poses_at((number + late[number]) / 20.0).apply(made.obj.points)  # (C, N, 3)
        uv = torch.stack([made.rig.project_values(of, made.obj.radius).uv[c] for c, of in enumerate(points)])
        exact = uv.numpy()[now.camera, now.fiducial]
        parts.append(replace(now, uv=exact + noise * rng.standard_normal(exact.shape)))
    return Detections.join(parts)


def found(blobs: Detections) -> Delays | None:
    answer = find_delays(associate(blobs, RIG, OBJECT), RIG, OBJECT)
    return None if answer is None else answer[0]


def relative_focal_error(result: imgcal.Calibration, seed: int = 2) -> float:
    """RMS error of focal lengths, relative to their standard deviations."""
    std = camera_covariance(result.estimate).diagonal().sqrt().view(RIG.num_cameras, -1)[:, 6:8]
    return float(((result.rig.focal_length - stream(seed).rig.focal_length) / std).square().mean().sqrt())


@pytest.mark.parametrize("delays", [(0.0, 0.05, 0.0, -0.03), (0.0, 0.0, 0.1, 0.0), (0.02, 0.0, 0.01, -0.01)])
def test_delays_are_measured_and_corrected(delays: tuple[float, ...]) -> None:
    late, together = (imgcal.calibrate(capture(some), RIG, OBJECT) for some in (delays, (0.0, 0.0, 0.0, 0.0)))
    assert together.delays is None
    assert late.delays is not None and late.unsynchronized is None
    assert late.delays.snapshots == pytest.approx(np.subtract(delays, sorted(delays)[1]), abs=0.004)
    assert late.additive_noise == 0 and float(late.rms) < 1.1 * float(together.rms)
    assert relative_focal_error(late) < 2


def test_delays_are_told() -> None:
    delays = found(capture((0.0, 0.05, 0.0, -0.03)))
    assert delays is not None
    assert delays.values["snapshots"].keys() == set(RIG.camera_names) and delays.values["note"] == str(delays)
    assert "-0.000" not in str(delays) and "cam02 +0.0" in str(delays) and "cam04 -0.0" in str(delays)


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_other_errors_are_no_delays(seed: int) -> None:
    nothing, rng = np.zeros(RIG.num_cameras), np.random.default_rng(seed)
    assert found(capture(nothing, seed)) is None
    assert found(capture(nothing, seed, noise=0.5)) is None
    assert found(capture(0.03 * rng.standard_normal((COUNT, RIG.num_cameras)), seed)) is None  # random times


def test_large_delays_are_left_to_other_checks() -> None:
    assert found(capture((0.0, 0.0, 0.4, 0.0))) is None


def test_lost_snapshots_are_noticed() -> None:
    blobs = capture((0.0, 0.1, 0.0, 0.0))
    left = np.array([s for s in range(COUNT) if s not in (13, 25, 37, 49)])
    delays = found(blobs.choose_snapshots(left))
    assert delays is not None and delays.snapshots == pytest.approx((0.0, 0.1, 0.0, 0.0), abs=0.006)


def test_a_camera_that_sees_little_does_not_hide_the_others_delays() -> None:
    blobs = capture((0.0, 0.1, 0.0, 0.0))
    delays = found(blobs.select((blobs.camera != 3) | (blobs.snapshot < 6)))
    assert delays is not None and delays.snapshots[3] is None and "cam04 unknown" in str(delays)
    assert delays.snapshots[1] == pytest.approx(0.1, abs=0.006)


def test_clocks_of_different_rates_are_measured() -> None:
    late = np.zeros((COUNT, RIG.num_cameras))
    late[:, 1] = np.linspace(0.04, 0.12, COUNT)
    result = imgcal.calibrate(capture(late), RIG, OBJECT)
    assert result.delays is not None and result.additive_noise == 0
    assert result.delays.snapshots == pytest.approx((0.0, 0.08, 0.0, 0.0), abs=0.004)
    assert result.delays.changes == pytest.approx((0.0, 0.04, 0.0, 0.0), abs=0.004)
    assert "cam02 +0.08" in str(result.delays) and str(result.delays).count("growing") == 1
    assert result.delays.values["changes"]["cam02"] == result.delays.changes[1]
    assert relative_focal_error(result) < 2


def test_a_clock_that_jumps_has_no_delay_that_changes_evenly() -> None:
    late = np.zeros((COUNT, RIG.num_cameras))
    late[COUNT // 2 :, 1] = 0.1
    assert found(capture(late)) is None


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_a_dozen_snapshots_are_enough_to_be_honest(seed: int) -> None:
    """A late camera lost a third of its labels as outliers, and was off by six standard deviations."""
    result = imgcal.calibrate(capture((0.0, 0.0, 0.1, 0.0), seed).of_snapshots(0, 12), RIG, OBJECT)
    assert result.delays is not None and result.outliers == 0
    assert relative_focal_error(result, seed) < 2


def test_uncertain_delays_make_the_cameras_uncertain() -> None:
    result = imgcal.calibrate(capture((0.0, 0.05, 0.0, -0.03)), RIG, OBJECT)
    of_delays = replace(result.estimate, delays=None)
    variance, known = (camera_covariance(one).diagonal() for one in (result.estimate, of_delays))
    assert bool((variance > known).all()) and float((variance / known).max()) > 1.05
    information = torch.linalg.inv(joint_information(result.estimate)).diagonal()
    flat = camera_covariance(result.estimate, curved=False).diagonal()
    assert torch.allclose(information[: len(flat)], flat, rtol=1e-4)


def test_few_snapshots_and_single_cameras_say_nothing() -> None:
    blobs = capture((0.0, 0.05, 0.0, -0.03))
    assert found(blobs.of_snapshots(0, 7)) is None
    alone = replace(blobs.select(blobs.camera == 0), camera_names=RIG.camera_names[:1])
    assert find_delays(associate(alone, RIG.select([0]), OBJECT), RIG.select([0]), OBJECT) is None


def test_motion_is_interpolated_from_the_neighbours_in_time() -> None:
    time = np.arange(9.0)

    def at(moment: np.ndarray) -> torch.Tensor:
        curve = np.stack((3 * moment + 0.5 * moment**2, np.sin(0.3 * moment)), -1)
        return torch.from_numpy(curve)[:, None, None]

    before = np.array([-1, 0, 1, 2, 3, -1, 5, 6, 7])  # a gap before row 5
    motion = Motion.of(at(time), torch.ones(9, 1, 1, dtype=torch.bool), before)
    assert motion.neighbours.tolist() == [0, 1, 2, 1, 0, 0, 1, 1, 0]
    delay = torch.full((9, 1), 0.1, dtype=torch.float64)
    missed = (at(time + 0.1) - at(time) - motion.during(delay)).abs().amax((1, 2, 3))
    assert float(missed[2]) < 1e-4 and float(missed[[1, 3, 6, 7]].max()) < 1e-3
    assert float(missed[[0, 4, 5, 8]].max()) < 0.06
    variance = motion.variance(delay, torch.zeros(1, dtype=torch.float64))[:, 0, 0]
    assert float(variance[2]) < 0.1 * float(variance[1]) < 0.01 * float(variance[0])
    assert float(missed[[0, 4, 5, 8]].max()) < 3 * float(variance[0]) ** 0.5

"""Rigs from one moved point are correct up to scale, for any assumed focal lengths, and robust."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal import RefusedError
from imgcal.estimation import PointStart, cold_start_from_points, move_to_pair_frame
from imgcal.synthesis import simulate_volume
from imgcal.types import CalibrationObject, CameraRig, Observations, RigPrior

LIGHT = CalibrationObject.unknown()


def seen_by(rig: CameraRig, moments: int, noise: float = 0.1) -> Observations:
    generator = torch.Generator().manual_seed(1)
    truth = simulate_volume(rig, LIGHT, moments, generator, None)
    assert truth.visible is not None
    uv = truth.uv + noise * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    return Observations(uv, torch.full(uv.shape[:-1], 0.1).double(), truth.visible)


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return replace(imgcal.load_rig("room10").select([0, 2, 5, 7]), prior=RigPrior(0.15, 25.0, 0.1))


def ratios(rig: CameraRig) -> torch.Tensor:
    apart = torch.cdist(rig.positions, rig.positions)
    return apart / apart[0, 1]


def check(found: PointStart, rig: CameraRig, pixels: float = 0.2) -> None:
    assert found.spread < pixels
    assert torch.allclose(ratios(found.rig), ratios(rig), atol=0.02)
    assert float((found.rig.focal_length / rig.focal_length - 1).abs().max()) < 0.02


def test_rig_from_focal_lengths_that_are_ten_percent_off(rig: CameraRig) -> None:
    rough = replace(rig, focal_length=1.1 * rig.focal_length, distortion=torch.zeros_like(rig.distortion))
    found = cold_start_from_points(seen_by(rig, 200), rough, (0, 1))
    check(found, rig)
    assert found.pair == (0, 1)
    assert torch.allclose(found.rig.positions[1], torch.tensor([1000.0, 0.0, 0.0]).double(), atol=1e-6)
    assert torch.allclose(found.rig.positions[0], torch.zeros(3).double(), atol=1e-6)


def test_blobs_of_something_else_do_no_harm(rig: CameraRig) -> None:
    observations, random = seen_by(rig, 200), np.random.default_rng(0)
    wrong = torch.from_numpy(random.random(tuple(observations.seen.shape)) < 0.08)
    noise = torch.from_numpy(random.random(tuple(observations.uv.shape)) * 1000)
    uv = torch.where(wrong[..., None], noise, observations.uv)
    check(cold_start_from_points(replace(observations, uv=uv), rig), rig, 0.3)


def test_two_cameras_are_refused(rig: CameraRig) -> None:
    two = rig.select([0, 1])
    with pytest.raises(RefusedError, match="found 2 cameras, expected at least 3"):
        cold_start_from_points(seen_by(two, 50), two)


def test_cameras_without_common_points_are_refused(rig: CameraRig) -> None:
    observations = seen_by(rig, 60)
    seen = observations.seen.clone()
    seen[:, 3] = False
    with pytest.raises(RefusedError, match="camera cam08 cannot be placed"):
        cold_start_from_points(replace(observations, seen=seen), rig)


def test_frame_of_a_pair_changes_no_image(rig: CameraRig) -> None:
    moved, pair = move_to_pair_frame(rig, None)
    assert pair[0] == 0
    factor = 1000 / float((rig.positions[pair[1]] - rig.positions[0]).norm())
    points = torch.tensor([[100.0, 200.0, 900.0], [-300.0, 50.0, 1200.0]]).double()
    there = (rig.cam_from_rig[0].apply(points)) * factor  # in the first camera
    again = moved.cam_from_rig[0].inverse().apply(there)
    assert torch.allclose(moved.project(again).uv, rig.project(points).uv, atol=1e-6)

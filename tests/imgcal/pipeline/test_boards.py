"""Tables of labelled board corners to a rig: the bend is found and counted, clocks are recognized."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import joint_information
from imgcal.pipeline import calibrate
from imgcal.synthesis import PhysicalDrift, simulate_board, true_detections
from imgcal.types import CalibrationObject


def labelled(truth, noise, seed=0):
    seen = true_detections(truth)
    shift = noise * np.random.default_rng(seed).standard_normal(seen.uv.shape)
    return replace(seen, uv=seen.uv + shift, sigma=np.full(len(seen), noise))


def test_a_bent_board_is_taken_as_it_is_bent():
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(5)
    flat = imgcal.load_object("checkerboard")
    bent = CalibrationObject.of_board(replace(flat.board, bend=(0.4, -0.25)))
    truth = simulate_board(rig, bent, 15, generator, PhysicalDrift())
    found = calibrate(labelled(truth, 0.05), rig, flat)
    assert found.bend is not None and found.bend.is_certain
    assert abs(found.bend.x - 0.4) < 4 * found.bend.x_sigma < 0.2
    assert abs(found.bend.y + 0.25) < 4 * found.bend.y_sigma < 0.2
    stiff = calibrate(labelled(truth, 0.05), rig, CalibrationObject.of_board(replace(flat.board, warp=0.0)))
    assert found.shape == () and stiff.shape != ()  # not fiducial by fiducial


def test_the_bend_is_part_of_the_uncertainty_of_the_rig():
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(6)
    obj = imgcal.load_object("checkerboard")
    seen = labelled(simulate_board(rig, obj, 10, generator, None), 0.05)
    free = calibrate(seen, rig, obj)
    stiff = calibrate(seen, rig, CalibrationObject.of_board(replace(obj.board, warp=0.0)))
    assert stiff.bend is None
    without = replace(free.estimate, modes=None).covariance().diagonal()
    wider = free.estimate.covariance().diagonal()[without > 0] / without[without > 0]
    assert float(wider.min()) > 0.999 and float(wider.max()) > 1.02


def test_images_that_scatter_leave_the_prior_of_the_bend_alone():
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(6)
    obj = imgcal.load_object("checkerboard")
    found = calibrate(labelled(simulate_board(rig, obj, 10, generator, None), 0.05), rig, obj)
    modes = replace(found.estimate.modes, covariance=np.eye(2))  # the images do not show the bend
    scattered = replace(found.estimate, modes=modes, inflation=torch.full((4,), 3.0, dtype=torch.float64))
    std = found.obj.board.warp_std
    bend = replace(found, estimate=scattered).bend
    assert bend.x_sigma == pytest.approx(std) and bend.y_sigma == pytest.approx(std)
    posterior, rigid = (torch.linalg.inv(joint_information(e)) for e in (scattered, replace(scattered, modes=None)))
    added = (posterior - rigid).diagonal()[: 4 * 15] / scattered.problem.prior_std.flatten().square()
    expected = scattered.modes.follow.flatten(1).square().sum(0)
    lenses = torch.arange(60).view(4, 15)[:, 6:].flatten()
    torch.testing.assert_close(added[lenses], expected[lenses], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_cameras_with_clocks_of_their_own_are_recognized(late):
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(9)
    obj = imgcal.load_object("charuco")
    truth = simulate_board(rig, obj, 1, generator, None)
    random, count = np.random.default_rng(1), 40
    time = np.cumsum(np.where(np.arange(count) % 13 < 6, 0.05, 0.4))  # slow, then fast
    moments = time[:, None] + late * np.gradient(time)[:, None] * random.standard_normal((count, 4))
    step = torch.from_numpy(
        np.stack([60 * np.sin(moments), 25 * np.cos(0.8 * moments), 20 * np.sin(0.5 * moments)], -1)
    )
    points = truth.rig_from_object[0].apply(obj.points)
    uv = torch.stack([rig.expand(count).project(points + step[:, c, None]).uv[:, c] for c in range(4)], 1)
    seen = true_detections(replace(truth, rig_from_object=_repeated(truth, count), uv=uv, visible=None))
    noisy = seen.uv + 0.1 * random.standard_normal(seen.uv.shape)
    found = calibrate(replace(seen, uv=noisy), rig, obj)
    assert (found.unsynchronized is not None) == (late > 0)
    if found.unsynchronized is not None:
        assert "not synchronized" in str(found.unsynchronized)
        assert 0.3 * late < found.unsynchronized.share < 2 * late


def _repeated(truth, count):
    from imgcal.geometry import RigidTransform

    pose = truth.rig_from_object
    return RigidTransform(pose.rotation.expand(count, 3, 3), pose.translation.expand(count, 3))

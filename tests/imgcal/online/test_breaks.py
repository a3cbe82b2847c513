from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import to_observations
from imgcal.geometry.rotations import rotation_from_vector
from imgcal.geometry.transforms import RigidTransform
from imgcal.online.breaks import Series, _jacobians, find_breaks, information, series_of
from imgcal.pipeline import calibrate
from imgcal.synthesis.captures import simulate_truth, true_detections
from imgcal.synthesis.rigs import PhysicalDrift


@pytest.fixture(scope="module")
def bare(o10, asymmetric8):
    """Four cameras without distortion, three poses: a series with nothing in it."""
    rig = o10.select([0, 2, 4, 7])
    rig = replace(rig, distortion=torch.zeros_like(rig.distortion))
    truth = simulate_truth(rig, asymmetric8, 3, torch.Generator().manual_seed(0), None)
    shape = (3, 4, 8)
    return Series(
        rig=rig,
        rig_from_object=truth.rig_from_object,
        points=asymmetric8.points.numpy(),
        residual=np.zeros((*shape, 2)),
        sigma=np.full(shape, 0.1),
        labels=np.ones(shape, dtype=bool),
        prior_std=np.tile([0.01] * 3 + [10.0] * 3, (4, 1)),
        offset=np.zeros((4, 6)),
    )


def pixels(series, rig=None, poses=None):
    rig, poses = rig or series.rig, poses or series.rig_from_object
    return rig.expand(3).project(poses.apply(torch.from_numpy(series.points))).uv.numpy()


def test_derivatives_are_those_of_the_projection(bare):
    by_camera, by_pose = _jacobians(bare)
    for k in range(6):
        step = torch.zeros(4, 15, dtype=torch.float64)
        step[:, k] = 1e-4
        numeric = (pixels(bare, bare.rig.retract(step)) - pixels(bare, bare.rig.retract(-step))) / 2e-4
        assert np.allclose(by_camera[..., k], numeric, rtol=1e-5, atol=1e-4)
    poses, middle = bare.rig_from_object, torch.from_numpy(bare.points.mean(0))
    for k in range(6):
        moved = []
        for sign in (1, -1):
            step = torch.zeros(6, dtype=torch.float64)
            step[k] = sign * 1e-4
            turn = rotation_from_vector(step[:3]) @ poses.rotation
            place = poses.translation + poses.rotation @ middle + step[3:] - turn @ middle
            moved.append(pixels(bare, poses=RigidTransform(turn, place)))
        assert np.allclose(by_pose[..., k], (moved[0] - moved[1]) / 2e-4, rtol=1e-5, atol=1e-4)


def test_a_break_is_found_in_its_camera_at_its_place_also_where_the_labels_were_left_out(bare):
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[2, 1] = 0.002
    residual = bare.residual.copy()
    residual[1:] += (pixels(bare) - pixels(bare, bare.rig.retract(step)))[1:]
    first, camera, statistic = find_breaks(replace(bare, residual=residual)).most_significant()
    assert (first, camera) == (1, 2) and statistic > 100
    one_wrong = bare.residual.copy()
    one_wrong[2, 1, 3] = (50.0, -20.0)
    assert find_breaks(replace(bare, residual=one_wrong)).most_significant()[2] < 40


def test_a_motion_of_the_object_is_no_break(bare):
    turn = (
        rotation_from_vector(torch.tensor([0.001, 0.002, -0.001], dtype=torch.float64)) @ bare.rig_from_object.rotation
    )
    residual = pixels(bare, poses=RigidTransform(turn, bare.rig_from_object.translation)) - pixels(bare)
    residual[:2] = 0
    assert find_breaks(replace(bare, residual=residual, sigma=np.full((3, 4, 8), 0.3))).statistic.max() < 1


def test_noise_gives_no_more_than_chi_squared(o10, asymmetric8):
    rig, statistics = o10.select([0, 2, 5, 7]), []
    for seed in range(12):
        truth = simulate_truth(rig, asymmetric8, 5, torch.Generator().manual_seed(seed), PhysicalDrift())
        table = true_detections(truth)
        table.uv[:] += 0.1 * np.random.default_rng(seed).standard_normal(table.uv.shape)
        fit = calibrate(table, rig, asymmetric8)
        labels = replace(to_observations(table, rig, asymmetric8), sigma=fit.observations.sigma)
        statistics.append(find_breaks(series_of(fit.estimate, labels, None)).statistic)
    mean = float(np.mean(statistics))
    assert 3.0 < mean < 6.5 and np.max(statistics) < 30


def test_a_camera_that_sees_the_object_alone_says_nothing_of_its_place(bare):
    labels = np.zeros_like(bare.labels)
    labels[:, 1] = True
    std = bare.prior_std[1]
    assert np.allclose(information(replace(bare, labels=labels))[1] * std[:, None] * std, np.eye(6), atol=1e-2)

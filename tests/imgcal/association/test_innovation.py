"""Predictions with their uncertainty against dense algebra: of exact blobs, and of noisy ones label by label."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch

from imgcal.association.blobs import gather
from imgcal.association.innovation import THRESHOLD, SharedValues, find_contested, innovations
from imgcal.association.verification import fit, make_problem, rig_and_pose, start
from imgcal.estimation import Problem, Solution, State, levenberg_marquardt_cpu, linearize, pose_at, retract, rig_at
from imgcal.estimation.levenberg_marquardt_cpu import SnapshotFit
from imgcal.io import data_path, load_object, read_rig
from imgcal.synthesis import synthesize
from imgcal.types import Detections, RigPrior
from tests.imgcal.association.scenes import scene_of, take


def test_covariance_of_an_unlabelled_fiducial_matches_the_dense_one() -> None:
    rig = read_rig(data_path("rigs", "T4.yaml")).select([0, 2])
    obj = load_object(data_path("objects", "asymmetric8.csv"))
    made = synthesize(rig, obj, 1, torch.Generator().manual_seed(0), drift=None)
    uv, pose = made.projection.uv[0], made.rig_from_object[0]
    points, centroid = obj.points - obj.points.mean(0), obj.points.mean(0)
    seen = torch.ones(1, 1, 2, 8, dtype=torch.float64)
    seen[..., 0, 3] = 0
    prior_std = RigPrior().std(rig)[None]
    problem = Problem(uv.mT[None, None].contiguous(), seen / 0.5, points, centroid, None, rig.expand(1), prior_std)
    centre = (pose.rotation @ centroid + pose.translation)[None, None]
    state = State(torch.zeros(1, 2, 15, dtype=torch.float64), pose.rotation[None, None], centre)
    squared = lambda d2: (d2, torch.ones_like(d2))  # noqa: E731
    equations = linearize(problem, state, squared)
    solution = Solution(state, equations, torch.ones(1, dtype=torch.bool), 1)

    count = 16
    camera = np.repeat([0, 1], 8)
    flags = np.zeros(count, dtype=np.uint8)
    nothing = np.full(count, -1)
    blobs = gather(
        Detections(
            uv.reshape(-1, 2).numpy(), np.full(count, 0.3), camera, np.zeros(count, dtype=np.int64), nothing,
            np.full(count, np.nan), flags, rig.camera_names, ("0",),
        ),
        rig,
    )  # fmt: skip
    labels = np.tile(np.arange(8), (1, 2, 1))
    labels[0, 0, 3] = -1
    found = innovations(blobs, labels, np.array([0.4]), SharedValues.of(problem), [SnapshotFit.of(solution)])

    # Dense: the posterior covariance is the inverse of the whole arrow; the Jacobian of the missing fiducial comes from
    # its own normal equations, J^T J = products, which for one point have rank two.
    information = torch.zeros(36, 36, dtype=torch.float64)
    for c in range(2):
        part = slice(15 * c, 15 * c + 15)
        information[part, part] = equations.camera[0, c]
        information[part, 30:] = equations.coupling[0, 0, c]
        information[30:, part] = equations.coupling[0, 0, c].mT
    information[30:, 30:] = equations.pose[0, 0]
    covariance = torch.linalg.inv(information)

    def pixel(parameters: torch.Tensor) -> torch.Tensor:
        new = retract(problem, state, parameters[:30].view(1, 2, 15), parameters[30:].view(1, 1, 6))
        return rig_at(problem, new.offset)[0].project(pose_at(problem, new)[0, 0].apply(obj.points)).uv[0, 3]

    jacobian = torch.autograd.functional.jacobian(pixel, torch.zeros(36, dtype=torch.float64))
    expected = jacobian @ covariance @ jacobian.mT + 0.25 * torch.eye(2)
    np.testing.assert_allclose(found.log_det[0, 0, 3], torch.logdet(expected).item(), atol=1e-3)
    np.testing.assert_allclose(found.uv, made.projection.uv.numpy(), atol=1e-6)
    assert np.nanmax(found.own[np.isfinite(found.own)]) < 1e-6


@pytest.fixture(scope="module")
def noisy():
    """Noisy blobs of two cameras, labelled but for two of them, fitted."""
    rig, obj = read_rig("T4").select([0, 2]), load_object("asymmetric8")
    snapshot = take(rig, obj, 3, noise=0.4, false=2, missing=1)
    scene = scene_of(snapshot, rig, obj)
    labels = snapshot.labels(scene.blobs, 8)
    fits = fit(scene, replace(start(scene, snapshot.poses(), labels[None]), sigma=np.array([0.3])))
    return scene, labels, fits


def left_out(scene, labels, fits, camera, fiducial):
    """Where a fiducial is by all labels but its own, and its covariance: by one dense least squares of 36 parameters.

    Weights of the robust loss and derivatives are those of the fit with all labels: nothing is iterated again.
    """
    problem, state = make_problem(scene, fits), fits.state
    noise = 1 / problem.root_weight[0, 0]  # (C, N) px, inf where there is no label

    def pixels(parameters):
        at = retract(problem, state, parameters[:30].view(1, 2, 15), parameters[30:].view(1, 1, 6))
        return rig_at(problem, at.offset)[0].project(pose_at(problem, at)[0, 0].apply(scene.obj.points)).uv[0:2]

    zero = torch.zeros(36, dtype=torch.float64)
    there, jacobian = pixels(zero), torch.autograd.functional.jacobian(pixels, zero)  # (C, N, 2), (C, N, 2, 36)
    information = torch.zeros(36, 36, dtype=torch.float64)
    information[range(30), range(30)] = 1.0  # the prior, whitened
    right = torch.zeros(36, dtype=torch.float64)
    right[:30] = -state.offset[0].flatten()
    for c in range(2):
        for n in range(8):
            if labels[c, n] < 0 or (c, n) == (camera, fiducial):
                continue
            error = torch.from_numpy(scene.blobs.uv[c, labels[c, n]]) - there[c, n]
            weight = 1 / (noise[c, n] ** 2 + error.square().sum() / THRESHOLD**2)  # Cauchy's
            information += weight * jacobian[c, n].mT @ jacobian[c, n]
            right += weight * jacobian[c, n].mT @ error
    covariance = torch.linalg.inv(information)
    place = there[camera, fiducial] + jacobian[camera, fiducial] @ covariance @ right
    return place.numpy(), (jacobian[camera, fiducial] @ covariance @ jacobian[camera, fiducial].mT).numpy()


def test_leaving_a_label_out_is_a_fit_without_it(noisy) -> None:
    """All labels, all blobs: places, covariances and distances against one least squares for each."""
    scene, labels, fits = noisy
    found = fits.innovations
    typical = float(np.median(scene.blobs.sigma[scene.blobs.row >= 0] ** 2))
    for camera in range(2):
        for fiducial in range(8):
            place, covariance = left_out(scene, labels, fits, camera, fiducial)
            label = labels[camera, fiducial]
            covariance += np.eye(2) * ((scene.blobs.sigma[camera, label] ** 2 if label >= 0 else typical) + 0.3**2)
            away = scene.blobs.uv[camera, : scene.blobs.count[camera]] - place
            expected = np.einsum("mi,ij,mj->m", away, np.linalg.inv(covariance), away)
            given = found.squared[0, camera, fiducial, : len(away)]
            assert found.log_det[0, camera, fiducial] == pytest.approx(np.linalg.slogdet(covariance)[1], abs=0.01)
            np.testing.assert_allclose(given, expected, rtol=0.02, atol=0.02)
            if label >= 0:
                assert found.own[0, camera, fiducial] == given[label]
            else:
                assert found.own[0, camera, fiducial] == np.inf


def test_residuals_and_freedom_are_those_of_the_fit(noisy) -> None:
    scene, labels, fits = noisy
    found, seen = fits.innovations, labels >= 0
    rig, pose = rig_and_pose(scene, fits, 0)
    uv = rig.project(pose.apply(scene.obj.points)).uv.numpy()
    np.testing.assert_allclose(found.uv[0], uv, atol=1e-9)
    error = uv - scene.blobs.uv[np.arange(2)[:, None], labels]
    np.testing.assert_allclose(found.residual[0][seen], (error**2).sum(-1)[seen], rtol=1e-6)
    assert (found.residual[0][~seen] == 0).all() and (found.freedom[0][~seen] == 0).all()
    # What the parameters take of the observations, prior and data together take of the parameters.
    assert ((found.freedom[0][seen] > 0) & (found.freedom[0][seen] < 2)).all()
    assert 2 * seen.sum() - 36 < found.freedom.sum() < 2 * seen.sum() - 6


def test_complexity_is_the_determinant_of_the_information(noisy) -> None:
    scene, _, fits = noisy
    equations = levenberg_marquardt_cpu.minimize(
        make_problem(scene, fits), fits.state, "cauchy", THRESHOLD, 8, 1e-3
    ).equations
    dense = torch.zeros(36, 36, dtype=torch.float64)
    dense[30:, 30:] = equations.pose[0, 0]
    for c in range(2):
        part = slice(15 * c, 15 * c + 15)
        dense[part, part], dense[part, 30:] = equations.camera[0, c], equations.coupling[0, 0, c]
        dense[30:, part] = equations.coupling[0, 0, c].mT
    assert fits.innovations.complexity[0] == pytest.approx(float(torch.logdet(dense)), rel=1e-3)


def test_contested_labels_are_those_that_a_change_or_an_exchange_costs_little(noisy) -> None:
    _, labels, fits = noisy
    found = fits.innovations
    for undecided in (13.8, 1e4, 3e4):
        expected = np.zeros((2, 8), dtype=bool)
        cost = found.squared[0] + found.log_det[0][..., None]
        for c in range(2):
            for i, j in permutations(range(8), 2):
                if labels[c, i] < 0:
                    continue
                change = cost[c, j, labels[c, i]] - cost[c, i, labels[c, i]]
                if labels[c, j] >= 0:
                    change += cost[c, i, labels[c, j]] - cost[c, j, labels[c, j]]
                expected[c, i] |= change < undecided
        np.testing.assert_array_equal(find_contested(labels[None], found, undecided)[0], expected)
        assert undecided == 13.8 or expected.any()

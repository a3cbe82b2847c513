"""Residual tests of the object: silent for a correct object, and they identify the errors of a wrong one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import (
    EstimationOptions,
    ScaleEvidence,
    ShapeEvidence,
    estimate,
    object_shape,
    offsets,
    shape_modes,
)
from imgcal.estimation.object_shape import (
    learnt_tolerances,
    object_evidence,
    pull_scatter,
    scale_evidence,
    shape_evidence,
)
from imgcal.estimation.robust_losses import NamedLoss

LOSS = NamedLoss("huber", 3.0)


def evidence(case, row):
    """What one of a batch of rigs says about the object."""
    one = case.observations.of_snapshots(row)
    found = estimate(one, case.factory, case.obj, prior_std=case.prior_std)
    return found, shape_evidence(found.problem, found.solution, LOSS)


def displaced(case, fiducial, by):
    """The same observations, with an object file in which a fiducial stands `by` mm from where it was seen."""
    points = case.obj.points.clone()
    points[fiducial] -= torch.tensor(by, dtype=points.dtype)
    return replace(case, obj=replace(case.obj, points=points))


@pytest.mark.parametrize("snapshots", [1, 3, 10])
def test_a_right_object_is_not_suspected(simulate, snapshots: int) -> None:
    case = simulate(20, snapshots=snapshots, cameras=5, missing=0.1)
    found = [evidence(case, row)[1] for row in range(20)]
    sigmas = np.array([shape.bent_sigma() for shape in found])
    scales = np.array([error / deviation for error, deviation in (shape.scale_error for shape in found)])
    assert sigmas.max() < 3.5 and abs(sigmas.mean()) < 1.2
    assert 0.6 < np.sqrt(np.square(scales).mean()) < 1.4


@pytest.mark.parametrize("fiducial", [0, 5])
def test_one_displaced_fiducial_is_found_and_no_other(simulate, fiducial: int) -> None:
    case = displaced(simulate(4, snapshots=6, cameras=5), fiducial, (0.3, 0.0, -0.4))
    for row in range(4):
        found, shape = evidence(case, row)
        assert shape.bent_sigma() > 10
        prior_std = learnt_tolerances(shape)
        assert np.delete(prior_std, fiducial).max() < 0.2 * prior_std[fiducial]
        obj = replace(case.obj, tolerance=torch.from_numpy(prior_std))
        one = case.observations.of_snapshots(row)
        fit = estimate(one, case.factory, obj, found.rig_from_object, prior_std=case.prior_std)
        each = offsets(fit, case.obj.points.numpy())
        assert [o.fiducial for o in each if o.distance > 4 * o.sigma + 0.01] == [fiducial]
        assert each[fiducial].distance == pytest.approx(0.5, abs=4 * each[fiducial].sigma)
        assert shape_evidence(fit.problem, fit.solution, LOSS).bent_sigma() < 4
        assert pull_scatter(fit.problem, fit.solution.state, LOSS) == 1  # too few snapshots to compare


def test_where_many_fiducials_are_off_all_get_the_same_tolerance(simulate) -> None:
    case = simulate(snapshots=6, cameras=5, bent=0.3)
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    prior_std = learnt_tolerances(shape_evidence(found.problem, found.solution, LOSS))
    assert np.ptp(prior_std) < 1e-9 and 0.15 < prior_std[0] < 0.6


def test_the_scale_is_told_from_the_shape(simulate) -> None:
    case = simulate(snapshots=6, cameras=10)
    larger = replace(case.obj, points=case.obj.points / 1.05)  # the true one is 5 % larger than the file says
    found = estimate(case.observations, case.factory, larger, prior_std=case.prior_std)
    shape = shape_evidence(found.problem, found.solution, LOSS)
    error, deviation = shape.scale_error
    assert error == pytest.approx(0.05, abs=5 * deviation) and error > 8 * deviation
    assert shape.bent_sigma() < 4


def test_granted_tolerances_are_not_suspected_and_more_is(simulate) -> None:
    for factor, low, high in ((1.0, -4.0, 4.0), (12.0, 8.0, np.inf)):
        case = simulate(snapshots=8, cameras=5, bent=0.2 * factor, tolerance=0.2)
        options = EstimationOptions(loss="squared")
        found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std, options=options)
        assert low < shape_evidence(found.problem, found.solution, LOSS).bent_sigma() < high


def test_errors_that_belong_to_places_scatter_from_snapshot_to_snapshot(simulate) -> None:
    case = simulate(snapshots=40, cameras=5, tolerance=0.1)
    for field, low, high in ((0.0, 1.0, 1.3), (0.15, 2.0, np.inf)):
        uv = case.observations.uv + field * torch.sin(case.observations.uv.flip(-1) / 40)
        found = estimate(replace(case.observations, uv=uv), case.factory, case.obj, prior_std=case.prior_std)
        assert low <= pull_scatter(found.problem, found.solution.state, LOSS) < high


def test_one_camera_does_not_know_the_scale(simulate) -> None:
    case = simulate(snapshots=4, cameras=1)
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    error, deviation = shape_evidence(found.problem, found.solution, LOSS).scale_error
    assert abs(error) < 4 * deviation and deviation > 0.01


@pytest.mark.parametrize(("snapshots", "cameras", "radius"), [(1, 5, None), (7, 3, None), (4, 4, 6.0)])
@pytest.mark.parametrize("fixed", [False, True])
def test_the_scale_by_itself_is_that_of_the_whole_shape(
    monkeypatch, simulate, snapshots, cameras, radius, fixed
) -> None:
    monkeypatch.setattr(shape_modes, "POINTS_AT_ONCE", 60)
    case = simulate(2, snapshots=snapshots, cameras=cameras, missing=0.1, radius=radius)
    uv, prior_std = case.observations.uv.clone(), case.prior_std.clone()
    uv[:, 0, 0, 0] += 9.0  # for the loss to weigh
    if fixed:
        prior_std[1, 3:6] = 0.0
    options = EstimationOptions(tolerance=1e-12)
    for row in range(2):
        one = replace(case.observations, uv=uv).of_snapshots(row)
        found = estimate(one, case.factory, case.obj, prior_std=prior_std, options=options)
        expected = shape_evidence(found.problem, found.solution, LOSS)
        quick = scale_evidence(found.problem, found.solution, LOSS)
        # The image of a sphere's centre depends on its radius, which does not grow with the distances.
        np.testing.assert_allclose(quick.scale_error, expected.scale_error, rtol=1e-4 if radius is None else 1e-3)


def test_an_exact_object_of_many_fiducials_is_asked_about_its_scale_alone(monkeypatch, simulate) -> None:
    case = simulate(snapshots=2, cameras=3)
    found = estimate(case.observations, case.factory, case.obj, prior_std=case.prior_std)
    assert isinstance(object_evidence(found.problem, found.solution, LOSS), object_shape.ShapeEvidence)
    monkeypatch.setattr(object_shape, "MOST_FIDUCIALS", 7)
    quick = object_evidence(found.problem, found.solution, LOSS)
    assert isinstance(quick, ScaleEvidence) and quick.bent_sigma() == 0 and 0 < quick.scale_error[1] < np.inf


def test_the_scale_of_a_single_camera_is_not_known_in_either_way(simulate) -> None:
    case = simulate(snapshots=1, cameras=1, missing=0.0)
    wide = 1e4 * case.prior_std
    found = estimate(case.observations, case.factory, case.obj, case.poses, prior_std=wide)
    expected = shape_evidence(found.problem, found.solution, LOSS).scale_error
    assert scale_evidence(found.problem, found.solution, LOSS).scale_error == pytest.approx(expected, rel=1e-2)


def test_the_scale_of_an_object_that_no_image_shows_is_as_uncertain_as_few_fiducials_leave_it() -> None:
    places = np.array([[160.0, 0, 0], [0, 0, 0], [-80, 0, 0], [0, -120, 0], [0, -240, 0]])
    places -= places.mean(0)
    turns = [np.cross(axis, places).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(places)) for axis in np.eye(3)]
    unseen, _ = np.linalg.qr(np.stack([*shifts, *turns, places.ravel()], 1))
    scale = unseen[:, -1]
    seen = np.eye(places.size) - unseen @ unseen.T
    information = 1e4 * seen + 1e-2 * np.outer(scale, scale)  # mm^-2: the cameras hardly know the scale
    random, squared = np.random.default_rng(1), []
    for _ in range(400):
        off = random.normal(0, 0.24, places.size)
        pull = information @ (seen @ off + seen @ random.normal(0, 0.01, places.size))
        shape = ShapeEvidence(information, pull, places, places, np.zeros(len(places)), 0.0, 1.0, 100.0)
        tolerance = learnt_tolerances(shape)
        covariance = np.linalg.inv(information + np.diag(np.repeat(np.maximum(tolerance, 1e-4) ** -2.0, 3)))
        squared.append((scale @ (off - covariance @ pull)) ** 2 / (scale @ covariance @ scale))
    assert 0.8 < np.mean(squared) < 1.2


def test_the_scale_within_its_tolerance_adds_to_the_noise_of_the_fiducials():
    random = np.random.default_rng(0)
    places, root = random.normal(size=(4, 3)), random.normal(size=(12, 12))
    information, displacement = root @ root.T, random.normal(size=12)
    shape = ShapeEvidence(information, information @ displacement, places, places, np.zeros(4), 0.3, 1.0, 100.0)
    found = shape.marginalize_scale()
    noise = np.linalg.inv(information) + 0.3**2 * np.outer(places, places)
    assert np.allclose(found.information, np.linalg.inv(noise))
    assert np.allclose(found.pull, np.linalg.solve(noise, displacement))
    assert found.marginalize_scale() is found

"""A camera with two places: where they part, how far they are apart, and whether a motion explains it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import accepted_observations, associate
from imgcal.estimation import EstimationOptions, estimate, find_moves
from imgcal.estimation.change_points import Step, dispersion
from imgcal.estimation.moves import Change, Places, _has_passed, _outlasts_an_episode
from imgcal.geometry import rotation_from_vector
from imgcal.types import RigPrior
from scripts.benchmarks import camera_faults as faults

CAMERA, FIRST, COUNT = 3, 15, 30
OPTIONS = EstimationOptions()
NAMES = tuple(str(s) for s in range(COUNT))


@pytest.fixture(scope="module")
def bumped():
    """A rig estimated from a capture in which a camera was turned by 0.1 degrees."""
    rig, wand, truth = faults.wand_in_a_room(COUNT, 1)
    truth = faults.changed_from(truth, wand, CAMERA, FIRST, lambda r: faults.turned(r, CAMERA, 0.1))
    observations, _ = accepted_observations(associate(faults.blobs(truth, 1, labelled=True), rig, wand), rig, wand)
    fit = estimate(observations, rig, wand)
    return Places(fit.problem, fit.solution.state, tuple(range(10)), (0,) * 10, np.arange(len(fit.problem.uv[0]))), rig


def test_a_second_place_takes_the_labels_from_its_snapshot_on(bumped):
    places, _ = bumped
    divided = places.divide(Step(CAMERA, FIRST, 0.0, np.zeros(10)), OPTIONS)
    assert divided.camera[-1] == CAMERA and divided.first[-1] == FIRST
    assert divided.camera_places(CAMERA) == [CAMERA, 10]
    assert not divided.seen[FIRST:, CAMERA].any() and not divided.seen[:FIRST, 10].any()
    assert np.array_equal(divided.seen[:, CAMERA] | divided.seen[:, 10], places.seen[:, CAMERA])
    assert divided.shift(CAMERA, 10) == pytest.approx(1000 * np.radians(0.1), rel=0.2)  # px, focal length some 1000
    assert abs(divided.misfit(CAMERA)) < 0.2 * places.misfit(CAMERA)
    assert (divided.costs(CAMERA) < divided.costs(10))[:FIRST].all()
    assert (divided.costs(CAMERA) > divided.costs(10))[FIRST:].all()


def test_the_moment_is_found_from_a_wrong_start(bumped):
    places, rig = bumped
    (move,) = find_moves(places.problem, places.state, rig.camera_names, NAMES, OPTIONS)
    assert (move.camera, move.snapshot, move.kind) == ("cam04", str(FIRST), "rotation")
    assert abs(move.size - 0.1) < 4 * move.sigma


def test_the_size_of_a_turn_about_a_joint_of_the_mount_is_right():
    """It shifts the camera, too, which looks like more of a turn."""
    rig, wand, truth = faults.wand_in_a_room(COUNT, 4)
    angle, joint, inward = np.radians(3.0), torch.tensor([0.0, 150.0, 0.0]).double(), truth.rig.cam_from_rig.rotation.mT
    turn = rotation_from_vector(torch.tensor([angle, 0.0, 0.0]).double())
    step = torch.zeros_like(RigPrior().std(truth.rig)).double()
    step[CAMERA, 0], step[CAMERA, 3:6] = angle, inward[CAMERA].double() @ (joint - turn.mT @ joint)
    truth = faults.changed_from(truth, wand, CAMERA, FIRST, lambda r: r.retract(step))
    observations, _ = accepted_observations(associate(faults.blobs(truth, 4, labelled=True), rig, wand), rig, wand)
    fit = estimate(observations, rig, wand)
    (move,) = find_moves(fit.problem, fit.solution.state, rig.camera_names, NAMES, OPTIONS)
    assert (move.camera, move.kind) == ("cam04", "rotation")
    assert abs(move.size - 3.0) < 3 * move.sigma < 0.1


def test_labels_that_are_dropped_leave_the_pose_of_their_snapshot(bumped):
    places, _ = bumped
    alone = replace(places.problem, root_weight=places.problem.root_weight.clone())
    alone.root_weight[:, 7, :CAMERA] = alone.root_weight[:, 7, CAMERA + 1 :] = 0  # nobody else sees the object then
    places = replace(places, problem=alone)
    left = places.drop_labels(CAMERA, np.array([7, 8]))
    assert np.isfinite(left.blocks.statistics([CAMERA], np.array([FIRST]))).all()
    assert np.abs(left.blocks.camera[7]).max() < 1e-5 * np.abs(places.blocks.camera[7]).max()  # they do not count
    assert (
        not left.seen[8, CAMERA]
        and np.isfinite(left.divide(Step(CAMERA, FIRST, 0.0, np.zeros(10)), OPTIONS).costs(10)).all()
    )


def lasting(uv: torch.Tensor, size: float, seed: int = 3) -> torch.Tensor:
    """Observations (S, C, N, 2) px whose images are shifted by errors that last some two snapshots."""
    draw, memory = np.random.default_rng(seed), 0.5
    shift = size * draw.standard_normal((len(uv), uv.shape[1], 1, 2))
    for row in range(1, len(shift)):
        shift[row] = memory * shift[row - 1] + (1 - memory**2) ** 0.5 * shift[row]
    return uv + torch.from_numpy(shift)


def stepping(first: int, size: float) -> tuple[Places, Places, float]:
    """Give a camera that is turned by 0.05 degrees in 60 snapshots two places; errors that last have some size (px).

    Returns:
        Before and after, and the statistic of the step.
    """
    rig, wand, truth = faults.wand_in_a_room(60, 1)
    truth = faults.changed_from(truth, wand, CAMERA, first, lambda r: faults.turned(r, CAMERA, 0.05))
    observations, _ = accepted_observations(associate(faults.blobs(truth, 1, labelled=True), rig, wand), rig, wand)
    sigma = torch.full_like(observations.sigma, 0.06)
    fit = estimate(replace(observations, uv=lasting(observations.uv, size), sigma=sigma), rig, wand)
    places = Places(fit.problem, fit.solution.state, tuple(range(10)), (0,) * 10, np.arange(len(fit.problem.uv[0])))
    statistic = float(places.blocks.statistics([CAMERA], np.array([first]))[0, 0])
    return places, places.divide(Step(CAMERA, first, statistic, np.zeros(10)), OPTIONS), statistic


@pytest.mark.parametrize("first", [6, 54])
def test_a_step_must_be_significant_without_its_best_episode(first):
    places, divided, statistic = stepping(first, 0.06)
    assert 3 <= divided.episode(CAMERA) < 6
    assert not _outlasts_an_episode(places, divided, CAMERA, 0.8 * statistic, 1.0)
    assert _outlasts_an_episode(places, divided, CAMERA, 0.1 * statistic, 1.0)


def test_a_step_in_the_middle_does_not_rest_on_an_episode():
    places, divided, statistic = stepping(30, 0.06)
    assert _outlasts_an_episode(places, divided, CAMERA, 0.6 * statistic, 1.0)


def test_what_is_no_longer_than_an_episode_is_no_step():
    places, divided, _ = stepping(3, 0.06)
    assert not _outlasts_an_episode(places, divided, CAMERA, 0.0, 1.0)


@pytest.mark.parametrize(
    ("count", "firsts", "off"),  # the latter in px, as recorded in a room
    [(60, (48,), [0.11, 0.55, 0.32, 0.17, 0.33, 0.42, 0.18]), (90, (45, 75), [0.6] * 6)],
)
def test_errors_that_end_are_no_step_however_much_of_it_remains_without_an_episode(count, firsts, off):
    rig, wand, truth = faults.wand_in_a_room(count, 1)
    observations, _ = accepted_observations(associate(faults.blobs(truth, 1, labelled=True), rig, wand), rig, wand)
    uv = lasting(observations.uv, 0.06)
    for first in firsts:
        uv[first : first + len(off), CAMERA, :, 0] -= torch.tensor(off, dtype=uv.dtype)[:, None]
    fit = estimate(replace(observations, uv=uv, sigma=torch.full_like(observations.sigma, 0.06)), rig, wand)
    places = Places(fit.problem, fit.solution.state, tuple(range(10)), (0,) * 10, np.arange(len(fit.problem.uv[0])))
    statistic = float(places.blocks.statistics([CAMERA], np.array([firsts[0]]))[0, 0])
    divided = places.divide(Step(CAMERA, firsts[0], statistic, np.zeros(10)), OPTIONS)
    noise = dispersion(divided.blocks, divided.seen)
    assert divided.episode(CAMERA) < len(off) + 3
    assert not _outlasts_an_episode(places, divided, CAMERA, 0.2 * statistic / noise, noise)


@pytest.mark.parametrize(
    ("first", "left", "alone"), [(1, 0.0, None), (2, 0.0, 0), (53, 0.0, None), (51, 0.0, 59), (46, 0.4, None)]
)
def test_a_camera_that_is_in_its_place_again_at_the_end_has_not_moved(
    first: int, left: float, alone: int | None
) -> None:
    """A snapshot that this camera alone sees says nothing: the object's pose makes up for any place."""
    rig, wand, truth = faults.wand_in_a_room(60, 1)
    observations, _ = accepted_observations(associate(faults.blobs(truth, 1, labelled=True), rig, wand), rig, wand)
    if alone is not None:
        observations.seen[alone, np.arange(10) != CAMERA] = False
    off = torch.tensor([0.79, 0.63, 0.41, 0.46, 0.55, 0.39], dtype=torch.float64)  # px, recorded in a room
    uv, last = lasting(observations.uv, 0.04), first + len(off)
    uv[first:last, CAMERA, :, 0] -= off[:, None]
    uv[last:, CAMERA, :, 0] -= left
    fit = estimate(replace(observations, uv=uv, sigma=torch.full_like(observations.sigma, 0.06)), rig, wand)
    places = Places(fit.problem, fit.solution.state, tuple(range(10)), (0,) * 10, np.arange(len(fit.problem.uv[0])))
    divided = places.divide(Step(CAMERA, last if first < 30 else first, 0.0, np.zeros(10)), OPTIONS)
    assert _has_passed(places, divided, CAMERA, OPTIONS, dispersion(divided.blocks, divided.seen)) == (left == 0)
    names = tuple(str(s) for s in range(60))
    moved = find_moves(fit.problem, fit.solution.state, rig.camera_names, names, OPTIONS)
    assert [move.camera for move in moved] == (["cam04"] if left else [])


def test_where_errors_do_not_last_every_snapshot_counts():
    places, divided, statistic = stepping(3, 0.0)
    assert _outlasts_an_episode(places, divided, CAMERA, statistic, 1.0)


def test_errors_that_do_not_last_have_no_episode(bumped):
    places, _ = bumped
    divided = places.divide(Step(CAMERA, FIRST, 0.0, np.zeros(10)), OPTIONS)
    assert [divided.episode(camera) for camera in range(10)] == [0] * 10


def test_a_change_is_told_by_the_kind_that_explains_it():
    information, step, prior_std = np.diag(np.full(15, 100.0)), np.zeros(15), np.ones(15)
    step[3:5] = 3.0, 4.0
    change = Change(information, information @ step, prior_std)
    kind, size, sigma = change.size()
    assert (kind, size, sigma) == ("position", pytest.approx(5.0), pytest.approx(0.1))
    assert change.is_physical
    step[10:15] = 3.0  # the lens would have to change with it
    assert not Change(information, information @ step, prior_std).is_physical
    assert not Change(information, information @ (step * 0 + 0.1), prior_std).is_physical

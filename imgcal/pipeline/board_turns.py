"""Resolve the orientation of a symmetric board: all cameras of a snapshot must agree on it, and all snapshots on which
way the board bends.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import PipelineOptions, to_observations
from imgcal.errors import RefusedError
from imgcal.estimation import (
    EstimationOptions,
    ObjectQuestion,
    Start,
    estimate,
    estimate_variance_components,
    evidence_by_snapshot,
    has_poses,
    initial_state,
    make_loss,
    make_problem,
    single_camera_poses,
)
from imgcal.medians import MEDIAN_SQUARED
from imgcal.messages import with_article
from imgcal.pipeline.labelled_capture import LabelledCapture
from imgcal.types import Board, CalibrationObject, CameraRig, Detections, Observations

CLEAR = 5.0
"""Logarithm of the odds from which a snapshot is turned; one that shows little of the bend stays as it is."""
ROUNDS = 10
"""Most fits; one or two are usual."""
STEPS, CONVERGED = 100, 1e-6
"""Most steps of the estimate of the bend, and the last one's size in prior standard deviations."""


def settle_turns(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Detections:
    """Turn the labels of each camera so that all cameras of a snapshot agree on the board's orientation.

    Which orientation that is does not matter for the rig. The first camera's is used, and the others follow by the
    factory rig, which knows the cameras' directions far better than half a turn.

    Args:
        detections: points of a board, with an arbitrary orientation in each image.
        rig: what is known before.
        obj: the object; one without a board, or whose images show its orientation, is left alone.
    """
    if obj.board is None or len(obj.board.turns) == 1 or rig.num_cameras == 1:
        return detections
    cam_from_object, known = single_camera_poses(to_observations(detections, rig, obj), rig, obj)
    rotation = rig.cam_from_rig.rotation.double().mT @ cam_from_object.rotation.double()  # board in the rig frame
    fiducial = detections.fiducial.copy()
    angles = [angle for angle, _ in obj.board.turns]
    for row, snapshot in enumerate(np.unique(detections.snapshot)):
        cameras = np.flatnonzero(known[row])
        for camera in cameras[1:].tolist():
            between = rotation[row, cameras[0]].mT @ rotation[row, camera]
            turn = float(torch.atan2(between[1, 0], between[0, 0]))
            away = [abs(np.angle(np.exp(1j * (turn - angle)))) for angle in angles]
            motion = obj.board.turns[int(np.argmin(away))][1]
            rows = (detections.snapshot == snapshot) & (detections.camera == camera) & (fiducial >= 0)
            fiducial[rows] = motion[fiducial[rows]]
    return replace(detections, fiducial=fiducial)


def settle_bend(
    arranged: LabelledCapture, rig: CameraRig, obj: CalibrationObject, prior_std: Tensor, options: PipelineOptions
) -> LabelledCapture:
    """Turn the labels of whole snapshots so that the board bends the same way in all of them.

    A quarter turn exchanges the deflections along x and y. A fit of rig and bend shows which snapshots have them
    exchanged. Turn these, and fit again, until none is left. Half a turn changes no deflection, so it does not matter.

    Args:
        arranged: the snapshots, in each of which all cameras agree.
        rig: what is known before, float64.
        obj: the object; one without a board, or whose images show a quarter turn, is left alone.
        prior_std: (C, K) standard deviations of the factory values.
        options: how the rig is estimated.

    Raises:
        RefusedError: the rig cannot be estimated.
        UndeterminedPosesError: without outliers, some snapshots do not determine the object's pose.
    """
    board = obj.board
    place = None if board is None else _quarter_turn(board)
    if board is None or place is None:
        return arranged
    for _ in range(ROUNDS):
        observations = arranged.observations
        problem = make_problem(observations, rig, obj, prior_std)
        start = Start(initial_state(problem, arranged.poses, arranged.labelled.rig), options.identity_error)
        variance, labels = observations.sigma.numpy() ** 2, observations.seen.numpy()
        fit = estimate_variance_components(problem, [start], variance, labels, options, ObjectQuestion.MODES)
        deflections = torch.from_numpy(board.deflections).to(fit.problem.points)
        loss, offset = make_loss(options.estimation), fit.problem.mode_offset
        information, pull = evidence_by_snapshot(fit.problem, fit.solution.state, loss, deflections)
        bend = np.array(board.bend) + (0.0 if offset is None else board.warp_std * offset.numpy())
        turned = find_exchanged(information, pull + information @ bend, np.array(board.bend), board.warp_std)
        if not turned.any():
            break
        arranged = arranged.relabel(np.flatnonzero(turned), place, rig, obj)
    return arranged


def settle_labels(detections: Detections, rig: CameraRig, obj: CalibrationObject) -> Detections:
    """Do what `settle_turns` does with a rig that is known, and turn each snapshot as the board's known bend shows it.

    Args:
        detections: points of a board, with an arbitrary orientation in each image.
        rig: stays fixed.
        obj: the object; one without a board, or whose images show its orientation, is left alone.
    """
    settled, board = settle_turns(detections, rig, obj), obj.board
    place = None if board is None or board.bend[0] == board.bend[1] else _quarter_turn(board)
    if place is None:
        return settled
    turned = replace(settled, fiducial=np.where(settled.fiducial >= 0, place[settled.fiducial], -1))
    as_is, exchanged = (_pose_costs(labelled, rig, obj) for labelled in (settled, turned))
    better = np.unique(settled.snapshot)[as_is - exchanged > CLEAR]
    return replace(settled, fiducial=np.where(np.isin(settled.snapshot, better), turned.fiducial, settled.fiducial))


def _pose_costs(labelled: Detections, rig: CameraRig, obj: CalibrationObject) -> NDArray[np.float64]:
    """Cost of the best pose in each snapshot, with a fixed rig: (S,); 0 = its labels determine none."""
    observations = to_observations(labelled, rig, obj)
    known = torch.from_numpy(has_poses(observations.seen.numpy(), obj.points))
    costs = observations.uv.new_zeros(len(known))
    if bool(known.any()):
        uv, sigma, seen = (part[known][:, None] for part in (observations.uv, observations.sigma, observations.seen))
        fixed = uv.new_zeros(rig.num_cameras, rig.num_parameters)
        rigs, robust = rig.expand(len(uv)), EstimationOptions(loss="cauchy")
        fit = estimate(Observations(uv, sigma, seen), rigs, obj.as_exact(), prior_std=fixed, options=robust)
        costs[known] = 0.5 * fit.chi2
    return costs.numpy()


def _quarter_turn(board: Board) -> NDArray[np.int64] | None:
    """Fiducial (N,) that a quarter turn maps each one to; None = images show the turn, or the bend does not change."""
    if board.warp_std == 0 and board.bend[0] == board.bend[1]:
        return None
    return next((place for angle, place in board.turns if abs(np.sin(angle)) > 0.5), None)


def find_exchanged(
    information: NDArray[np.floating], pull: NDArray[np.floating], expected: NDArray[np.floating], std: float
) -> NDArray[np.bool_]:
    """Find the snapshots in which the board's deflections along x and y are exchanged.

    If the expected bend does not tell which ones, they are the fewer.

    Args:
        information: (S, 2, 2) mm^-2, of each snapshot about the bend.
        pull: (S, 2) mm^-1, information times the bend that fits the snapshot best.
        expected: (2,) mm, the bend as known before.
        std: mm, standard deviation of both of its deflections; 0 = exact.

    Returns:
        (S,) bool; a snapshot that shows little of the bend is not one of them.

    Examples:
        >>> bends = np.array([[1.0, -0.5], [-0.5, 1.0], [1.1, -0.5]])
        >>> find_exchanged(np.tile(100 * np.eye(2), (3, 1, 1)), 100 * bends, np.zeros(2), 1.0)
        array([False,  True, False])
    """
    bend = expected if std == 0 else _estimate_bend(information, pull, expected, std)
    odds = _log_odds(information, pull, bend)
    # Errors of the lens are alike all over an image: snapshots may differ by far more than their information says.
    shown = np.where((odds > 0)[:, None], bend[::-1], bend)
    away = pull - (information @ shown[..., None])[..., 0]
    squared = np.einsum("sk,skl,sl->s", away, np.linalg.pinv(information, hermitian=True), away)
    odds = odds / max(1.0, float(np.median(squared)) / MEDIAN_SQUARED)
    if expected[0] == expected[1] and 2 * (odds > 0).sum() > len(odds):
        odds = -odds
    return odds > CLEAR


def _log_odds(
    information: NDArray[np.floating], pull: NDArray[np.floating], bend: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Logarithm of the odds (..., S) that snapshots show a bend (..., 2) exchanged; see `find_exchanged`."""

    def log_likelihood(given: NDArray[np.floating]) -> NDArray[np.floating]:
        return given @ pull.T - 0.5 * np.einsum("...k,skl,...l->...s", given, information, given)

    return log_likelihood(bend[..., ::-1]) - log_likelihood(bend)


def _estimate_bend(
    information: NDArray[np.floating], pull: NDArray[np.floating], expected: NDArray[np.floating], std: float
) -> NDArray[np.floating]:
    """Estimate the bend (2,) mm from snapshots that show it, or show it exchanged; see `find_exchanged`.

    Expectation-maximization. The sum over all snapshots shows no difference between x and y if half of them are
    exchanged, so it starts from the snapshot that alone shows the difference most clearly.
    """
    prior = np.eye(2) / std**2
    alone = np.linalg.solve(information + prior, (pull + prior @ expected)[..., None])[..., 0]  # (S, 2)
    bend = alone[np.abs(np.diagonal(_log_odds(information, pull, alone))).argmax()]
    for _ in range(STEPS):
        share = 0.5 + 0.5 * np.tanh(0.5 * _log_odds(information, pull, bend))[:, None]  # exchanged
        towards = ((1 - share) * pull + share * pull[:, ::-1]).sum(0)
        both = ((1 - share[..., None]) * information + share[..., None] * information[:, ::-1, ::-1]).sum(0)
        before, bend = bend, np.linalg.solve(both + prior, towards + prior @ expected)
        if np.abs(bend - before).max() < CONVERGED * std:
            break
    return bend


def require_one_turn(cameras: CameraRig, obj: CalibrationObject) -> None:
    """Raise `RefusedError` if the board's orientation in several cameras cannot be made consistent."""
    if obj.board is not None and len(obj.board.turns) > 1 and cameras.num_cameras > 1:
        raise RefusedError(
            f"object: {with_article(str(obj.board))} looks the same when turned, so without a factory calibration its "
            "points cannot be matched between cameras: use a ChArUco board, a checkerboard with an even and an odd "
            "number of squares, or an asymmetric grid with an odd number of rows"
        )

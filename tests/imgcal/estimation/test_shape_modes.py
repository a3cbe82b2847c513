"""The bend of a printed board is estimated with the rig, and as well as it says."""

from dataclasses import replace

import numpy as np
import torch

import imgcal
from imgcal.estimation import (
    EstimationOptions,
    evidence_by_snapshot,
    initial_state,
    make_loss,
    make_problem,
    minimize,
)
from imgcal.estimation.shape_modes import direction_evidence
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import Board, CalibrationObject, Observations

BEND = (0.4, -0.3)  # mm
BOARD = Board("charuco", columns=6, rows=8, pitch=12.0, marker=9.0, dictionary="DICT_4X4_50")


def test_the_bend_of_a_board_is_found_with_its_sigma() -> None:
    factory = imgcal.load_rig("T4")
    bent = CalibrationObject.of_board(replace(BOARD, bend=BEND))
    generator, noise = torch.Generator().manual_seed(3), np.random.default_rng(3)
    seen = true_detections(simulate_truth(factory, bent, 12, generator, PhysicalDrift()))
    seen = replace(seen, uv=seen.uv + 0.1 * noise.standard_normal(seen.uv.shape), sigma=np.full(len(seen.sigma), 0.1))
    assumed = CalibrationObject.of_board(replace(BOARD, warp=0.5))
    result = imgcal.calibrate(seen, factory, assumed)
    modes = result.estimate.modes
    assert modes is not None and modes.at_rest
    found, sigma = 0.5 * modes.offset, 0.5 * np.sqrt(modes.covariance.diagonal())
    assert sigma.max() < 0.05
    assert (np.abs(found - BEND) < 4 * sigma).all()
    flat = imgcal.calibrate(seen, factory, CalibrationObject.of_board(replace(BOARD, warp=0.0)))
    assert flat.estimate.modes is None


def test_the_evidence_of_a_snapshot_is_that_of_a_fit_to_it_alone() -> None:
    factory = imgcal.load_rig("T4")
    obj = CalibrationObject.of_board(BOARD)
    truth = simulate_truth(
        factory, CalibrationObject.of_board(replace(BOARD, bend=BEND)), 3, torch.Generator().manual_seed(3), None
    )
    seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
    observations = Observations(truth.uv.double(), torch.full(seen.shape, 0.1).double(), seen)
    problem = make_problem(observations, factory, obj, torch.zeros(4, factory.num_parameters).double())
    solution = minimize(problem, initial_state(problem, truth.rig_from_object, None), EstimationOptions())
    directions, loss = torch.from_numpy(BOARD.deflections), make_loss(EstimationOptions())
    information, pull = evidence_by_snapshot(problem, solution.state, loss, directions)
    for s in range(3):
        one = replace(problem, uv=problem.uv[:, [s]], root_weight=problem.root_weight[:, [s]])
        state = replace(solution.state, rotation=solution.state.rotation[:, [s]], centre=solution.state.centre[:, [s]])
        alone = direction_evidence(one, minimize(one, state, EstimationOptions()), loss, directions)
        assert alone is not None
        np.testing.assert_allclose(information[s], alone.information, rtol=1e-3)
        np.testing.assert_allclose(pull[s], alone.pull, rtol=1e-2, atol=1e-3 * np.abs(pull).max())
    np.testing.assert_allclose(np.linalg.solve(information.sum(0), pull.sum(0)), BEND, atol=0.02)

"""PyTorch's own checks of the operator; `imgcal.nn.MapEstimate` has tests of its results."""

import pytest
import torch

from imgcal.estimation import EstimationOptions, encode_options, initial_state, make_problem, map_operator, map_state
from imgcal.geometry import RigidTransform
from imgcal.io import read_rig
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # opcheck itself asks its copies for it
def test_is_sound(asymmetric8, monkeypatch):
    rig = read_rig("T4")
    truth = simulate_truth(rig, asymmetric8, 2, torch.Generator().manual_seed(0), PhysicalDrift())
    seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
    observations = Observations(truth.uv, torch.full(seen.shape, 0.1, dtype=torch.float64), seen)
    problem = make_problem(observations, rig, asymmetric8, None)
    calls, operator = [], map_operator.OPERATOR

    def spy(*inputs, options):
        calls.append((*inputs, options))
        return operator(*inputs, options=options)

    monkeypatch.setattr(map_operator, "OPERATOR", spy)
    start = RigidTransform(truth.rig_from_object.rotation, truth.rig_from_object.translation)
    _, converged = map_state(problem, initial_state(problem, start, None), encode_options(EstimationOptions()))
    assert converged.all()
    named = zip(operator.inputs, calls[0][:-1], strict=True)
    inputs = [x.clone().requires_grad_(name in ("uv", "focal_length", "prior_std")) for name, x in named]
    torch.library.opcheck(torch.ops.imgcal.map_state.default, (*inputs, calls[0][-1]))

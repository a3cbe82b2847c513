"""The evidence of a fit on delays agrees with fits of data that were delayed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import EstimationOptions, delay_evidence, estimate
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations

SNAPSHOTS, PRIOR = 12, 0.1
EXACT = EstimationOptions(loss="squared", tolerance=1e-10)


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
def test_information_is_the_curvature_of_the_cost(tolerance: float) -> None:
    factory, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    obj = replace(obj, tolerance=torch.full((obj.num_fiducials,), tolerance)) if tolerance else obj.as_exact()
    generator = torch.Generator().manual_seed(1)
    truth = simulate_truth(factory, obj, SNAPSHOTS, generator, PhysicalDrift())
    seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
    observations = Observations(truth.uv.double(), torch.full(seen.shape, 0.1, dtype=torch.float64), seen)
    velocity = 20 * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    courses = torch.stack((torch.ones(SNAPSHOTS), torch.linspace(-1, 1, SNAPSHOTS))).double()
    std = torch.tensor([PRIOR, PRIOR / 2], dtype=torch.float64)

    def fit(delay: torch.Tensor) -> imgcal.estimation.Estimate:
        """Fit pixels that were moved back by delays (2, C)."""
        moved = velocity * (courses.mT @ delay)[..., None, None]
        return estimate(replace(observations, uv=observations.uv - moved), factory, obj, options=EXACT)

    none = torch.zeros(2, factory.num_cameras, dtype=torch.float64)
    here = fit(none)
    evidence = delay_evidence(here.problem, here.solution, here.loss, velocity, courses, none, std)
    assert evidence is not None
    information = np.linalg.inv(evidence.covariance) - np.eye(len(evidence.offset))
    for row, camera in ((0, 0), (0, 2), (1, 3)):
        change = none.clone()
        change[row, camera] = 2e-3
        ahead, behind = fit(change), fit(-change)
        bend = float(ahead.chi2 - 2 * here.chi2 + behind.chi2) / 2
        unit = (change / std[:, None]).flatten().numpy()
        assert bend == pytest.approx(unit @ information @ unit, rel=0.02)
        slope = float(ahead.chi2 - behind.chi2) / 4
        pull = (information + np.eye(len(unit))) @ evidence.step
        assert slope == pytest.approx(-unit @ pull, rel=0.02, abs=1e-3)
        follow = (ahead.solution.state.offset - behind.solution.state.offset)[0] / 2
        expected = torch.einsum("m,mck->ck", torch.from_numpy(unit), evidence.follow)
        assert torch.allclose(follow, expected, atol=0.05 * float(expected.abs().max()))

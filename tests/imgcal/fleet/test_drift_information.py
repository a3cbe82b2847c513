import pytest
import torch

import imgcal
from imgcal.fleet import DriftInformation
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations, RigPrior
from tests.imgcal.lensed import KINDS, lensed


def information(prior: RigPrior, lens: str = "") -> DriftInformation:
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    factory = lensed(factory, lens) if lens else factory
    truth = simulate_truth(
        factory, obj, 3, torch.Generator().manual_seed(1), PhysicalDrift(0.05, 0.5, 0.001, 1.0, 1e-3)
    )
    seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
    observations = Observations(truth.uv, torch.full(seen.shape, 0.1), seen)
    options = imgcal.EstimationOptions(loss="squared", tolerance=1e-10)
    return DriftInformation.from_estimates(
        imgcal.estimate(observations, factory, obj, prior_std=prior.std(factory), options=options)
    )


def test_the_prior_is_taken_out_again() -> None:
    one, other = information(RigPrior()), information(RigPrior(0.005, 3.0, 0.01, 0.003, 3.0))
    scale = one.information.diagonal(dim1=1, dim2=2).sqrt()
    apart = (one.information - other.information) / (scale[:, :, None] * scale[:, None, :])
    assert float(apart.abs().max()) < 0.02  # the two minima are not quite at one place
    apart = (one.score - other.score) / scale
    assert float(apart.abs().max()) < 0.02 * float((one.score / scale).abs().max())


@pytest.mark.parametrize("lens", KINDS)
def test_coefficients_that_a_lens_does_not_have_tell_nothing(lens: str) -> None:
    found = information(RigPrior(), lens)
    exist = lensed(imgcal.load_rig("T4"), lens).has_coefficient
    told = found.information.diagonal(dim1=1, dim2=2).unflatten(1, (4, -1))[..., 10:]
    assert torch.equal((told > 0).all(0), exist)
    assert not found.score.unflatten(1, (4, -1))[..., 10:][:, ~exist].any()


def test_a_motion_of_the_whole_rig_has_no_information() -> None:
    values = torch.linalg.eigvalsh(information(RigPrior()).information[0])
    assert float(values[5]) < 1e-6 * float(values[-1])


def test_parts_of_other_cameras_are_not_joined() -> None:
    one = DriftInformation(("a",), torch.zeros(1, 15, 15), torch.zeros(1, 15))
    other = DriftInformation(("b",), torch.zeros(1, 15, 15), torch.zeros(1, 15))
    assert len(DriftInformation.concatenate([one, one])) == 2
    with pytest.raises(imgcal.InputError, match="same cameras"):
        DriftInformation.concatenate([one, other])
    wide = DriftInformation(("a",), torch.zeros(1, 18, 18), torch.zeros(1, 18))
    with pytest.raises(imgcal.InputError, match="same cameras"):
        DriftInformation.concatenate([one, wide])
    with pytest.raises(imgcal.InputError, match="expected"):
        DriftInformation(("a",), torch.zeros(1, 15, 14), torch.zeros(1, 15))

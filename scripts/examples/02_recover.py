"""Let a rig drift, take twenty snapshots of an object, and recover the drift with its uncertainty."""

import torch

import imgcal
from imgcal.estimation import camera_std
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations

generator = torch.Generator().manual_seed(1)
factory, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
truth = simulate_truth(factory, obj, 20, generator, PhysicalDrift())

noise = 0.05  # px
uv = truth.uv + noise * torch.randn(truth.uv.shape, generator=generator, dtype=truth.uv.dtype)
observations = Observations(uv, torch.full(uv.shape[:-1], noise), torch.ones(uv.shape[:-1], dtype=torch.bool))
result = imgcal.estimate(observations, factory, obj)

before = factory.local(truth.rig)[:, 6:8].abs().mean()
after = result.rig.local(truth.rig)[:, 6:8].abs().mean()
deviation = camera_std(result)[:, 6:8].mean()
print(f"focal length error: {before:.2f} px -> {after:.2f} px, predicted {deviation:.2f} px")
print(f"chi2 per degree of freedom: {result.chi2_per_dof:.2f}")

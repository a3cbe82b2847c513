"""Differentiate through the estimate: how does a pixel in one camera change the recalibrated rig?"""

import torch

import imgcal
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations

generator = torch.Generator().manual_seed(3)
factory, obj = imgcal.load_rig("O6"), imgcal.load_object("asymmetric8")
truth = simulate_truth(factory, obj, 2, generator, PhysicalDrift())

uv = truth.uv.clone().requires_grad_()
seen = torch.ones(uv.shape[:-1], dtype=torch.bool)
result = imgcal.estimate(Observations(uv, torch.full(uv.shape[:-1], 0.05, dtype=uv.dtype), seen), factory, obj)

(gradient,) = torch.autograd.grad(result.rig.focal_length[0, 0], uv)  # of fx of the first camera
print("d fx / d u of each fiducial in the first snapshot of the first camera:")
print(gradient[0, 0, :, 0])
print("largest influence through another camera:", f"{gradient[0, 1:].abs().max():.3f}")

"""Write your own training loop: learn a fiducial's sigma from its brightness, through the rig's estimate."""

import torch

import imgcal
from imgcal.nn import MapEstimate, ReprojectionLoss, SplatRenderer
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Prediction

random = torch.Generator().manual_seed(0)
factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
render = SplatRenderer(torch.ones(1, 1), image_size=(9, 9), size=1.5)
estimate, loss = MapEstimate(factory, obj), ReprojectionLoss(obj)
middle = torch.full((1, 2), 4.0, dtype=torch.float64)  # pixels: each fiducial in the middle of its own small image

slope = torch.zeros((), dtype=torch.float64, requires_grad=True)  # of log sigma by log brightness; -1 in the noise
optimizer = torch.optim.Adam([slope], lr=0.1)

for step in range(11):
    truth = simulate_truth(factory, obj, 3, random, PhysicalDrift())
    light = 0.02 + 0.98 * torch.rand(truth.uv.shape[:-1], generator=random, dtype=torch.float64)
    brightness = render(middle.expand(*light.shape, 1, 2), intensity=light[..., None]).amax((-3, -2, -1))
    noise = 0.05 / light[..., None] * torch.randn(truth.uv.shape, generator=random, dtype=torch.float64)

    sigma = 0.05 * brightness**slope
    seen = torch.ones_like(light, dtype=torch.bool)
    solution = estimate(imgcal.Observations(truth.uv + noise, sigma, seen))
    error = loss(Prediction(solution.rig, solution.rig_from_object), Prediction(truth.rig, truth.rig_from_object))
    optimizer.zero_grad()
    error.backward()
    optimizer.step()
    if step % 5 == 0:
        print(f"step {step:2}: error {error.item():.3f} px, slope {slope.item():.2f}")

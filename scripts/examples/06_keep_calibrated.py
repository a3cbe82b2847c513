"""Keep a rig calibrated while an object is carried around in front of it; one camera is bumped on the way."""

import math

import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.synthesis import PhysicalDrift, Truth, simulate_truth, true_detections

generator = torch.Generator().manual_seed(1)
factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
truth = simulate_truth(factory, obj, 1, generator, PhysicalDrift())
bump = torch.zeros(4, 15, dtype=torch.float64)
bump[1, 0] = math.radians(0.5)

with imgcal.RigKeeper(factory, obj) as keeper:
    for number in range(40):
        rig = truth.rig if number < 20 else truth.rig.retract(bump)
        shift = 60 * torch.tensor([[math.sin(number / 9), math.cos(number / 7), math.sin(number / 5)]]).double()
        there = RigidTransform(truth.rig_from_object.rotation, truth.rig_from_object.translation + shift)
        image = rig.expand(1).project(there.apply(obj.points))
        blobs = true_detections(Truth(rig, there, image.uv, image.visible))
        state = keeper.update(blobs, time=number / 60)
        for event in state.events:
            print(f"{number}: {event.message} (since snapshot {60 * (event.since or 0):.0f})")
print(state.sentence)

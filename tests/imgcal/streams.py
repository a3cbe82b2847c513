"""Streams of snapshots for the live recalibrator, with known truth: an object carried smoothly, cameras that move."""

from collections.abc import Collection

import numpy as np
import torch

from imgcal.estimation import EstimationOptions, estimate
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_rig
from imgcal.synthesis import PhysicalDrift, simulate_blobs, simulate_truth
from imgcal.types import Observations


class Stream:
    """A factory rig, what it has become, and an object on its way."""

    def __init__(self, rig_name, object_name, snapshots, seed=0, jump=None):
        self.rig, self.obj = read_rig(rig_name), load_object(object_name)
        self.generator = torch.Generator().manual_seed(seed)
        self.random = np.random.default_rng(seed)
        if rig_name == "room10":
            self.true = PhysicalDrift(0.1, 5.0, 0.002, 3.0, 0.003).apply(self.rig, self.generator)
            amplitude, pace = [2.0, 2.0, 3.0, 1900.0, 1900.0, 850.0], 0.02
            base = RigidTransform(torch.eye(3).double(), torch.tensor([0.0, 0.0, 1150.0]).double())
        else:
            start = simulate_truth(self.rig, self.obj, 1, self.generator, PhysicalDrift())
            self.true, base = start.rig, start.rig_from_object[0]
            amplitude, pace = [0.25, 0.25, 0.4, 25.0, 25.0, 40.0], 0.05
        time = torch.arange(snapshots).double()
        if jump is not None:
            time += 300.0 * (time >= jump)
        rate, phase = (torch.rand(6, generator=self.generator, dtype=torch.float64) for _ in range(2))
        step = torch.tensor(amplitude).double() * torch.sin(pace * (0.6 + rate) * time[:, None] + 6.28 * phase)
        turn = rotation_from_vector(step[:, :3]) @ base.rotation
        middle = self.obj.points.mean(0)
        place = base.apply(middle[None])[0] + step[:, 3:]
        self.poses = RigidTransform(turn, place - turn @ middle)

    def bumped(self, cameras, turn_deg=0.0, shift_mm=0.0):
        """The true rig with some cameras turned and shifted, in directions of their own."""
        step = torch.zeros(self.rig.num_cameras, 15, dtype=torch.float64)
        for camera in cameras:
            axis, way = torch.randn(2, 3, generator=self.generator, dtype=torch.float64)
            step[camera, :3] = axis / axis.norm() * np.deg2rad(turn_deg)
            step[camera, 3:6] = way / way.norm() * shift_mm
        return self.true.retract(step)

    def blobs(self, s, rig=None, hidden: Collection[int] = (), noise=0.07, false=0.0):
        """What the cameras see in one snapshot, unlabelled and in any order; and the true labels."""
        rig = self.true if rig is None else rig
        points = self.poses[s].apply(self.obj.points)
        return simulate_blobs(rig, points, self.obj.radius, self.random, noise, 0.0, false, hidden)

    def errors(self, found, s, rig=None):
        """RMS error (px) of each camera where the object is: (C,); its pose is fitted, so that no gauge takes part."""
        rig = self.true if rig is None else rig
        pose = self.poses[s : s + 1]
        seen = rig.expand(1).project(pose.apply(self.obj.points), self.obj.radius)
        observations = Observations(seen.uv, torch.full_like(seen.uv[..., 0], 0.3), seen.visible)
        held = torch.zeros(rig.num_cameras, 15, dtype=torch.float64)
        fit = estimate(observations, found, self.obj, pose, prior_std=held, options=EstimationOptions(loss="cauchy"))
        squared = fit.residual.square().sum(-1).sum((0, 2))
        return (squared / seen.visible.sum((0, 2)).clamp_min(1)).sqrt().numpy()

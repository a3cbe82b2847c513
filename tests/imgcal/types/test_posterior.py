"""A posterior belongs to the rig that was calibrated, and to no other."""

from dataclasses import replace

import torch

import imgcal
from imgcal.types import RigPosterior


def test_it_belongs_to_one_rig() -> None:
    rig = imgcal.load_rig("T4")
    none = torch.zeros(0, dtype=torch.float64)
    posterior = RigPosterior(rig, none.view(0, 3), none, 0.0, none, torch.eye(60).double(), torch.ones(4, 15), 1)
    assert posterior.belongs_to(rig)
    assert posterior.belongs_to(replace(rig, name="another name"))
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[2, 4] = 1e-3
    assert not posterior.belongs_to(rig.retract(step))
    assert not posterior.belongs_to(rig.select([0, 1]))

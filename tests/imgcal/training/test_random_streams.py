"""Streams of random numbers: the same for the same purpose, seed and process, independent otherwise."""

from itertools import product

import torch

from imgcal.training.random_streams import make_stream


def test_purposes_seeds_and_processes_have_independent_streams() -> None:
    which = list(product(("weights", "data", "layers"), (0, 1, 4096), (0, 1)))
    drawn = torch.stack([torch.rand(1000, generator=make_stream(*each)) for each in which])
    assert (torch.corrcoef(drawn) - torch.eye(len(which))).abs().max() < 0.2
    again = torch.stack([torch.rand(1000, generator=make_stream(*each)) for each in which])
    assert torch.equal(drawn, again)

"""Random numbers of a training: each purpose has a stream of its own in each process."""

from __future__ import annotations

import numpy as np
import torch

FIXED = 20_000_003
"""Seed of what all trainings share, whatever their own seed: the data of validations, rendered pools."""


def make_stream(purpose: str, seed: int, process: int = 0, device: torch.device | str = "cpu") -> torch.Generator:
    """Begin a stream of random numbers that is independent of those of other purposes, seeds and processes.

    Args:
        purpose: what is drawn: "weights", "data", ...
        seed: of the training, or `FIXED`.
        process: index of the process; 0 for what all processes draw alike.
        device: of the generator.

    Examples:
        >>> weights, data = make_stream("weights", 0), make_stream("data", 0)
        >>> weights.initial_seed() == data.initial_seed()
        False
    """
    (number,) = np.random.SeedSequence((seed, process, *purpose.encode())).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(number))

"""Layers that draw from a given generator: torch's initializers and dropout only use the process's default one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def use_generators(*generators: torch.Generator) -> Iterator[None]:
    """Replace the default generators of devices by given ones, and restore them afterwards.

    Default generators are global: other threads must not draw at the same time.

    Args:
        generators: one per device; each keeps the state that it has at the end of the block.
    """
    defaults = [_default(generator.device) for generator in generators]
    before = [default.get_state() for default in defaults]
    for default, generator in zip(defaults, generators, strict=True):
        default.set_state(generator.get_state())
    try:
        yield
    finally:
        for default, generator, state in zip(defaults, generators, before, strict=True):
            generator.set_state(default.get_state())
            default.set_state(state)


def _default(device: torch.device) -> torch.Generator:
    if device.type == "cpu":
        return torch.default_generator
    module = torch.get_device_module(device)
    return module.default_generators[module.current_device() if device.index is None else device.index]

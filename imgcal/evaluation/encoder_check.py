"""Does a network live on what its encoder says? The encoder's output is spoilt, and the error must rise.

A learned part that can be shuffled without harm is not there, whatever the error of the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.evaluation.methods import network_method
from imgcal.evaluation.metrics import reprojection_error
from imgcal.evaluation.protocol import Conditions, Sample, draw
from imgcal.messages import plural
from imgcal.networks import Network

LEAST_RISE = 3.0
"""Times the error of the untouched network, that each spoilt output must reach at least."""

Spoil = Callable[[Tensor, int], Tensor]
"""Replaces an encoder's output (rows, ...); arguments: output, and number of rigs, which have equally many rows."""


@dataclass(frozen=True)
class EncoderCheck:
    """Median RE (pixels) of a network alone, after its last pass."""

    untouched: float
    shuffled: float  # each rig gets what the encoder said of another one, camera by camera
    zeroed: float
    noise: float  # in place of the output, of its mean and spread

    @property
    def rise(self) -> float:
        """How much the error rises where spoiling hurts least: 1 = not at all."""
        return min(self.shuffled, self.zeroed, self.noise) / max(self.untouched, 1e-12)

    @property
    def used(self) -> bool:
        """Tell whether the network needs its encoder."""
        return self.rise >= LEAST_RISE


def check_encoder(network: Network, conditions: Conditions, count: int = 64, seed: int = 0) -> EncoderCheck | None:
    """Shuffle, zero and replace by noise what `network.encoder` returns, and measure what becomes of the error.

    Args:
        network: in evaluation mode, on whatever device it is.
        conditions: what rigs are drawn from, and how their views are corrupted.
        count: rigs, at least two: there is nothing to shuffle with one.
        seed: of the rigs and of the noise.

    Returns:
        None where the network has no encoder.

    Raises:
        InputError: fewer than two rigs.

    Examples:
        >>> import imgcal
        >>> from imgcal.networks import load_checkpoint
        >>> from imgcal.io import data_path
        >>> points = load_checkpoint(data_path("models", "points-O10-cube8.safetensors"))
        >>> check_encoder(points.network, Conditions(points.rig, points.obj), count=2) is None  # positions come in
        True
    """
    if count < 2:
        raise InputError(f"encoder check: found {plural(count, 'rig')}, expected two or more")
    encoder = network.encoder
    if encoder is None:
        return None
    sample = draw(conditions, count, torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(seed)

    def noise(output: Tensor, rigs: int) -> Tensor:
        drawn = torch.randn(output.shape, generator=generator).to(output)
        return output.mean() + output.std() * drawn

    def after(spoil: Spoil | None) -> float:
        with _replace_output(encoder, spoil) as announce:
            return _median_error(network, sample, announce)

    return EncoderCheck(after(None), after(_shuffle), after(_zero), after(noise))


def _shuffle(output: Tensor, rigs: int) -> Tensor:
    """Give each rig the output of its neighbour."""
    if len(output) % rigs:
        raise ValueError(
            f"encoder: found an output of {len(output)} rows for {rigs} rigs, expected equally many for each"
        )
    return output.unflatten(0, (rigs, -1)).roll(1, 0).flatten(0, 1)


def _zero(output: Tensor, rigs: int) -> Tensor:
    return torch.zeros_like(output)


@contextmanager
def _replace_output(encoder: nn.Module, spoil: Spoil | None) -> Iterator[Callable[[int], None]]:
    """Replace what an encoder returns; yields a function to call with the number of rigs that come next."""
    rigs = [1]

    def announce(count: int) -> None:
        rigs[0] = count

    def hook(module: nn.Module, inputs: Any, output: Any) -> Any:
        return output if spoil is None else _change_tensors(output, lambda tensor: spoil(tensor, rigs[0]))

    handle = encoder.register_forward_hook(hook)
    try:
        yield announce
    finally:
        handle.remove()


def _change_tensors(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Change every tensor of real numbers in nested tuples, lists and dictionaries."""
    if isinstance(value, Tensor):
        return change(value) if value.is_floating_point() else value
    if isinstance(value, dict):
        return {key: _change_tensors(part, change) for key, part in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(_change_tensors(part, change) for part in value))
    if isinstance(value, tuple | list):
        return type(value)(_change_tensors(part, change) for part in value)
    return value


def _median_error(network: Network, sample: Sample, announce: Callable[[int], None]) -> float:
    method = network_method(network)
    size = method.batch or len(sample)
    errors = []
    for rows in _slices(len(sample), size):
        announce(rows.stop - rows.start)
        predicted = method.predict(sample.given(rows)).cameras_from_object
        truth = sample.truth[rows].cameras_from_object
        errors.append(reprojection_error(predicted, truth, sample.conditions.obj))
    return float(torch.cat(errors).nan_to_num(torch.inf).median())


def _slices(count: int, size: int) -> list[slice]:
    """Split so that no part has a single rig, which could not be shuffled."""
    parts = -(-count // size)
    edges = [count * part // parts for part in range(parts + 1)]
    return [slice(*pair) for pair in pairwise(edges)]

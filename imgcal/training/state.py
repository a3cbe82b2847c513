"""The state of a run in a file, so that a killed run continues exactly where it stopped."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.io import read_json, read_tensors, write_tensors
from imgcal.messages import shorten
from imgcal.training.experiment import Experiment

FORMAT = "imgcal-training/1"

# Keys that may change in a continuation: they affect its length and reports, not what it computes.
FREE = {("name",), ("description",), ("paper",)} | {
    ("training", name)
    for name in ("steps", "minutes", "log_every", "validate_every", "validation_rigs", "patience", "save_every")
}


@dataclass(frozen=True)
class TrainingState:
    """Everything that the rest of a run depends on."""

    tensors: dict[str, dict[str, Tensor]]  # by part: network, average, best, optimizer, random, window
    values: dict[
        str, Any
    ]  # plain: step, elapsed, processes, files, optimizer's settings, schedule, judged, metrics, best
    experiment: Experiment


def save_state(path: str | Path, state: TrainingState) -> None:
    """Write a state in one step; if the disk is full, the previous one survives.

    Raises:
        InputError: the file cannot be written.
    """
    tensors = {f"{part}/{name}": tensor for part, named in state.tensors.items() for name, tensor in named.items()}
    texts = {"values": json.dumps(state.values), "experiment": json.dumps(state.experiment.model_dump(mode="json"))}
    write_tensors(path, tensors, FORMAT, texts)


def load_state(path: str | Path, experiment: Experiment) -> TrainingState:
    """Load a state for a continuation.

    Raises:
        InputError: not a state, a damaged file, a pickle, or the state of another experiment.
    """
    tensors, texts = read_tensors(path, FORMAT)
    try:
        values, saved = read_json(texts["values"]), read_json(texts["experiment"])
        if not isinstance(values, dict) or not isinstance(saved, dict):
            raise ValueError("no mapping")
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: found no readable state in it: the file is damaged") from error
    try:  # keys newer than the state get their defaults
        saved = type(experiment).model_validate(saved, strict=False).model_dump(mode="json")
    except ValueError as error:
        name = shorten(str(saved.get("name", "unnamed")))
        raise InputError(
            f"{path}: found the state of another kind of experiment ({name}), expected one of {experiment.name}"
        ) from error
    named = {name: saved.get(name) for name in values.get("files", {})}  # compares their content, not their paths
    difference = first_difference(saved, experiment.model_dump(mode="json") | named)
    if difference:
        key, was, now = difference
        raise InputError(f"{path}: {key}: found {now}, expected {was} as before; --resume cannot change it")
    parts: dict[str, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        part, name = key.split("/", 1)
        parts.setdefault(part, {})[name] = tensor
    return TrainingState(parts, values, experiment)


def first_difference(
    saved: Mapping[str, Any], found: Mapping[str, Any], place: tuple[str, ...] = ()
) -> tuple[str, Any, Any] | None:
    """Find the first value that differs but must not: its key, the old and the new value."""
    for name in (*saved, *(name for name in found if name not in saved)):
        here = (*place, name)
        was, now = saved.get(name), found.get(name)
        if here in FREE or was == now:
            continue
        if isinstance(was, Mapping) and isinstance(now, Mapping):
            deeper = first_difference(was, now, here)
            if deeper:
                return deeper
            continue
        return ".".join(here), was, now
    return None


def random_states(generator: torch.Generator, dropout: Iterable[torch.Generator]) -> dict[str, Tensor]:
    """States of the data's generator, and of the layers' generators by device."""
    return {"data": generator.get_state()} | {own.device.type: own.get_state() for own in dropout}


def restore_random_states(
    generator: torch.Generator, dropout: Iterable[torch.Generator], states: Mapping[str, Tensor]
) -> None:
    """Invert `random_states`."""
    generator.set_state(states["data"].cpu())
    for own in dropout:
        if own.device.type in states:
            own.set_state(states[own.device.type].cpu())

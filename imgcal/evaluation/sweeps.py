"""Error against one condition: perturbation, angle, noise, missing, swapped or false fiducials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from imgcal.errors import InputError
from imgcal.evaluation.methods import Method
from imgcal.evaluation.protocol import Conditions, Evaluation, Progress, Protocol, evaluate
from imgcal.io import nearest
from imgcal.synthesis import RelativeDrift


def _set_kappa(conditions: Conditions, value: float) -> Conditions:
    return replace(conditions, drift=RelativeDrift(value, value))


def _set_phi(conditions: Conditions, value: float) -> Conditions:
    return replace(conditions, pose_range=replace(conditions.pose_range, phi_deg=(value, value)))


def _corruption_setter(kind: str) -> Callable[[Conditions, float], Conditions]:
    return lambda conditions, value: replace(conditions, corruption=replace(conditions.corruption, **{kind: value}))


@dataclass(frozen=True)
class Axis:
    """One condition that is varied."""

    label: str  # with unit
    values: tuple[float, ...]
    at: Callable[[Conditions, float], Conditions]


AXES: dict[str, Axis] = {
    "kappa": Axis("perturbation kappa", (0.0, 0.0125, 0.025, 0.05, 0.1), _set_kappa),
    "phi": Axis("angle from the zenith phi (deg)", (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0), _set_phi),
    "noise": Axis("noise (px)", (0.0, 0.05, 0.1, 0.2, 0.5, 1.0), _corruption_setter("noise")),
    "missing": Axis("share of missing fiducials", (0.0, 0.1, 0.2, 0.3, 0.4), _corruption_setter("missing")),
    "swapped": Axis("share of swapped labels", (0.0, 0.05, 0.1, 0.2, 0.3), _corruption_setter("swapped")),
    "false": Axis("share of false blobs", (0.0, 0.05, 0.1, 0.2, 0.3), _corruption_setter("false")),
}


@dataclass(frozen=True)
class Sweep:
    """Evaluations along one axis."""

    axis: str
    values: tuple[float, ...]
    evaluations: tuple[Evaluation, ...]


def sweep(
    methods: Mapping[str, Method],
    conditions: Conditions,
    axis: str,
    protocol: Protocol,
    values: Sequence[float] | None = None,
    progress: Progress = lambda rigs: None,
    mapped: Callable[..., Iterator[Any]] = map,
) -> Sweep:
    """Evaluate along one axis, with everything else, and the random numbers, the same.

    Refinement gets the spread of the drift at each point; networks stay what they were trained for.

    Args:
        methods: by name.
        conditions: everything but what is varied.
        axis: a key of `AXES`.
        protocol: how many rigs at every point.
        values: None = those of the axis.
        progress: see `evaluate`.
        mapped: see `evaluate`.

    Raises:
        InputError: unknown axis.
    """
    if axis not in AXES:
        raise InputError(f"sweep: found {axis!r}, expected one of {', '.join(AXES)}{nearest(axis, AXES)}")
    chosen = AXES[axis].values if values is None else tuple(values)
    found = tuple(evaluate(methods, AXES[axis].at(conditions, value), protocol, progress, mapped) for value in chosen)
    return Sweep(axis, chosen, found)

"""Summarize the results of a fleet, each kind of rig by itself."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.errors import InputError, RefusedError
from imgcal.fleet.dataset import Dataset
from imgcal.fleet.drift_information import DriftInformation
from imgcal.fleet.learnt_prior import LearntPrior, Trend, learn_prior
from imgcal.fleet.manifest import HOURS
from imgcal.messages import list_names, plural
from imgcal.types import PINHOLE, parameter_names

COLUMNS = (
    "device", "capture", "time", "status", "given", "cameras", "lenses", "prior_std", "unit", "whitened_offset",
    "information_factor", "inflation",
)  # fmt: skip
LENS = "brown_conrady"
"""Of all cameras in results from before lenses were written."""


@dataclass(frozen=True)
class KindOfRig:
    """Devices whose rigs have the same cameras, with the same lens models: the last calibration of each."""

    cameras: tuple[str, ...]
    lenses: tuple[str, ...]  # lens model of each camera
    devices: tuple[str, ...]  # D
    drift: DriftInformation  # (D)
    given: Mapping[str, NDArray[np.float64]]  # (D) numbers that every device has
    lacking: Mapping[str, tuple[str, ...]]  # of numbers that only some have: the devices without

    def parameter_name(self, trend: Trend) -> str:
        """Name of the value that a trend is of; "-" where the camera's lens has none."""
        lens = self.lenses[self.cameras.index(trend.camera)]
        return parameter_names([lens], self.drift.parameters - len(PINHOLE))[trend.parameter]

    def learn(self, covariates: Sequence[str] = (), *, by_camera: bool = False) -> LearntPrior:
        """Learn the prior; see `learn_prior`.

        Raises:
            InputError: a covariate that not every device has.
            RefusedError: too few devices.
        """
        chosen = {name: self.covariate(name) for name in covariates}
        return learn_prior(self.drift, hours=self.given.get(HOURS), covariates=chosen, by_camera=by_camera)

    def covariate(self, name: str) -> NDArray[np.float64]:
        """Return the numbers (D) of this name.

        Raises:
            InputError: not every device has one.
        """
        if name in self.lacking:
            raise InputError(f"--covariates {name}: {self.explain_lacking(name)}")
        if name not in self.given:
            known = list_names(self.given) or "there are none"
            raise InputError(f"--covariates: found {name}, expected numbers that every row has: {known}")
        return self.given[name]

    def explain_lacking(self, name: str) -> str:
        """Say which devices lack a number that others have."""
        without = self.lacking[name]
        others = plural(len(self.devices) - len(without), "other device")
        return f"found none for {list_names(without)}, but one for {others}"


def rig_kinds(dataset: Dataset) -> list[KindOfRig]:
    """Read the calibrations of a fleet, most frequent kind of rig first.

    Raises:
        InputError: there are no results.
    """
    table = dataset.latest(COLUMNS)
    rows: dict[tuple[tuple[str, str], ...], dict[str, dict[str, Any]]] = {}
    for row in table.to_pylist():
        if row["status"] != "ok":
            continue
        lenses = row.get("lenses") or [LENS] * len(row["cameras"])
        devices = rows.setdefault(tuple(zip(row["cameras"], lenses, strict=True)), {})
        name = row["device"] or row["capture"]
        before = devices.get(name)
        if before is None or _moment(before) <= _moment(row):
            devices[name] = row
    return [_kind(cameras, devices) for cameras, devices in sorted(rows.items(), key=lambda item: -len(item[1]))]


def refusals(dataset: Dataset) -> list[tuple[str, str, int]]:
    """Status, first words of the reason, and how many captures: most frequent first."""
    table = dataset.latest(("status", "reason")).to_pydict()
    counts = Counter(
        (status, reason.partition(":")[0]) for status, reason in zip(table["status"], table["reason"], strict=True)
    )
    return [(status, reason, number) for (status, reason), number in counts.most_common()]


def _moment(row: Mapping[str, Any]) -> datetime.datetime:
    found = row["time"]
    return datetime.datetime.min.replace(tzinfo=datetime.UTC) if found is None else found


def _kind(named: Sequence[tuple[str, str]], devices: Mapping[str, Mapping[str, Any]]) -> KindOfRig:
    cameras, lenses = tuple(name for name, _ in named), tuple(lens for _, lens in named)
    rows = list(devices.values())
    columns = [dict(row["given"] or ()) for row in rows]
    names = sorted({name for column in columns for name in column})
    pairs = [*zip(devices, columns, strict=True)]
    lacking = {name: tuple(device for device, column in pairs if name not in column) for name in names}
    given = {name: np.array([column[name] for column in columns]) for name in names if not lacking[name]}
    parts = [_information(cameras, rows[first : first + 256]) for first in range(0, len(rows), 256)]
    drift = DriftInformation.concatenate(parts)
    return KindOfRig(cameras, lenses, tuple(devices), drift, given, {n: some for n, some in lacking.items() if some})


def _information(cameras: tuple[str, ...], rows: Sequence[Mapping[str, Any]]) -> DriftInformation:
    column = {
        name: torch.tensor(np.array([row[name] for row in rows]), dtype=torch.float64)
        for name in ("whitened_offset", "prior_std", "unit", "inflation", "information_factor")
    }
    size = column["unit"].shape[1]
    factor = torch.zeros(len(rows), size, size, dtype=torch.float64)
    upper = torch.triu_indices(size, size)
    if column["information_factor"].shape[1] != upper.shape[1]:
        raise RefusedError("fleet: the results are of another version of imgcal; run the fleet again")
    factor[:, upper[0], upper[1]] = column["information_factor"]
    return DriftInformation.from_whitened(
        cameras, factor.mT @ factor, column["whitened_offset"], column["prior_std"], column["unit"], column["inflation"]
    )

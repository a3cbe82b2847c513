"""The latest snapshots that a filter has absorbed, in a form in which changes of a camera are found quickly.

All of them share one chart: errors of the rig in units, with an arbitrary origin. The belief before any snapshot is the
belief before the first one plus the information of those in between. When the filter ages its belief, a new such base
is added.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import displace
from imgcal.geometry import RigidTransform
from imgcal.monitoring.case import Snapshot
from imgcal.monitoring.change_test import (
    CHANGES,
    MODEL_ERROR,
    ChangeTest,
    Comparison,
    OwnTest,
    camera_change_errors,
    pixel_changes,
)
from imgcal.monitoring.recent_screening import add_error, add_row, put, screen
from imgcal.monitoring.rig_arrays import RigArrays
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.monitoring.snapshot_information import SnapshotInformation, add_blocks
from imgcal.types import CameraRig, Observations

KEPT_SNAPSHOTS = 64
"""Number of snapshots within which a change must show: one second at 60 a second."""
MOST_BASES = 8
"""Maximum number of times that the belief may have aged within them."""
SCREENED_AGES = np.array((2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64))
"""Numbers of latest snapshots to screen."""
PRINCIPAL_POINT = CHANGES["principal_point"].start
PARTS = np.array([(part.start, part.stop) for part in CHANGES.values()])


@dataclass
class _Base:
    """The knowledge before a snapshot."""

    number: int  # number of the snapshot
    information: Tensor  # (D, D)
    weighted: Tensor  # (D,) information times the error of the most probable rig
    own: bool = False  # no belief shares these arrays


@dataclass(frozen=True)
class _Seen:
    observations: Observations
    rig_from_object: RigidTransform
    seconds: float  # since the previous snapshot


class RecentSnapshots:
    """A ring of the latest `KEPT_SNAPSHOTS` snapshots."""

    STATE: ClassVar = {
        "belief": ("_belief", RigBelief),
        "walk": ("walk", Tensor),
        "lasting": ("lasting", Tensor | float),
        "carried": ("_carried", NDArray[np.float64]),
        "border": ("_border", NDArray[np.float64]),
        "weighted": ("_weighted", NDArray[np.float64]),
        "totals": ("_totals", tuple[NDArray[np.float64], NDArray[np.float64]]),
        "pixels": ("_pixels", Tensor),
        "seen": ("_seen", deque[_Seen]),
        "bases": ("_bases", list[_Base]),
        "next": ("_next", int),
        "aged": ("_aged", bool),
        "rig": ("_rig", RigArrays),
        "error": ("_at", NDArray[np.float64]),
        "change": ("_change", Tensor),
    }

    def __init__(self, belief: RigBelief, walk: Tensor, lasting: Tensor | float = MODEL_ERROR) -> None:
        """Start empty.

        Args:
            belief: the filter's.
            walk: (C, K) standard deviation of the drift of every value in an hour.
            lasting: (C,) px, see `NoiseCorrelation.model_error`.
        """
        (cameras, free), wide = belief.unit.shape, len(belief.factor)
        self.walk, self._belief = walk, belief
        self.lasting = lasting
        self._unit = belief.unit.numpy()
        self._carried = np.zeros((KEPT_SNAPSHOTS, belief.pose_freedom, wide))
        self._border = np.zeros((KEPT_SNAPSHOTS, wide - cameras * free, wide))
        self._weighted = np.zeros((KEPT_SNAPSHOTS, wide))  # gradient, converted to the chart's origin
        self._ring = (self._carried, self._border, self._weighted)
        blocks = (KEPT_SNAPSHOTS + 1, cameras, free, free)
        self._totals = (np.zeros(blocks), np.zeros(blocks))  # rounding error after a year: 10^-7 of a snapshot
        self._pixels = pixel_changes(belief.rig)
        self._begin(belief.rig, belief.object_offset)

    def _begin(self, rig: CameraRig, object_offset: Tensor) -> None:
        """Start empty, with the chart's origin at a rig."""
        self._seen: deque[_Seen] = deque()
        self._bases: list[_Base] = []
        self._next = 0  # number of the next snapshot
        for total in self._totals:
            total[0] = 0.0
        self._aged = True  # the next snapshot needs a base
        self._rig = RigArrays.of(rig)  # the last rig passed to `_error` ...
        self._at = np.zeros_like(self._weighted[0])  # ... and its error
        self._at[self._unit.size :] = object_offset.numpy()
        self._change = camera_change_errors(rig, torch.from_numpy(self._unit))

    def resume(self) -> None:
        """Rebuild the ring from a saved state.

        Raises:
            ValueError: the shapes are inconsistent.
        """
        self._unit = self._belief.unit.numpy()
        (cameras, free), wide = self._unit.shape, len(self._belief.factor)
        blocks = (KEPT_SNAPSHOTS + 1, cameras, free, free)
        expected = {
            (KEPT_SNAPSHOTS, self._belief.pose_freedom, wide): (self._carried,),
            (KEPT_SNAPSHOTS, wide - cameras * free, wide): (self._border,),
            (KEPT_SNAPSHOTS, wide): (self._weighted,), blocks: self._totals, (wide,): (self._at,),
            (cameras, free, free): (self._change,), (cameras, free): (self.walk, self._pixels),
        }  # fmt: skip
        bases = all(base.information.shape == (wide, wide) and base.weighted.shape == (wide,) for base in self._bases)
        numbers = [base.number for base in self._bases]
        snapshots = (one.observations.seen.shape[:2] == (1, cameras) for one in self._seen)
        if not (
            bases and all(snapshots) and len(self) <= KEPT_SNAPSHOTS and len(self) <= self._next
            and numbers == sorted(numbers) and all(0 <= number <= self._next for number in numbers)
            and all(tuple(array.shape) == shape for shape, arrays in expected.items() for array in arrays)
        ):  # fmt: skip
            raise ValueError("recent snapshots of another rig")
        self._ring = (self._carried, self._border, self._weighted)

    def __len__(self) -> int:
        return len(self._seen)

    def clear(self) -> None:
        """Forget all snapshots."""
        self._seen.clear()
        self._bases, self._aged = [], True

    def append(self, result: MeasurementUpdate, observations: Observations, seconds: float) -> None:
        """Add a snapshot that has just been absorbed.

        Args:
            result: the filter's.
            observations: (1, C, N).
            seconds: since the previous snapshot.
        """
        while len(self._seen) >= KEPT_SNAPSHOTS or len(self._bases) >= MOST_BASES:
            self._drop()
        if self._aged or self._belief is not result.before:
            before = self._error(result.before.arrays, result.before.object_offset)
            information = result.before.information
            self._bases.append(_Base(self._next, information, information @ before))
            self._change = camera_change_errors(result.before.rig, result.before.unit)
        self._put(result.brought, 0, self._error(result.brought.arrays, result.brought.object_offset))
        self._seen.append(_Seen(observations, result.rig_from_object, seconds))
        self._follow(result.belief)
        self._aged = False

    def relinearize(self, result: MeasurementUpdate) -> None:
        """Relinearize the snapshots at their joint estimate; `result` may include earlier ones."""
        brought, before, seen = result.brought, result.before, self._seen
        while len(seen) > len(brought):  # beyond the filter's horizon
            seen.popleft()
        self._begin(brought.rig, brought.object_offset)
        origin = torch.from_numpy(self._at.copy())
        information = before.information
        weighted = information @ (origin + brought.distance_from(before.rig, before.object_offset))
        first = len(brought) - len(seen)
        if first:
            earlier = brought.select(slice(0, first))
            gained = earlier.information()
            information, weighted = information + gained, weighted + earlier.pull.sum(0) + gained @ origin
        self._bases = [_Base(0, information, weighted)]
        for s, entry in enumerate(seen):
            self._put(brought, first + s, origin)
            self._seen.append(entry)
        self._follow(result.belief)

    def replace(self, snapshots: Sequence[Snapshot], pauses: Sequence[float], result: MeasurementUpdate) -> None:
        """Forget all snapshots, and add some with their joint update; `pauses`: s before each of them."""
        self._seen = deque(_Seen(*snapshot, pause) for snapshot, pause in zip(snapshots, pauses, strict=True))
        self.relinearize(result)

    def rebase(self, belief: RigBelief, information: Tensor) -> None:
        """Replace the belief by another one that includes these snapshots; its `information` (D, D) is not aged."""
        at = self._follow(belief)
        brought, weighted = self._sums(0, self._next)
        self._bases = [_Base(self._next - len(self), information - brought, information @ at - weighted)]
        self._aged = True

    def latest(self, age: int) -> tuple[list[Snapshot], list[float]]:
        """The latest `age` snapshots, and the seconds before each."""
        return [(entry.observations, entry.rig_from_object) for entry in list(self._seen)[-age:]], self.pauses(age)

    def seconds(self, age: int) -> float:
        """Seconds since the snapshot before the latest `age` ones."""
        return sum(self.pauses(age))

    def pauses(self, age: int) -> list[float]:
        """Seconds before each of the latest `age` snapshots."""
        return [entry.seconds for entry in list(self._seen)[-age:]]

    def screen(self) -> NDArray[np.float64]:
        """Score the change of each camera since each of `SCREENED_AGES`: (ages, C), the largest of any kind."""
        scores = np.empty((len(SCREENED_AGES), len(self._change)))
        known = (self._at, self._change.contiguous().numpy(), PARTS)
        screen(self._ring, self._totals, self._next, len(self), *known, SCREENED_AGES, scores)
        return scores

    def test(self, age: int, aged: bool = True, without: range = range(0)) -> ChangeTest:
        """Test for changes before the latest `age` snapshots.

        Args:
            age: number of snapshots.
            aged: allow for all drift since then at once.
            without: range of these snapshots to leave out, counted from the first.

        Raises:
            RefusedError: nothing is known about the rig.
        """
        return self._compare(age, aged, without).test_together()

    def test_each(self, age: int) -> OwnTest:
        """Test each camera for a change before the latest `age` snapshots, allowing for all drift since then at once.

        Raises:
            RefusedError: nothing is known about the rig.
        """
        return self._compare(age).test_each()

    def _compare(self, age: int, aged: bool = True, without: range = range(0)) -> Comparison:
        """Compare the latest snapshots with the belief before them; arguments as `test`."""
        number = self._next - age
        information, factor, at = self._belief_before(number)
        brought, weighted = self._sums(number, self._next)
        if without:
            left_out = self._sums(number + without.start, number + without.stop)
            brought, weighted = brought - left_out[0], weighted - left_out[1]
        variance = self.walk.square() * (self.seconds(age) / 3600)
        if aged and bool(variance.any()):
            covariance = torch.cholesky_inverse(factor)
            add_blocks(covariance, (self._change * variance[:, None, :]) @ self._change.mT)
            information = torch.cholesky_inverse(_cholesky(covariance))
        return Comparison(information, brought, weighted - brought @ at, self._change, self._pixels, self.lasting)

    def score_without_episode(self, age: int, camera: int, kind: str, episode: int) -> tuple[float, float]:
        """Score a camera's change without the episode that supports it most, treating everything else as known.

        Args:
            age: snapshots since the change.
            camera: its number.
            kind: of `CHANGES`.
            episode: successive snapshots that a passing error may last.

        Returns:
            Chi-squared, and the equivalent image shift (px, RMS); zeros if all snapshots may be one episode.
        """
        number, part = self._next - age, CHANGES[kind]
        if age <= episode:
            return 0.0, 0.0
        *_, at = self._belief_before(number)
        own, pull = [], []
        row = slice(camera * self._unit.shape[1], (camera + 1) * self._unit.shape[1])
        change = self._change[camera, :, part]
        for k in range(number, self._next):
            brought, weighted = self._sums(k, k + 1)
            pull.append(change.mT @ (weighted - brought @ at)[row])
            own.append(change.mT @ brought[row, row] @ change)
        pulls, blocks = _all_but(torch.stack(pull), episode), _all_but(torch.stack(own), episode)
        least = 1e-9 * torch.stack(own).sum(0).diagonal().clamp_min(1e-30).diag()
        score = float((pulls * torch.linalg.solve(blocks + least, pulls[..., None])[..., 0]).sum(-1).min())
        total = self._totals[0]
        gained = total[self._next % len(total)][camera] - total[number % len(total)][camera]
        # The weight of all labels of the camera.
        weight = gained[PRINCIPAL_POINT, PRINCIPAL_POINT] / self._unit[camera, PRINCIPAL_POINT] ** 2
        return score, math.sqrt(max(score, 0.0) / max(weight, 1e-12))

    def belief_before(self, age: int) -> RigBelief:
        """The belief before the latest `age` snapshots.

        Raises:
            RefusedError: nothing was known about the rig.
        """
        _, factor, at = self._belief_before(self._next - age)
        wide = self._unit.size
        error = (at - torch.from_numpy(self._at))[:wide].view(self._unit.shape)
        rig = displace(self._belief.rig, error * self._belief.unit)
        return replace(self._belief, rig=rig, object_offset=at[wide:], factor=factor)

    def information(self, count: int) -> tuple[Tensor, Tensor]:
        """Information (D, D) of the latest snapshots, and their gradient (D,) at the current belief."""
        information, weighted = self._sums(self._next - count, self._next)
        return information, weighted - information @ torch.from_numpy(self._at)

    def _belief_before(self, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """Information (D, D) before a snapshot, its Cholesky factor, and the most probable error (D,)."""
        base = next(base for base in reversed(self._bases) if base.number <= number)
        brought, weighted = self._sums(base.number, number)
        information, weighted = base.information + brought, base.weighted + weighted
        factor = _cholesky(information)
        return information, factor, torch.cholesky_solve(weighted[:, None], factor)[:, 0]

    def _sums(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Information (D, D) and weighted errors (D,) of a range of snapshots."""
        first = max(first, self._next - len(self))
        rows = np.arange(first, last) % KEPT_SNAPSHOTS
        carried = torch.from_numpy(self._carried[rows].reshape(-1, self._at.size))
        information = -(carried.mT @ carried)
        total = self._totals[0]
        add_blocks(information, torch.from_numpy(total[last % len(total)] - total[first % len(total)]))
        wide = self._unit.size
        if self._border.shape[1]:
            border = torch.from_numpy(self._border[rows].sum(0))
            information[wide:] += border
            information[:wide, wide:] += border[:, :wide].mT
        return information, torch.from_numpy(self._weighted[rows].sum(0))

    def _put(self, brought: SnapshotInformation, number: int, at: Tensor) -> None:
        """Write a snapshot's information, linearized at an error, into the ring."""
        parts = (brought.camera, brought.carried, brought.border, brought.pull)
        put(self._ring, self._totals, self._next, tuple(part[number].numpy() for part in parts), at.numpy())
        self._next += 1

    def _drop(self) -> None:
        """Forget the oldest snapshot: the knowledge before the others absorbs it."""
        base = self._bases[0]
        if len(self._bases) > 1 and self._bases[1].number == base.number + 1:
            self._bases.pop(0)
        else:
            if not base.own:  # the belief shares this array
                base.information, base.own = base.information.clone(), True
            add_row(self._ring, self._totals, base.number, base.information.numpy(), base.weighted.numpy())
            base.number += 1
        self._seen.popleft()

    def _follow(self, belief: RigBelief) -> Tensor:
        """Remember the current belief, and return its error."""
        self._belief = belief
        return self._error(belief.arrays, belief.object_offset)

    def _error(self, rig: RigArrays, object_offset: Tensor) -> Tensor:
        """Error (D,) of a rig in the chart."""
        wide = self._unit.size
        add_error(rig.parts, self._rig.parts, self._unit, self._at[:wide].reshape(self._unit.shape))
        self._rig = rig
        self._at[wide:] = object_offset.numpy()
        return torch.from_numpy(self._at.copy())


def _all_but(values: Tensor, width: int) -> Tensor:
    """Sums of values (S, ...) without each of the S - width + 1 windows of `width` successive ones."""
    sums = torch.cat((torch.zeros_like(values[:1]), values.cumsum(0)))
    return sums[-1] - (sums[width:] - sums[:-width])


def _cholesky(matrix: Tensor) -> Tensor:
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool(failed):
        raise RefusedError("estimation: these observations do not determine the rig")
    return factor

"""Snapshots that show the object at one place count as one: errors that are the same there do not average.

The error of a blob has two parts. One differs from frame to frame, the other is the same as long as object and camera
stay where they are: where the marker's image lies in the grid of pixels, half of it hidden, an uneven light. If twenty
frames of one pose counted as independent, the second part would seem to be known twenty times as well as it is. The
frames of a rest are therefore averaged into one snapshot, also if the object comes back to that place later, as in the
hand of a robot. Only what differs between the frames is averaged away: with a blob's variance sigma^2 and the share q
of it that the differences show,

    sigma_mean^2 = sigma^2 (1 - q + q / frames).

Source: the variance of the mean of a cluster with intraclass correlation 1 - q (Kish, Survey Sampling, 1965).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from imgcal.association import Associations
from imgcal.medians import MEDIAN_SQUARED, RELATIVE_DEVIATION, median, median_of_known
from imgcal.messages import plural
from imgcal.monitoring import LEAST_MOTION, REST_SIGMAS, count_independent, show_the_same
from imgcal.types import Observations

JOINING_SIGMAS = 8.0
"""Standard deviations by which the median distance of blobs may exceed its expectation in snapshots that join a rest:
among hundreds of frames, some differ by more."""
REMEMBERED = 8
"""Number of latest rests that a snapshot may belong to: those before it, if a frame of another kind came between."""

PAIRS_AT_ONCE = 10_000
"""Snapshots that are compared at a time."""

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Rests:
    """Snapshots that were averaged with others."""

    snapshots: tuple[tuple[str, str], ...] = ()  # their names, and those of the snapshots that stand for them

    @classmethod
    def of(cls, labelled: Associations) -> Rests:
        """List them."""
        names, moments = [snapshot.name for snapshot in labelled.snapshots], labelled.moments
        moving = set(moments[labelled.used].tolist())  # of several objects, some may rest
        rests = {names[row]: names[at] for row, at in labelled.rests_with.items() if int(moments[row]) not in moving}
        return cls(tuple(rests.items()))

    @property
    def values(self) -> dict[str, Any]:
        """Values for scripts."""
        return {"snapshots": dict(self.snapshots), "note": str(self)}

    def __str__(self) -> str:
        """Summary for people; empty if there are none."""
        if not self.snapshots:
            return ""
        count, places = len(self.snapshots), len({of for _, of in self.snapshots})
        return (
            f"{plural(count, 'snapshot')} {'shows' if count == 1 else 'show'} the object where {places} other"
            f"{'s do' if places > 1 else ' does'}, at rest or back at that place: they are averaged, and each place "
            "counts as one snapshot"
        )


def average_rests(labelled: Associations, observations: Observations) -> tuple[Associations, Observations, Rows]:
    """Average the snapshots of each rest.

    Args:
        labelled: S used snapshots, in chronological order.
        observations: of these, (S, C, N).

    Returns:
        The snapshots, in which one of each rest is used and the others refer to it; the observations of the R used
        ones; their indices (R,) among the S.
    """
    groups, uv, sigma, seen = _group(labelled, observations)
    if len(groups) == len(uv):
        return labelled, observations, np.arange(len(uv))
    share = _share_of_flicker(uv, sigma, seen, groups)
    shown = seen.sum((1, 2))
    kept = np.array([group[shown[group].argmax()] for group in groups])
    uv, sigma = uv.copy(), sigma.copy()
    for row, group in zip(kept, groups, strict=True):
        if len(group) > 1:
            uv[row], sigma[row] = _average(uv[group], sigma[group], seen[group], share)
    order = np.argsort(kept)
    kept, groups = kept[order], [groups[i] for i in order]
    used = labelled.used
    rests = {used[other]: used[row] for row, group in zip(kept, groups, strict=True) for other in group if other != row}
    averaged = Observations(torch.from_numpy(uv[kept]), torch.from_numpy(sigma[kept]), observations.seen[kept])
    return replace(labelled, rests_with=dict(sorted(rests.items()))), averaged, kept


def weaken_rests(labelled: Associations, observations: Observations) -> Observations:
    """Increase sigma of the snapshots of each rest, so that all together count as much as their average.

    For tests of the snapshots one by one: arguments as for `average_rests`.
    """
    groups, uv, sigma, seen = _group(labelled, observations)
    if len(groups) == len(uv):
        return observations
    share, factor = _share_of_flicker(uv, sigma, seen, groups), np.ones(len(uv))
    for group in groups:
        factor[group] = len(group) / count_independent(np.array(float(len(group))), share)
    return replace(observations, sigma=observations.sigma * torch.from_numpy(factor).sqrt()[:, None, None])


def _group(labelled: Associations, observations: Observations) -> tuple[list[Rows], Floats, Floats, NDArray[np.bool_]]:
    """Numbers of the snapshots of each rest, single ones included, and the observations as arrays."""
    uv, sigma, seen = observations.uv.numpy(), observations.sigma.numpy(), observations.seen.numpy()
    together = int(np.bincount(labelled.moments[labelled.used]).max()) if len(uv) else 1
    first = find_rests(uv, sigma, seen, labelled.part_of_rows, together)
    return [np.flatnonzero(first == row) for row in np.unique(first)], uv, sigma, seen


def find_rests(uv: Floats, sigma: Floats, seen: NDArray[np.bool_], part: Rows, together: int = 1) -> Rows:
    """Find snapshots that show the object where an earlier one does, within their noise.

    Args:
        uv: (S, C, N, 2) pixels.
        sigma: (S, C, N) pixels.
        seen: (S, C, N).
        part: (S,) the object in each.
        together: largest number of snapshots of one moment, if several objects or markers are in view.

    Returns:
        (S,) the first snapshot of each one's rest; its own number if the object has moved.
    """
    camera = int(seen.sum((0, 2)).argmax())
    first = _find_rests_in_a_row(uv, sigma, seen, part, together, camera)
    places = np.flatnonzero(first == np.arange(len(uv)))
    earliest = places[_find_returns(uv[places], sigma[places], seen[places], part[places], camera)]
    return np.asarray(earliest[np.searchsorted(places, first)])


def _find_rests_in_a_row(
    uv: Floats, sigma: Floats, seen: NDArray[np.bool_], part: Rows, together: int, most: int
) -> Rows:
    """Find rests that began a few snapshots before; as `find_rests`, with the camera that sees most."""
    count = len(uv)
    first, asked = np.arange(count), np.zeros(count, dtype=np.bool_)
    near, far = min(together + 2, count), min(REMEMBERED * together + 1, count)
    for cameras in (slice(most, most + 1), slice(None)):  # one camera first: most captures have no rest
        own = uv[:, cameras], sigma[:, cameras], seen[:, cameras]
        pairs = (_are_alike(*_apart(lag), own[0], own[1], own[2], REST_SIGMAS) for lag in range(1, near))
        if not any(alike.any() for alike in pairs):
            return first
    for lag in range(1, far):  # somebody may pass between
        asked[lag:] |= _are_alike(*_apart(lag), uv, sigma, seen, JOINING_SIGMAS)
    rests: deque[int] = deque(maxlen=REMEMBERED * together)
    for row in range(count):
        if asked[row]:
            earlier = np.array([rest for rest in rests if part[rest] == part[row]], dtype=np.int64)
            alike = earlier[_are_alike(np.array([row]), earlier, uv, sigma, seen, JOINING_SIGMAS)]
            if len(alike):
                first[row] = alike[-1]
                continue
        rests.append(row)
    return first


def _find_returns(uv: Floats, sigma: Floats, seen: NDArray[np.bool_], part: Rows, camera: int) -> Rows:
    """Find rests at the place of an earlier one, however long before; arguments and result as for `find_rests`.

    One label of a camera gives the candidates: the one that is seen most often.
    """
    first = np.arange(len(uv))
    label = int(seen[:, camera].sum(0).argmax())
    rows = np.flatnonzero(seen[:, camera, label])
    if len(rows) < 2:
        return first
    reach = 2 * REST_SIGMAS * float(median(sigma[rows, camera, label])) + LEAST_MOTION
    pairs = rows[cKDTree(uv[rows, camera, label]).query_pairs(reach, output_type="ndarray")]
    earlier, later = pairs.min(1), pairs.max(1)
    order = np.lexsort((earlier, later))
    for some in np.array_split(order, len(order) // PAIRS_AT_ONCE + 1):
        before, after = earlier[some], later[some]
        same = _are_alike(after, before, uv, sigma, seen, REST_SIGMAS) & (part[before] == part[after])
        for row, other in zip(after[same].tolist(), before[same].tolist(), strict=True):
            if first[row] == row:
                first[row] = first[other]
    return first


def _apart(lag: int) -> tuple[slice, slice]:
    """All snapshots with one that many before, and those."""
    return slice(lag, None), slice(None, -lag)


def _are_alike(
    some: slice | Rows, others: slice | Rows, uv: Floats, sigma: Floats, seen: NDArray[np.bool_], sigmas: float
) -> NDArray[np.bool_]:
    """Tell which pairs of snapshots show the same within the noise: half of the labels of every camera, at least."""
    apart, variance = np.square(uv[some] - uv[others]).sum(-1), sigma[some] ** 2 + sigma[others] ** 2
    most = np.maximum(seen[some].sum((1, 2)), seen[others].sum((1, 2)))
    return show_the_same(apart, variance, seen[some] & seen[others], most, sigmas)


def _share_of_flicker(uv: Floats, sigma: Floats, seen: NDArray[np.bool_], groups: list[Rows]) -> float:
    """Share of the blobs' variance that differs between the frames of a rest, at most 1."""
    before = np.concatenate([group[:-1] for group in groups])
    after = np.concatenate([group[1:] for group in groups])
    both = seen[before] & seen[after]
    apart = np.square(uv[after] - uv[before]).sum(-1)[both] / (sigma[before] ** 2 + sigma[after] ** 2)[both]
    return min(1.0, median(apart) / MEDIAN_SQUARED * (1 + RELATIVE_DEVIATION / len(apart) ** 0.5))


def _average(uv: Floats, sigma: Floats, seen: NDArray[np.bool_], share: float) -> tuple[Floats, Floats]:
    """Average the frames of a rest, without labels that are elsewhere in some.

    Args:
        uv: (F, C, N, 2) pixels.
        sigma: (F, C, N) pixels.
        seen: (F, C, N).
        share: of the variance that differs between frames.

    Returns:
        (C, N, 2) pixels and (C, N) pixels; zero and one where nothing was seen.
    """
    where = np.where(seen[..., None], uv, np.nan)
    middle = np.nan_to_num(median_of_known(where))
    variance = np.where(seen, sigma**2, 0.0)
    far = np.square(uv - middle).sum(-1) > REST_SIGMAS**2 * MEDIAN_SQUARED * variance + LEAST_MOTION**2
    taken = seen & ~far
    taken |= seen & ~taken.any(0)
    count = np.maximum(taken.sum(0), 1)
    mean = np.where(taken[..., None], uv, 0.0).sum(0) / count[..., None]
    own = np.where(taken, variance, 0.0).sum(0) / count / count_independent(count.astype(np.float64), share)
    return mean, np.where(taken.any(0), np.sqrt(own), 1.0)

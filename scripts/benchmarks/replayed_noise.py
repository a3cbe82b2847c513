"""Replay residuals of real cameras by a block bootstrap, which keeps their correlation in time and among markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import accepted_observations, associate
from imgcal.errors import InputError
from imgcal.estimation import estimate
from scripts.benchmarks.wand_recording import CALIBRATED, calibrated, recording
from scripts.output import WORK, make_folder

Floats = NDArray[np.float64]

BLOCK = (60, 240)
"""Range of the frames per block; correlations in the recording vanish beyond 60 frames."""
BRIDGED = 10
"""Longest gap, in frames, in a camera's residuals that is filled; a longer one ends a run."""
LEAST_RUN = 20
"""Frames of the shortest run that is replayed; blocks continue from run to run."""
SHARING = 3
"""Least number of markers in a frame to compute their common shift."""
LAGS = (1, 5, 20, 60)
"""Lags, in frames, at which correlations are reported."""
POSE = 6
"""Number of values fitted to each frame, which reduce its residuals."""
CACHE = WORK / "wand_residuals.npz"


@dataclass(frozen=True)
class Series:
    """Residuals of one camera: runs of consecutive frames without gaps, in the order of time, one after another."""

    residual: Floats  # (F, N, 2) pixels, N markers

    def __post_init__(self) -> None:
        """Refuse a camera with too few residuals.

        Raises:
            InputError: fewer frames than in the shortest block.
        """
        if len(self.residual) < BLOCK[0]:
            raise InputError(f"residuals: found {len(self.residual)} frames in runs, expected at least {BLOCK[0]}")


def series_of(residual: Floats, generator: np.random.Generator) -> Series:
    """Fill short gaps in a camera's residuals, and split them at long gaps.

    A missing residual is the sum of the common shift of the frame's markers, interpolated if unknown, and a random
    deviation that some marker had from that shift at another time.

    Args:
        residual: (F, N, 2) pixels, nan where a marker was not seen.
        generator: draws the deviations.
    """
    known = ~np.isnan(residual[..., 0])
    frames = np.flatnonzero(known.sum(1) >= min(SHARING, residual.shape[1]))
    shift = np.full((len(residual), 2), np.nan)
    shift[frames] = np.nanmean(residual[frames], 1)
    deviations = (residual - shift[:, None])[known & ~np.isnan(shift[:, :1])]
    runs = []
    for run in np.split(frames, np.flatnonzero(np.diff(frames) > BRIDGED + 1) + 1):
        if len(run) == 0 or run[-1] - run[0] + 1 < LEAST_RUN:
            continue
        every = np.arange(run[0], run[-1] + 1)
        there = np.stack([np.interp(every, run, shift[run, axis]) for axis in range(2)], -1)
        drawn = deviations[generator.integers(len(deviations), size=(len(every), residual.shape[1]))]
        runs.append(np.where(known[every][..., None], residual[every], there[:, None] + drawn))
    return Series(np.concatenate(runs) if runs else residual[:0])


@dataclass
class Replay:
    """Endless residuals for the cameras of a rig; each replays one real camera, in blocks of random length."""

    sources: Sequence[Series]  # C
    markers: int  # of the object; markers beyond those of the series get only their camera's shift
    generator: np.random.Generator
    _left: list[Floats] = field(default_factory=list, repr=False)  # rest of each camera's block

    def __post_init__(self) -> None:
        self._left = [self._block(camera) for camera in range(len(self.sources))]

    def draw(self, frames: int) -> Floats:
        """Draw the next frames: (F, C, N, 2) pixels."""
        return np.stack([self._drawn(camera, frames) for camera in range(len(self.sources))], 1)

    def _drawn(self, camera: int, frames: int) -> Floats:
        parts, missing = [], frames
        while missing:
            if not len(self._left[camera]):
                self._left[camera] = self._block(camera)
            parts.append(self._left[camera][:missing])
            self._left[camera] = self._left[camera][missing:]
            missing -= len(parts[-1])
        return np.concatenate(parts)

    def _block(self, camera: int) -> Floats:
        """Draw a block (F, N, 2) of one camera; all frames are equally probable."""
        block = self._piece(camera, int(self.generator.integers(*BLOCK)))
        count = self.markers - block.shape[1]
        if count <= 0:
            return block[:, : self.markers]
        other = self._piece(camera, len(block))
        own = other[np.arange(len(block)) % len(other)]
        more = (own - own.mean(1, keepdims=True))[:, np.arange(count) % own.shape[1]] + block.mean(1, keepdims=True)
        return np.concatenate((block, more), 1)

    def _piece(self, camera: int, length: int) -> Floats:
        residual = self.sources[camera].residual
        begin = int(self.generator.integers(len(residual)))
        return np.take(residual, np.arange(begin, begin + length), axis=0, mode="wrap")


def statistics(residual: Floats) -> dict[str, Any]:
    """Spread and correlations of the residuals of one camera.

    Args:
        residual: (F, N, 2) pixels, nan where not seen.

    Returns:
        RMS per axis and standard deviation of the common shift of all markers, in pixels, without a tenth at each end;
        the latter for independent markers; correlations of shifts and of single markers `LAGS` frames apart.
    """
    known = ~np.isnan(residual[..., 0])
    several = known.sum(1) >= SHARING
    shift = np.full((len(residual), 2), np.nan)
    shift[several] = np.nanmean(residual[several], 1)
    share = np.nanmean(1 / known.sum(1)[several])
    spread = _spread(residual[known])
    own = (residual - shift[:, None])[known & several[:, None]]
    unbiased = np.sqrt(1 / max(1 - share, 1e-9))  # the mean removes a share of each marker's residual
    return {
        "spread_px": spread,
        "shift_px": _spread(shift[several]),
        "independent_px": float(_spread(own) * unbiased * np.sqrt(share)),
        "shift_correlation": {str(lag): _correlation(shift, lag) for lag in LAGS},
        "marker_correlation": {
            str(lag): float(np.nanmean([_correlation(residual[:, n], lag) for n in range(residual.shape[1])]))
            for lag in LAGS
        },
    }


def _spread(values: Floats) -> float:
    """Standard deviation from the range of the middle four fifths, assuming a normal distribution."""
    low, high = np.quantile(values, (0.1, 0.9))
    return float((high - low) / 2.5631)


def _correlation(series: Floats, lag: int) -> float:
    """Autocorrelation at a lag of a series (F, 2) with nan where unknown, over both axes."""
    limit = 4 * _spread(series[~np.isnan(series)])
    clean = np.clip(series - np.nanmedian(series, 0), -limit, limit)
    first, second = clean[:-lag], clean[lag:]
    both = ~np.isnan(first[:, 0]) & ~np.isnan(second[:, 0])
    if both.sum() < 30:
        return float("nan")
    return float((first[both] * second[both]).mean() / np.nanmean(clean**2))


@lru_cache(maxsize=1)
def recorded_residuals() -> Floats:
    """Residuals (F, C, N, 2) px of the recorded wand in consecutive frames, nan where not seen; cached in `out/work`.

    The rig is fixed to the calibration and the poses are fitted; residuals are scaled up for the six fitted values.
    """
    if CACHE.is_file():
        with np.load(CACHE) as file:
            kept: Floats = file["residual"]
        return kept
    given, known = recording(), calibrated()
    calibration, frames = known.calibration, range(CALIBRATED.stop)
    labelled = associate(given.chosen(frames), calibration.rig, calibration.object.as_exact())
    observations, poses = accepted_observations(labelled, calibration.rig, calibration.object.as_exact())
    fixed = torch.zeros(calibration.rig.num_cameras, calibration.rig.num_parameters, dtype=torch.float64)
    fit = estimate(observations, calibration.rig, calibration.object.as_exact(), poses, prior_std=fixed)
    seen = observations.seen.numpy()
    values = 2.0 * seen.sum((1, 2))
    back = np.sqrt(values / np.maximum(values - POSE, 1.0))
    sound = values >= 4 * POSE  # enough markers that the pose does not overfit
    numbers = np.array([int(labelled.snapshots[s].name) for s in labelled.used])
    residual = np.full((len(frames), *seen.shape[1:], 2), np.nan)
    seen &= sound[:, None, None]
    residual[numbers] = np.where(seen[..., None], fit.residual.numpy() * back[:, None, None, None], np.nan)
    make_folder(CACHE.parent)
    np.savez_compressed(CACHE, residual=residual)
    return residual


def recorded_series(seed: int = 0) -> list[Series]:
    """Make one series for each camera of the recorded wand that has long runs."""
    residual, generator = recorded_residuals(), np.random.default_rng(seed)
    found = []
    for camera in range(residual.shape[1]):
        try:
            found.append(series_of(residual[:, camera], generator))
        except InputError:
            continue
    return found

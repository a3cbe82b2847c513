"""The drift prior of a fleet by empirical Bayes: spreads that make what all its calibrations saw most probable.

Each device is its factory values plus a drift from a Gaussian whose variances are looked for, seen through its images:
their likelihood is Gaussian with the information L and the score h of `DriftInformation`. With S the drift's variance,
the precision of what was seen is M = (S + 1 / L)^-1 and g = M (offset seen) its whitened place, both without inverting
L, which is singular. Variances that are linear in what is looked for, a constant and a part that grows with time, are
found by Fisher scoring; cameras that do not belong to any Gaussian of that size are found by the score test, and left
out. Estimates of the devices themselves would be shrunk towards the old prior; their spread would say so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from imgcal.errors import InputError, RefusedError
from imgcal.fleet.drift_information import KINDS, DriftInformation
from imgcal.types import PARAMETER_KINDS, DriftRate, RigPrior, limits

SIGMAS = 5.0
"""Standard deviations (two-sided) outside the fleet's spread from which a camera is an outlier."""
LEAST_KNOWN = 0.01
"""Part of a direction's prior variance that the images must take away for the direction to be tested."""
LEAST_INFORMATION = 1e-4
"""Fisher information of a variance, relative to its size: with less, even its order of magnitude is not known."""
LEAST_DEVICES = 8
ROUNDS = 4
"""Of leaving outliers out and learning again."""
STEPS = 50
AT_ONCE = 128  # devices
FREED = 1e6
"""Factor on the variance of a camera that is left out."""
BOUNDS = 1e-12, 1e6
MEAN = "mean"
"""Of the trends: the offset that all devices have at the covariates' means."""


@dataclass(frozen=True)
class Spread:
    """One standard deviation of one kind of value over the fleet."""

    kind: str
    camera: str | None  # None = all cameras alike
    value: float  # rad, mm, relative, pixels, or one; where the images say nothing of it, what the search began with
    sigma: float  # one standard deviation of it, inf where the images say nothing
    rate: float = 0.0  # of a random walk, in the same unit after an hour; 0 where no times were given
    rate_sigma: float = 0.0

    def variance(self, hours: float) -> float:
        """Variance of a device of this age."""
        return self.value**2 + self.rate**2 * hours


@dataclass(frozen=True)
class Trend:
    """How a value depends on something that was measured, such as temperature."""

    covariate: str
    camera: str
    parameter: int  # of the camera, in the order of `CameraRig.parameter_names_of`
    slope: float  # rad, mm, relative, pixels or one, for each unit of the covariate
    sigma: float


@dataclass(frozen=True)
class OutlierCamera:
    """A camera of a device that is farther from its factory values than the fleet's spread explains."""

    device: int  # its row
    camera: str
    sigmas: float  # of a Gaussian, as improbable as its score
    kind: str  # that says most


@dataclass(frozen=True)
class LearntPrior:
    """What a fleet teaches about its drift."""

    spreads: tuple[Spread, ...]
    outliers: tuple[OutlierCamera, ...]
    trends: tuple[Trend, ...]
    standardized: Tensor  # (D, P) offsets over what they scatter by, unit normal if all this is right; nan = not seen
    hours: float | None = None  # mean age of the devices; None = not given

    def prior(self) -> RigPrior:
        """The prior of a device of the fleet's mean age; if spreads were learned by camera, their mean square."""
        return RigPrior(**self._mean_square(lambda spread: spread.variance(self.hours or 0.0)))

    def drift_rate(self) -> DriftRate | None:
        """The rates for a rig file; None where no times were given."""
        return None if self.hours is None else DriftRate(**self._mean_square(lambda spread: spread.rate**2))

    def _mean_square(self, square: Callable[[Spread], float]) -> dict[str, float]:
        return {kind: float(np.mean([square(s) for s in self.spreads if s.kind == kind])) ** 0.5 for kind in KINDS}


@dataclass(frozen=True)
class _Model:
    """The variances to find; masks weighted with them add up to each parameter's variance."""

    masks: Tensor  # (K, P) of zeros and ones
    features: Tensor  # (K, D) factor of each device: 1, or hours
    names: tuple[tuple[str, str | None, bool], ...]  # kind, camera, grows with time

    def variance(self, theta: Tensor, rows: slice) -> Tensor:
        """Variance of each parameter of each device: (D, P)."""
        return torch.einsum("k,kd,kp->dp", theta, self.features[:, rows], self.masks)


@dataclass(frozen=True)
class _Seen:
    """Devices as seen from a supposed prior."""

    place: Tensor  # (D, P) g, whose covariance is `precision` where the prior is right
    precision: Tensor  # (D, P, P) M


def learn_prior(
    drift: DriftInformation,
    *,
    start: RigPrior = RigPrior(),
    hours: Sequence[float] | NDArray[np.float64] | None = None,
    covariates: Mapping[str, Sequence[float] | NDArray[np.float64]] | None = None,
    by_camera: bool = False,
) -> LearntPrior:
    """Learn how far devices of one kind drift.

    Args:
        drift: D devices, each seen by its own images.
        start: where the search begins; it has no other influence.
        hours: (D,) since the factory calibration; where they differ, the variance grows with them, and rates are
            learned, too.
        covariates: (D,) each, temperature for example: every parameter gets a mean and a slope, taken out before the
            spread.
        by_camera: learn a spread for each camera, not one for all.

    Returns:
        Spreads with their standard deviations, slopes, and the cameras that do not belong.

    Raises:
        InputError: values of another number than there are devices, not finite, or hours out of `limits.AGE`.
        RefusedError: too few devices, or the variances do not come to rest.
    """
    if len(drift) < LEAST_DEVICES:
        raise RefusedError(
            f"fleet: found {len(drift)} devices, expected at least {LEAST_DEVICES} to learn a prior from"
        )
    age = _column("hours", hours, len(drift))
    if age is not None and not limits.AGE.holds_all(age):
        wrong = age[~limits.AGE.holds(age)]
        raise InputError(f"hours: found {float(wrong[0]):g}, expected {limits.AGE}")
    if age is not None and bool((age <= age.min() + 1e-6 * age.abs().max()).all()):
        age = None  # nothing shows what has grown
    model = _model(drift, age, by_camera)
    given = {name: _column(name, values, len(drift)) for name, values in (covariates or {}).items()}
    centred = {name: values - values.mean() for name, values in given.items() if values is not None}
    if centred:  # where nothing has drifted, the covariate need not be at its mean
        centred = {MEAN: torch.ones(len(drift), dtype=torch.float64)} | centred
    theta = torch.tensor([getattr(start, kind) ** 2 for kind, _, _ in model.names], dtype=torch.float64)
    theta[torch.tensor([grows for *_, grows in model.names])] *= 0.1 / max(1e-9, float(model.features.amax()))
    begun = theta
    freed = torch.zeros(len(drift), len(drift.camera_names), dtype=torch.bool)
    for _ in range(ROUNDS):
        slopes, slope_sigma = _slopes(drift, model, theta, freed, centred)
        level = _remove_slopes(drift, centred, slopes)
        theta, fisher = _score_variances(level, model, theta, freed)
        found = _outliers(level, model, theta)
        now = torch.zeros_like(freed)
        for outlier in found:
            now[outlier.device, drift.camera_names.index(outlier.camera)] = True
        if bool((now == freed).all()):
            break
        freed = now
    spreads = _spreads(model, theta, _deviations(torch.maximum(theta, begun), fisher))
    trends = _trends(drift, centred, slopes, slope_sigma)
    standardized = torch.cat([standardize(level[rows], model.variance(theta, rows)) for rows in _batches(len(drift))])
    return LearntPrior(spreads, tuple(found), trends, standardized, None if age is None else float(age.mean()))


def outlier_cameras(drift: DriftInformation, prior: RigPrior) -> tuple[OutlierCamera, ...]:
    """Name the cameras that a prior does not explain, the worst of each device first.

    A score test, at five standard deviations of a Gaussian (two sides): of each kind of value, whatever its direction,
    and of all values of a camera together.

    Args:
        drift: D devices.
        prior: of the fleet, learned or known.
    """
    model = _model(drift, None, False)
    theta = torch.tensor([getattr(prior, kind) ** 2 for kind, _, _ in model.names], dtype=torch.float64)
    return tuple(_outliers(drift, model, theta))


def standardize(drift: DriftInformation, variance: Tensor) -> Tensor:
    """Divide each device's most probable offsets by what they scatter by if the prior's variances (D, P) are right.

    Returns:
        (D, P), standard normal over the fleet; nan where the images say next to nothing.
    """
    seen = _look(drift, variance)
    known = variance * seen.precision.diagonal(dim1=-2, dim2=-1)
    scaled = variance.sqrt() * seen.place / known.clamp_min(1e-12).sqrt()
    return torch.where(known > LEAST_KNOWN, scaled, torch.nan)


def _column(name: str, values: Sequence[float] | NDArray[np.float64] | None, count: int) -> Tensor | None:
    if values is None:
        return None
    column = torch.as_tensor(np.asarray(values, dtype=np.float64))
    if column.shape != (count,) or not bool(column.isfinite().all()):
        raise InputError(f"{name}: found {tuple(column.shape)} values, expected {count} finite ones, one a device")
    return column


def _model(drift: DriftInformation, hours: Tensor | None, by_camera: bool) -> _Model:
    cameras = len(drift.camera_names)
    masks, names, features = [], [], []
    for grows in (False,) if hours is None else (False, True):
        feature = torch.ones(len(drift), dtype=torch.float64) if hours is None or not grows else hours
        for kind, part in PARAMETER_KINDS.items():
            for camera in range(cameras) if by_camera else (None,):
                mask = torch.zeros(cameras, drift.parameters, dtype=torch.float64)
                mask[slice(None) if camera is None else camera, part] = 1.0
                masks.append(mask.flatten())
                names.append((kind, None if camera is None else drift.camera_names[camera], grows))
                features.append(feature)
    return _Model(torch.stack(masks), torch.stack(features), tuple(names))


def _batches(count: int) -> Iterator[slice]:
    return (slice(first, min(first + AT_ONCE, count)) for first in range(0, count, AT_ONCE))


def _variance_factor(freed: Tensor, parameters: int) -> Tensor:
    return torch.where(freed, FREED, 1.0).double().repeat_interleave(parameters, dim=-1)


def _look(drift: DriftInformation, variance: Tensor) -> _Seen:
    """Whiten devices (D) by a supposed prior variance (D, P)."""
    std = variance.sqrt()
    inner = std[:, :, None] * drift.information * std[:, None, :]
    inner.diagonal(dim1=-2, dim2=-1).add_(1.0)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(inner))
    place = (inverse @ (std * drift.score)[..., None])[..., 0] / std
    known = -inverse
    known.diagonal(dim1=-2, dim2=-1).add_(1.0)
    return _Seen(place, known / (std[:, :, None] * std[:, None, :]))


def _score_variances(drift: DriftInformation, model: _Model, theta: Tensor, freed: Tensor) -> tuple[Tensor, Tensor]:
    """Find the most probable variances (K,), and their Fisher information (K, K)."""
    for _ in range(STEPS):
        score, fisher = _score_and_fisher(drift, model, theta, freed)
        movable = (theta > BOUNDS[0]) | (score > 0)  # the others are as small as they may be, and would be smaller
        inverse = _invert(fisher, movable & (fisher.diagonal() > 0))
        step, sigma = inverse @ score, inverse.diagonal().clamp_min(0).sqrt()
        if bool((~movable | (step.abs() <= torch.maximum(0.01 * sigma, 1e-6 * theta))).all()):
            return theta, fisher
        theta = torch.clamp(theta + step, 0.1 * theta, 1e3 * theta).clamp(*BOUNDS)
    raise RefusedError(f"fleet: the spreads did not converge in {STEPS} steps; found {theta.sqrt().tolist()}")


def _invert(fisher: Tensor, used: Tensor) -> Tensor:
    """Inverse of an information matrix (K, K) of some values; zero for the others. Their units may be far apart."""
    whiten = torch.where(used, fisher.diagonal().clamp_min(1e-300).rsqrt(), 0.0)
    return whiten[:, None] * torch.linalg.pinv(whiten[:, None] * fisher * whiten, hermitian=True) * whiten


def _deviations(scale: Tensor, fisher: Tensor) -> Tensor:
    """Standard deviation of each variance (K,), inf where there is no information at its `scale` (K,)."""
    known = fisher.diagonal() * scale.square() > LEAST_INFORMATION
    return torch.where(known, _invert(fisher, known).diagonal().clamp_min(0).sqrt(), torch.inf)


def _score_and_fisher(drift: DriftInformation, model: _Model, theta: Tensor, freed: Tensor) -> tuple[Tensor, Tensor]:
    score, fisher = torch.zeros_like(theta), torch.zeros(len(theta), len(theta), dtype=torch.float64)
    for rows in _batches(len(drift)):
        factor = _variance_factor(freed[rows], drift.parameters)
        seen = _look(drift[rows], model.variance(theta, rows) * factor)
        parts = model.features[:, rows, None] * model.masks[:, None] * (factor == 1.0)  # (K, D, P)
        excess = seen.place.square() - seen.precision.diagonal(dim1=-2, dim2=-1)
        score += 0.5 * torch.einsum("kdp,dp->k", parts, excess)
        fisher += 0.5 * torch.einsum("kdp,dpq,ldq->kl", parts, seen.precision.square(), parts)
    return score, fisher


def _slopes(
    drift: DriftInformation, model: _Model, theta: Tensor, freed: Tensor, covariates: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor]:
    """Generalized least squares of every parameter's slope: (Q, P) and their standard deviations."""
    size, count = drift.score.shape[1], len(covariates)
    if not count:
        return torch.zeros(0, size, dtype=torch.float64), torch.zeros(0, size, dtype=torch.float64)
    z = torch.stack(list(covariates.values()))  # (Q, D)
    normal = torch.zeros(count, size, count, size, dtype=torch.float64)
    right = torch.zeros(count, size, dtype=torch.float64)
    for rows in _batches(len(drift)):
        seen = _look(drift[rows], model.variance(theta, rows) * _variance_factor(freed[rows], drift.parameters))
        normal += torch.einsum("qd,dij,rd->qirj", z[:, rows], seen.precision, z[:, rows])
        right += torch.einsum("qd,di->qi", z[:, rows], seen.place)
    square = normal.reshape(count * size, count * size)
    inverse = torch.linalg.pinv(square, hermitian=True, rtol=1e-9)  # a common motion has no slope
    slopes = (inverse @ right.flatten()).reshape(count, size)
    return slopes, inverse.diagonal().clamp_min(0).sqrt().reshape(count, size)


def _remove_slopes(drift: DriftInformation, covariates: Mapping[str, Tensor], slopes: Tensor) -> DriftInformation:
    """Take slopes out of what was seen."""
    if not covariates:
        return drift
    mean = torch.einsum("qd,qp->dp", torch.stack(list(covariates.values())), slopes)
    return replace(drift, score=drift.score - (drift.information @ mean[..., None])[..., 0])


def _outliers(drift: DriftInformation, model: _Model, theta: Tensor) -> list[OutlierCamera]:
    """Find cameras out of the spread: of each device the worst first, until what is left belongs."""
    found: list[OutlierCamera] = []
    for rows in _batches(len(drift)):
        part, variance = drift[rows], model.variance(theta, rows)
        freed = torch.zeros(len(part), len(drift.camera_names), dtype=torch.bool)
        open_rows = torch.arange(len(part))
        while len(open_rows):
            sigmas, kinds = _surprise(part[open_rows], variance[open_rows], freed[open_rows])
            worst = sigmas.argmax(1)
            far = sigmas.gather(1, worst[:, None])[:, 0] > SIGMAS
            for row, camera in zip(open_rows[far].tolist(), worst[far].tolist(), strict=True):
                place = int((open_rows == row).nonzero()[0])
                name = drift.camera_names[camera]
                sigma, kind = float(sigmas[place, camera]), KINDS[int(kinds[place, camera])]
                found.append(OutlierCamera(rows.start + row, name, sigma, kind))
                freed[row, camera] = True
            open_rows = open_rows[far]
            open_rows = open_rows[~freed[open_rows].all(1)]
    return sorted(found, key=lambda outlier: (outlier.device, -outlier.sigmas))


def _surprise(drift: DriftInformation, variance: Tensor, freed: Tensor) -> tuple[Tensor, Tensor]:
    """How many standard deviations (D, C) each camera is out of the spread, and the kind that says most (D, C).

    Each kind of value is tested by itself and all of a camera together; the least probable one counts, corrected
    for the number of tests.
    """
    cameras = freed.shape[1]
    variance = variance * _variance_factor(freed, drift.parameters)
    seen, std = _look(drift, variance), variance.sqrt()
    blocks = (len(drift), cameras, drift.parameters)
    place = (seen.place * std).reshape(blocks)
    whole = (seen.precision * std[:, :, None] * std[:, None, :]).reshape(*blocks, cameras, drift.parameters)
    known = whole.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)  # (D, C, 15, 15)
    tested = (*PARAMETER_KINDS.values(), slice(None))
    log_p = np.stack([_log_p(place[..., part], known[..., part, part]) for part in tested], -1)
    least = np.minimum(log_p.min(-1) + np.log(log_p.shape[-1]), 0.0)
    sigmas = torch.from_numpy(stats.norm.isf(np.exp(np.maximum(least, -700.0)) / 2))
    return torch.where(freed, 0.0, sigmas), torch.from_numpy(log_p[..., :-1].argmin(-1))


def _log_p(place: Tensor, known: Tensor) -> NDArray[np.float64]:
    """Logarithm of how probable a place (..., n) as far out is, by its covariance (..., n, n) in units of the prior."""
    values, vectors = torch.linalg.eigh(known)
    along = (vectors.mT @ place[..., None])[..., 0]
    tested = values > LEAST_KNOWN
    chi2 = torch.where(tested, along.square() / values.clamp_min(LEAST_KNOWN), 0.0).sum(-1)
    log_p = stats.chi2.logsf(chi2.numpy(), np.maximum(tested.sum(-1).numpy(), 1))
    return np.where(tested.any(-1).numpy(), log_p, 0.0)


def _spreads(model: _Model, theta: Tensor, sigma: Tensor) -> tuple[Spread, ...]:
    found: dict[tuple[str, str | None], Spread] = {}
    for (kind, camera, grows), variance, error in zip(model.names, theta.tolist(), sigma.tolist(), strict=True):
        value = variance**0.5
        std = min(error / (2 * value), error**0.5)  # of the square root
        if grows:
            found[kind, camera] = replace(found[kind, camera], rate=value, rate_sigma=std)
        else:
            found[kind, camera] = Spread(kind, camera, value, std)
    return tuple(found.values())


def _trends(
    drift: DriftInformation, covariates: Mapping[str, Tensor], slopes: Tensor, sigma: Tensor
) -> tuple[Trend, ...]:
    return tuple(
        Trend(name, camera, parameter, *pair)
        for q, name in enumerate(covariates)
        for c, camera in enumerate(drift.camera_names)
        for parameter in range(drift.parameters)
        for place in [c * drift.parameters + parameter]
        for pair in [(float(slopes[q, place]), float(sigma[q, place]))]
    )

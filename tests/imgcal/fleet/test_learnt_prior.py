"""Devices drawn from Gaussians: the learned prior agrees with the true one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import imgcal
from imgcal.fleet import DriftInformation, learn_prior, outlier_cameras
from imgcal.fleet.learnt_prior import standardize
from imgcal.types import RigPrior

TRUE = RigPrior(focal_length=0.004, principal_point=3.0, distortion=0.01, rotation=0.003, position=1.5)
CAMERAS = ("left", "middle", "right")
SPREAD = torch.tensor(
    [TRUE.rotation] * 3 + [TRUE.position] * 3 + [TRUE.focal_length] * 2 + [TRUE.principal_point] * 2
    + [TRUE.distortion] * 5, dtype=torch.float64,
).repeat(3)  # fmt: skip


def seen_through(offset: Tensor, seed: int) -> DriftInformation:
    """Random directions of each device are measured, each about as well as its spread; three never are."""
    generator = torch.Generator().manual_seed(seed)
    devices, size = offset.shape
    rows = torch.randn(devices, 40, size, generator=generator, dtype=torch.float64) / SPREAD / size**0.5
    rows[:, :, :3] -= (rows[:, :, :3] + rows[:, :, 15:18] + rows[:, :, 30:33]) / 3  # the mean rotation is not seen
    noise = torch.randn(devices, 40, generator=generator, dtype=torch.float64)
    measured = torch.einsum("drp,dp->dr", rows, offset) + 0.3 * noise
    return DriftInformation(CAMERAS, rows.mT @ rows / 0.09, torch.einsum("drp,dr->dp", rows, measured) / 0.09)


def offsets(devices: int, seed: int = 0) -> Tensor:
    return torch.randn(devices, 45, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * SPREAD


def test_spreads_are_found_wherever_the_search_begins() -> None:
    drift = seen_through(offsets(200), 1)
    learnt = learn_prior(drift)
    for spread in learnt.spreads:
        true = getattr(TRUE, spread.kind)
        assert abs(spread.value - true) < 4 * spread.sigma
        assert spread.sigma < 0.08 * true
    assert not learnt.outliers
    far = learn_prior(drift, start=RigPrior(1.0, 300.0, 1.0, 0.3, 200.0))
    assert [s.value for s in far.spreads] == pytest.approx([s.value for s in learnt.spreads], rel=3e-3)
    assert learnt.prior().position == learnt.spreads[1].value


def test_standard_deviations_are_those_of_many_fleets() -> None:
    found = [learn_prior(seen_through(offsets(40, seed), 100 + seed)).spreads for seed in range(20)]
    errors = np.array([[(s.value - getattr(TRUE, s.kind)) / s.sigma for s in spreads] for spreads in found])
    assert 0.8 < float(np.sqrt(np.mean(errors**2))) < 1.2


def test_bumped_cameras_are_named_and_do_not_widen_the_prior() -> None:
    offset = offsets(200)
    bumped = {(10, "middle"), (77, "left"), (78, "right")}
    for device, camera in bumped:
        first = 15 * CAMERAS.index(camera)
        offset[device, first : first + 3] += 15 * TRUE.rotation
    learnt = learn_prior(seen_through(offset, 2))
    assert {(o.device, o.camera) for o in learnt.outliers} == bumped
    assert {o.kind for o in learnt.outliers} == {"rotation"}
    assert {(o.device, o.camera) for o in outlier_cameras(seen_through(offset, 2), TRUE)} == bumped
    assert abs(learnt.spreads[0].value - TRUE.rotation) < 4 * learnt.spreads[0].sigma


def test_rates_and_spreads_are_told_apart() -> None:
    hours = torch.linspace(0, 400, 250, dtype=torch.float64)
    offset = offsets(250) * (1 + 0.02 * hours)[:, None].sqrt()  # variance doubles in 50 hours
    for spread in learn_prior(seen_through(offset, 3), hours=hours.numpy()).spreads:
        true = getattr(TRUE, spread.kind)
        assert abs(spread.value - true) < 4 * spread.sigma
        assert abs(spread.rate - true * 0.02**0.5) < 4 * spread.rate_sigma


def test_the_prior_is_that_of_a_device_of_mean_age_and_the_offsets_are_judged_by_their_own() -> None:
    """A pure random walk: hardly any spread when new."""
    hours = torch.linspace(100, 1000, 250, dtype=torch.float64)
    drift = seen_through(offsets(250) * (hours / 550).sqrt()[:, None], 8)
    learnt = learn_prior(drift, hours=hours.numpy())
    rate = learnt.drift_rate()
    assert learnt.hours == pytest.approx(550) and rate is not None
    for kind, true in vars(TRUE).items():
        assert getattr(learnt.prior(), kind) == pytest.approx(true, rel=0.15)
        assert getattr(rate, kind) == pytest.approx(true / 550**0.5, rel=0.3)
    seen = learnt.standardized
    for part in (seen[:60], seen[-60:]):
        assert abs(float(part[part.isfinite()].std()) - 1) < 0.08


def test_ages_that_are_all_the_same_tell_no_rate() -> None:
    drift = seen_through(offsets(50), 9)
    learnt = learn_prior(drift, hours=[300.0] * 50)
    assert learnt.hours is None and learnt.drift_rate() is None
    assert learnt.spreads == learn_prior(drift).spreads


def test_what_no_image_shows_is_not_said_to_be_known() -> None:
    drift = seen_through(offsets(50), 10)
    shown = torch.ones(3, 15, dtype=torch.float64)
    shown[:, 10:] = 0  # nothing of distortion
    shown = shown.flatten()
    blind = replace(drift, information=shown[:, None] * drift.information * shown, score=shown * drift.score)
    found = {spread.kind: spread for spread in learn_prior(blind).spreads}
    assert found["distortion"].sigma == np.inf and found["distortion"].value == pytest.approx(RigPrior().distortion)
    assert all(0 < found[kind].sigma < 1 for kind in ("rotation", "position", "focal_length", "principal_point"))


def test_what_follows_the_temperature_is_taken_out() -> None:
    temperature = np.linspace(15.0, 35.0, 200)
    offset = offsets(200)
    offset[:, 6] += 0.002 * torch.from_numpy(temperature)  # fx of the first camera
    learnt = learn_prior(seen_through(offset, 4), covariates={"temperature": temperature})
    slope = next(t for t in learnt.trends if (t.covariate, t.camera, t.parameter) == ("temperature", "left", 6))
    assert abs(slope.slope - 0.002) < 4 * slope.sigma < 0.0015
    others = [
        t.slope / t.sigma for t in learnt.trends if t is not slope and t.covariate == "temperature" and t.sigma > 0
    ]
    assert max(map(abs, others)) < 4.5
    focal = learnt.spreads[2]
    assert abs(focal.value - TRUE.focal_length) < 4 * focal.sigma


def test_a_camera_of_its_own_gets_its_own_spread() -> None:
    offset = offsets(250)
    offset[:, 15 + 3 : 15 + 6] *= 3
    learnt = learn_prior(seen_through(offset, 5), by_camera=True)
    found = {(s.kind, s.camera): s for s in learnt.spreads}
    assert len(found) == 15
    for camera, factor in zip(CAMERAS, (1, 3, 1), strict=True):
        spread = found["position", camera]
        assert abs(spread.value - factor * TRUE.position) < 4 * spread.sigma


def test_offsets_by_the_right_prior_are_standard_normal() -> None:
    drift = seen_through(offsets(200), 6)
    learnt = learn_prior(drift)
    found = learnt.standardized
    assert abs(float(found[found.isfinite()].std()) - 1) < 0.03
    found = standardize(drift, (SPREAD / 2).square().expand(200, -1))
    assert float(found[found.isfinite()].std()) > 1.5


def test_too_few_devices_are_refused() -> None:
    with pytest.raises(imgcal.RefusedError, match="at least 8"):
        learn_prior(seen_through(offsets(7), 1))
    with pytest.raises(imgcal.InputError, match="expected 20 finite ones"):
        learn_prior(seen_through(offsets(20), 1), hours=[1.0] * 19)
    for wrong in (-1e5, 1e9):
        with pytest.raises(imgcal.InputError, match=r"hours: found .*, expected 0 to 1e\+06 h"):
            learn_prior(seen_through(offsets(20), 1), hours=[1.0] * 19 + [wrong])

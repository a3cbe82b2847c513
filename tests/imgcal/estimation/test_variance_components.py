"""Where a fit starts must not decide where it ends."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import PipelineOptions, associate
from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions, variance_components
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate, fit_labelled, fitting
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from scripts.benchmarks import merging_wands


def two_captures(rig, obj, noise=0.05):
    """Labelled detections of two snapshots of one drifted rig."""
    truth = simulate_truth(rig, obj, 2, torch.Generator().manual_seed(3), PhysicalDrift())
    table = true_detections(truth)
    table.uv[:] += noise * np.random.default_rng(3).standard_normal(table.uv.shape)
    table.sigma[:] = 0.05
    return table.of_snapshots(0, 1), table.of_snapshots(1, 2)


@pytest.mark.parametrize("noise", [0.05, 0.3])  # as the blobs say, and six times as much
def test_the_latest_result_is_a_start_and_no_more(noise, o10, asymmetric8):
    before, now = two_captures(o10, asymmetric8, noise)
    latest = calibrate(before, o10, asymmetric8)
    labelled = associate(now, o10, asymmetric8)
    fresh = fit_labelled(labelled, o10, asymmetric8)
    followed = fit_labelled(labelled, o10, asymmetric8, latest=latest)
    assert torch.equal(followed.observations.seen, fresh.observations.seen)
    assert followed.additive_noise == pytest.approx(fresh.additive_noise, rel=0.05)
    shift = followed.rig.local(fresh.rig).abs() / fresh.estimate.problem.prior_std[0]
    assert shift.max() < 0.02  # standard deviations of the prior: the solver stops where the cost falls by 1e-4


def test_the_latest_result_gives_way_where_a_label_does_not_fit(o10, asymmetric8):
    before, now = two_captures(o10, asymmetric8)
    latest = calibrate(before, o10, asymmetric8)
    now.uv[[5, 30, 61]] += (9.0, -7.0)
    labelled = associate(now, o10, asymmetric8)
    fresh = fit_labelled(labelled, o10, asymmetric8)
    followed = fit_labelled(labelled, o10, asymmetric8, latest=latest)
    assert fresh.outliers >= 3
    assert torch.equal(followed.observations.seen, fresh.observations.seen)
    torch.testing.assert_close(followed.rig.focal_length, fresh.rig.focal_length)


def hard(seed):
    """A rig of six that has drifted several times as far as its prior allows; heavy tails and many wrong labels."""
    random = np.random.default_rng(seed)
    rig, obj, far = read_rig("O6"), load_object("asymmetric8"), random.uniform(1, 6)
    drift = PhysicalDrift(0.57 * far, 10 * far, 0.02 * far, 10 * far, 0.02 * far)
    snapshots = int(random.choice([1, 2, 4, 8]))
    table = true_detections(simulate_truth(rig, obj, snapshots, torch.Generator().manual_seed(seed), drift))
    count = len(table)
    table.uv[:] += 0.05 * random.standard_t(2.5, size=(count, 2))
    table.sigma[:] = 0.05
    wrong = int(random.uniform(0.05, 0.2) * count)
    rows = random.choice(count, wrong, replace=False)
    table.uv[rows] += random.normal(size=(wrong, 2)) * random.choice([3, 10, 50])
    table.uv[:] = np.clip(table.uv, 0, [2047, 1087])
    return rig, obj, table


@pytest.mark.parametrize("seed", [44, 213])  # came to no rest within eight fits
def test_a_calibration_reports_the_residuals_of_the_rig_that_it_returns(seed) -> None:
    rig, obj, table = hard(seed)
    try:
        found = calibrate(table, rig, obj)
    except RefusedError:
        return
    points = found.rig_from_object.apply(found.points_object)
    uv = found.rig.expand(len(points)).project(points).uv
    difference = (uv - found.observations.uv - found.residual)[found.observations.seen]
    assert difference.abs().max() < 1e-6


def fits_made(monkeypatch) -> list[int]:
    """Number of fits of each calibration from now on, the latest last."""
    counts: list[int] = []
    estimate_variance_components, fit = fitting.estimate_variance_components, variance_components._Rounds._fit

    def counted(*args, **kwargs):
        counts[-1] += 1
        return fit(*args, **kwargs)

    def started(*args, **kwargs):
        counts.append(0)
        return estimate_variance_components(*args, **kwargs)

    monkeypatch.setattr(variance_components._Rounds, "_fit", counted)
    monkeypatch.setattr(fitting, "estimate_variance_components", started)
    return counts


def test_what_does_not_come_to_rest_is_refused_after_forty_fits(monkeypatch) -> None:
    """Captures whose labels leave and come back without end (of four hundred like these, a few need 38 fits or more).

    Which ones they are hangs on the last digits: most of these three, on any machine.
    """
    counts, endless = fits_made(monkeypatch), 0
    for seed in (493, 590, 645):
        rig, obj, table = hard(seed)
        with pytest.raises(RefusedError) as refusal:
            calibrate(table, rig, obj)
        said = f"do not converge in {variance_components.ROUNDS} fits" in str(refusal.value)
        assert max(counts) == variance_components.ROUNDS if said else max(counts) > 10
        endless += said
        counts.clear()
    assert endless >= 2


def test_a_fit_that_is_slow_to_converge_is_continued(o10, asymmetric8):
    labelled = associate(two_captures(o10, asymmetric8)[0], o10, asymmetric8)
    hasty = PipelineOptions(estimation=EstimationOptions(max_iterations=2))
    found, usual = fit_labelled(labelled, o10, asymmetric8, hasty), fit_labelled(labelled, o10, asymmetric8)
    shift = found.rig.local(usual.rig).abs() / usual.estimate.problem.prior_std[0]
    assert shift.max() < 0.02


def test_ordinary_captures_come_to_rest_in_a_few_fits(o10, asymmetric8, monkeypatch) -> None:
    counts = fits_made(monkeypatch)
    for noise in (0.05, 0.3):
        table, _ = two_captures(o10, asymmetric8, noise)
        assert (calibrate(table, o10, asymmetric8).additive_noise > 0) == (noise > 0.05)
    assert max(counts) <= 6


def noisier_than_it_says(rig, obj, noise):
    """A capture whose blobs are said to have a tenth of a pixel, with some wrong labels, and how many these are."""
    truth = simulate_truth(rig, obj, 12, torch.Generator().manual_seed(1), PhysicalDrift())
    table, random = true_detections(truth), np.random.default_rng(1)
    table.sigma[:] = 0.1
    table.uv[:] += noise * random.standard_normal(table.uv.shape)
    wrong = random.choice(len(table), len(table) // 50, replace=False)
    table.uv[wrong] += 30 * noise * np.array([0.6, -0.8])
    return table, len(wrong)


@pytest.mark.parametrize("noise", [0.3, 0.9])
def test_blobs_far_noisier_than_they_say_are_no_outliers(noise, o10, asymmetric8) -> None:
    table, wrong = noisier_than_it_says(o10, asymmetric8, noise)
    found = calibrate(table, o10, asymmetric8)
    assert found.outliers == pytest.approx(wrong, abs=3)
    assert np.hypot(0.1, found.additive_noise) == pytest.approx(noise, rel=0.1)


def test_more_noise_than_is_allowed_is_called_noise(o10, asymmetric8) -> None:
    table, _ = noisier_than_it_says(o10, asymmetric8, 1.5)
    with pytest.raises(RefusedError, match=r"of which 1\.5\d px are not noise of the blobs, expected at most 1"):
        calibrate(table, o10, asymmetric8)


def test_a_solution_of_another_problem_is_not_returned(o10, asymmetric8, monkeypatch) -> None:
    """The last check projects with the rig that is about to be returned."""
    table, _ = two_captures(o10, asymmetric8)
    estimate_variance_components = fitting.estimate_variance_components

    def prior_scale(*args, **kwargs):
        found = estimate_variance_components(*args, **kwargs)
        return replace(found, problem=replace(found.problem, prior_std=2 * found.problem.prior_std))

    monkeypatch.setattr(fitting, "estimate_variance_components", prior_scale)
    with pytest.raises(RefusedError, match="do not belong together"):
        calibrate(table, o10, asymmetric8)


def test_noise_that_is_barely_significant_comes_to_rest() -> None:
    """None is too little by a hair, and a little too much: the fits went to and fro between the two."""
    made, _ = merging_wands.capture(122)
    found = calibrate(made.detections, made.factory, made.obj)
    assert 0 < found.additive_noise < 0.01

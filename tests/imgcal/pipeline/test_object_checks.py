"""An object that differs from its file is estimated or refused, never silently accepted."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate, score
from imgcal.synthesis import PhysicalDrift, simulate_truth, simulate_volume, true_detections
from imgcal.types import RigPrior
from tests.imgcal.pipeline.short_search import SHORT

DRIFT = PhysicalDrift()
PRIOR = RigPrior(DRIFT.focal_length, DRIFT.principal_point, DRIFT.distortion, np.radians(DRIFT.rotation_deg), 2.0)


def capture(rig_name: str, snapshots: int, bend, seed: int = 0, noise: float = 0.05):
    """Factory rig, object as its file has it, true rig, true object, labelled detections."""
    rig = replace(read_rig(rig_name), prior=PRIOR)
    obj = load_object("wand4" if rig_name == "room10" else "asymmetric8")
    true = replace(obj, points=bend(obj.points.clone()))
    simulate = simulate_volume if rig_name == "room10" else simulate_truth
    truth = simulate(rig, true, snapshots, torch.Generator().manual_seed(seed), DRIFT)
    table = true_detections(truth)
    table.uv[:] += noise * np.random.default_rng(seed).standard_normal(table.uv.shape)
    table.sigma[:] = noise
    return rig, obj, truth.rig, true, table


def held_out(found, true_rig, true):
    """RMS (px) of a rig on another capture of the true rig with the true object."""
    simulate = simulate_volume if found.name == "room10" else simulate_truth
    later = simulate(true_rig, true, 10, torch.Generator().manual_seed(99), None)
    return float(score(true_detections(later), found, true).distances.square().mean().sqrt())


def scaled(factor):
    return lambda points: points.mean(0) + factor * (points - points.mean(0))


def moved(fiducial, by):
    def bend(points):
        points[fiducial] += torch.tensor(by, dtype=points.dtype)
        return points

    return bend


def longer_stem(points):
    points[3] *= 1.05
    return points


def stretched(factor):
    return lambda points: points * torch.tensor([1.0, 1.0, factor], dtype=points.dtype)


def right(points):
    return points


@pytest.mark.parametrize("snapshots", [1, 6])
@pytest.mark.parametrize("factor", [0.9, 1.1, 1.3])
@pytest.mark.parametrize("rig_name", ["O10", "U7", "T4"])
def test_another_scale_is_refused(rig_name: str, factor: float, snapshots: int) -> None:
    rig, obj, _, _, table = capture(rig_name, snapshots, scaled(factor))
    with pytest.raises(RefusedError, match=r"all cameras have moved together.*(larger|smaller) than its file says"):
        calibrate(table, rig, obj, SHORT)


def test_a_tolerance_of_the_scale_is_advised_only_where_it_can_be_given() -> None:
    rig, obj, _, _, table = capture("O10", 6, scaled(1.1))
    with pytest.raises(RefusedError, match="give its scale a tolerance") as single:
        calibrate(table, rig, obj)
    with pytest.raises(RefusedError, match="all cameras have moved together") as several:
        calibrate(table, rig, [obj, load_object("wand4")])
    assert "--object-scale-tolerance" in single.value.for_command
    assert "toleranc" not in several.value.for_command and "toleranc" not in str(several.value)
    assert several.value.for_command.endswith("than their files say; measure them again, and check their units")


def test_a_scale_that_may_be_off_is_estimated() -> None:
    rig, obj, *_, table = capture("O10", 6, scaled(1.05))
    found = calibrate(table, rig, replace(obj, scale_tolerance=0.1))
    centred = found.points_object - found.points_object.mean(0)
    scale = float(centred.norm() / (obj.points - obj.points.mean(0)).norm())
    assert scale == pytest.approx(1.05, abs=0.015)
    plain = calibrate(capture("O10", 6, right)[-1], rig, obj)
    assert plain.scale_sigma == pytest.approx(0.003, abs=0.002)  # what can be known of it, at these priors


@pytest.mark.parametrize("factor", [0.97, 1.01, 1.05])
def test_another_scale_that_may_be_off_displaces_no_fiducial(factor: float) -> None:
    rig, obj, *_, table = capture("O10", 8, scaled(factor))
    found = calibrate(table, rig, replace(obj, scale_tolerance=0.03))
    assert found.displaced == () and all(offset.distance < 0.01 for offset in found.shape)


@pytest.mark.parametrize("factor", [1.0, 1.01])
def test_a_displaced_fiducial_is_named_beside_a_scale_that_may_be_off(factor: float) -> None:
    rig, obj, *_, table = capture("O10", 8, lambda points: moved(5, (0.6, 0.8, 0))(scaled(factor)(points)))
    (only,) = calibrate(table, rig, replace(obj, scale_tolerance=0.03)).displaced
    assert only.fiducial == 5 and only.distance == pytest.approx(1.0, abs=4 * only.sigma) and only.sigma < 0.1


def test_the_tolerances_of_fiducials_are_learned_without_the_scale_that_may_be_off() -> None:
    tolerances = []
    for factor in (0.95, 1.0, 1.05):
        rig, obj, *_, table = capture("O10", 12, lambda points, by=factor: moved(5, (0.6, 0.8, 0))(scaled(by)(points)))
        found = calibrate(table, rig, replace(obj, scale_tolerance=0.05))
        tolerance = found.estimate.problem.object_prior_std[0, :-1:3]
        assert [offset.fiducial for offset in found.displaced] == tolerance.nonzero().flatten().tolist() == [5]
        tolerances.append(float(tolerance[5]))
    assert tolerances == pytest.approx([1 / 3**0.5] * 3, rel=0.03)


@pytest.mark.parametrize("snapshots", [1, 5])
@pytest.mark.parametrize("factor", [1.15, 1.3])
@pytest.mark.parametrize("rig_name", ["T4", "O10"])
def test_a_stretched_object_is_refused(rig_name: str, factor: float, snapshots: int) -> None:
    rig, obj, _, _, table = capture(rig_name, snapshots, stretched(factor))
    with pytest.raises(RefusedError):
        calibrate(table, rig, obj, SHORT)


@pytest.mark.parametrize(
    ("bend", "size"), [(moved(3, (0.6, 0.8, 0)), 1.0), (moved(1, (-3, 0, 4)), 5.0), (longer_stem, 17.5)]
)
def test_a_bent_wand_is_recovered_and_the_fiducial_named(bend, size: float) -> None:
    rig, obj, true_rig, true, table = capture("room10", 50, bend)
    found = calibrate(table, rig, obj)
    (only,) = found.displaced
    assert only.fiducial == int((true.points - obj.points).norm(dim=1).argmax())
    assert only.distance == pytest.approx(size, abs=4 * only.sigma) and only.sigma < 0.05
    assert found.outliers < 0.01 * len(table)
    # As good as with an object file that is right.
    known = calibrate(table, rig, true)
    assert held_out(found.rig, true_rig, true) < 1.1 * held_out(known.rig, true_rig, true) + 1e-3


def test_a_right_object_stays_exact_and_costs_nothing() -> None:
    for rig_name, snapshots in (("room10", 20), ("O10", 3), ("T4", 1)):
        rig, obj, _, _, table = capture(rig_name, snapshots, right)
        found = calibrate(table, rig, obj)
        assert found.estimate.problem.object_prior_std is None and found.shape == () and found.displaced == ()
        assert torch.equal(found.points_object, obj.points)


def jumping_cube(bend, seed: int = 0):
    """Unlabelled views of a cube that jumps: identity takes another of its 24 turns each time."""
    rig, obj = replace(read_rig("O10"), prior=PRIOR), load_object("cube8")
    true = replace(obj, points=bend(obj.points.clone()))
    truth = simulate_truth(rig, true, 3, torch.Generator().manual_seed(seed), DRIFT)
    table = true_detections(truth)
    table.uv[:] += 0.05 * np.random.default_rng(seed).standard_normal(table.uv.shape)
    table.sigma[:], table.fiducial[:] = 0.05, -1
    return rig, obj, table


def test_of_a_symmetric_object_nobody_says_which_fiducial_is_off() -> None:
    rig, obj, table = jumping_cube(right)
    found = calibrate(table, rig, obj)
    assert found.identity == "ambiguous" and found.displaced == () and found.estimate.problem.object_prior_std is None
    with pytest.raises(RefusedError, match="it is symmetric"):
        calibrate(table, rig, replace(obj, tolerance=torch.full((8,), 0.2, dtype=torch.float64)))
    rig, obj, table = jumping_cube(moved(1, (0.5, 0, 0)))
    with pytest.raises(RefusedError, match="the object is symmetric"):
        calibrate(table, rig, obj, SHORT)


def test_tolerated_displacements_are_not_named() -> None:
    named = 0
    for seed in range(12):
        generator = torch.Generator().manual_seed(seed)
        rig, obj, _, _, table = capture(
            "T4", 3, lambda p, g=generator: p + 0.2 * torch.randn(p.shape, generator=g, dtype=p.dtype), seed
        )
        found = calibrate(table, rig, replace(obj, tolerance=torch.full((8,), 0.2, dtype=torch.float64)))
        named += len(found.displaced)
    assert named == 0


@pytest.mark.parametrize("labelled", [True, False])
def test_a_rig_in_single_precision_gives_the_same(labelled: bool) -> None:
    rig, obj, _, _, table = capture("T4", 3, right)
    if not labelled:
        table = replace(table, fiducial=np.full(len(table), -1))
    found, single = calibrate(table, rig, obj), calibrate(table, rig.to(torch.float32), obj)
    assert (found.rig.focal_length - single.rig.focal_length).abs().max() < 0.05
    assert score(table, rig.to(torch.float32), obj).distances.isfinite().all()


def test_granted_tolerances_make_the_errors_honest() -> None:
    """Fiducials off by 0.2 mm at random: errors of the rig in units of what the covariance says."""
    from imgcal.estimation import relative_difference

    normalized = []
    for seed in range(8):
        generator = torch.Generator().manual_seed(100 + seed)
        rig, obj, true_rig, _, table = capture(
            "O10", 5, lambda p, g=generator: p + 0.2 * torch.randn(p.shape, generator=g, dtype=p.dtype), seed
        )
        found = calibrate(table, rig, replace(obj, tolerance=torch.full((8,), 0.2, dtype=torch.float64)))
        error = relative_difference(found.rig, true_rig).flatten()[15:]
        covariance = found.estimate.covariance()[15:, 15:]
        scale = covariance.diagonal().sqrt()
        values, vectors = torch.linalg.eigh(covariance / (scale[:, None] * scale))
        normalized.append(float(((vectors.mT @ (error / scale)).square() / values).mean()))
        assert len(found.shape) == 8
    assert 0.8 < np.mean(normalized) < 1.2


def test_a_fiducial_whose_blobs_cannot_be_labelled_is_named() -> None:
    rig, obj, true_rig, true, table = capture("O10", 3, moved(7, (-3, 0, 4)))
    found = calibrate(replace(table, fiducial=np.full(len(table), -1)), rig, obj)
    assert found.lost == (7,) and found.displaced == ()
    assert held_out(found.rig, true_rig, true) < 0.1
    _, _, _, _, table = capture("O10", 3, right)
    assert calibrate(table, rig, obj).lost == ()

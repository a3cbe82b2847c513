"""The object changes while the rig stands still: no camera is blamed, and the new shape is learnt."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.monitoring import SHAPE, RigBelief, RigFilter, absorb, object_change
from imgcal.monitoring.case import Case
from imgcal.monitoring.explanations import weigh
from imgcal.monitoring.object_change import (
    LEAST_USUAL,
    MISFIT_LEAD,
    Misfit,
    ObjectChanged,
    has_never_fitted,
    may_have_changed,
)
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import Observations
from renderers import palette
from tests.imgcal.monitoring.followed import monitor_of

NOISE = 0.1


@pytest.mark.parametrize("fiducial", [2, None])
@pytest.mark.parametrize("tolerance", [0.0, 0.02])
def test_a_change_of_the_object_is_told_and_learnt(fiducial: int | None, tolerance: float) -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(3)
    if tolerance:
        obj = replace(obj, tolerance=torch.full((8,), tolerance, dtype=torch.float64), scale_tolerance=1e-4)
    truth = simulate_truth(factory, obj, 60, generator, PhysicalDrift())
    monitor, points, told, found = monitor_of(factory, obj), obj.points.clone(), [], None
    for s in range(60):
        if s == 45 and fiducial is not None:
            points[fiducial] += torch.tensor([0.6, -0.5, 0.6])
        elif s == 45:
            points = points.mean(0) + 1.01 * (points - points.mean(0))
        image = truth.rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(points))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        there = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), image.visible)
        update = monitor.update(there, truth.rig_from_object[s : s + 1], 1 / 60)
        told += update.changes
        found = update.object_change or found
    assert told == []
    assert found is not None
    assert (found.fiducial, found.since) == (fiducial, 45)
    assert abs(found.size - (0.01 if fiducial is None else 0.985)) < 5 * found.sigma
    off = monitor.filter.belief.points_object - points
    assert float((off - off.mean(0)).norm(dim=-1).max()) < 0.1


def test_a_single_camera_does_not_tell_a_change_of_the_object_from_a_wrong_label() -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(3)
    truth = simulate_truth(factory, obj, 70, generator, PhysicalDrift())
    monitor, points, told, found = monitor_of(factory, obj), obj.points.clone(), [], []
    for s in range(70):
        if s == 45:
            points[2] += torch.tensor([3.0, -2.5, 3.0])
        image = truth.rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(points))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        seen = image.visible.clone()
        if 45 <= s < 55:
            seen[:, 1:] = False
        there = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), seen)
        update = monitor.update(there, truth.rig_from_object[s : s + 1], 1 / 60)
        told += update.changes
        found += [] if update.object_change is None else [(s, update.object_change.fiducial)]
    assert told == []
    assert [fiducial for _, fiducial in found] == [2] and found[0][0] >= 55


@pytest.mark.parametrize(("seed", "spread"), [(1, 1.0), (2, 1.0), (3, 4.0)])
def test_another_object_of_the_same_design_is_told_as_that_and_no_camera_is_blamed(seed: int, spread: float) -> None:
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_truth(factory, obj, 40, generator, PhysicalDrift())
    other = obj.points + spread * torch.randn(8, 3, generator=generator, dtype=torch.float64)
    monitor, told, found = monitor_of(factory, obj), [], []
    for s in range(40):
        image = truth.rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(other if s >= 30 else obj.points))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        there = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), image.visible)
        update = monitor.update(there, truth.rig_from_object[s : s + 1], 1 / 60)
        told += update.changes
        found += [] if update.object_change is None else [update.object_change]
    assert told == []
    assert found[0].fiducial == SHAPE
    assert 28 <= found[0].since <= 33
    assert found[0].size == pytest.approx(_apart(obj.points, other), rel=0.3)
    assert _apart(monitor.filter.belief.points_object, other) < 0.1


def _apart(points: torch.Tensor, others: torch.Tensor) -> float:
    """RMS distance, a rigid motion taken out."""
    centred, target = points - points.mean(0), others - others.mean(0)
    u, _, vh = torch.linalg.svd(centred.mT @ target)
    turned = centred @ u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vh))]).double()) @ vh
    return float((turned - target).norm(dim=-1).square().mean().sqrt())


def test_a_fiducial_that_never_was_where_the_file_says_is_told() -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(8)
    truth, points = simulate_truth(factory, obj, 16, generator, PhysicalDrift()), obj.points.clone()
    points[5] += torch.tensor([0.6, -0.5, 0.6])
    monitor, found, told = monitor_of(factory, obj), [], []
    for s in range(16):
        image = truth.rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(points))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        there = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), image.visible)
        update = monitor.update(there, truth.rig_from_object[s : s + 1], 1 / 60)
        told += update.changes
        found += [] if update.object_change is None else [update.object_change]
    assert told == []
    assert [(change.fiducial, change.since) for change in found] == [(5, 0)]
    assert abs(found[0].size - 0.985) < 5 * found[0].sigma


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_an_object_that_never_was_as_its_file_says_is_told_however_it_is_turned(seed: int) -> None:
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_truth(factory, obj, 16, generator, PhysicalDrift())
    other = obj.points + 0.15 * torch.randn(8, 3, generator=generator, dtype=torch.float64)
    monitor, found = monitor_of(factory, obj), []
    for s in range(16):
        image = truth.rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(other))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        there = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), image.visible)
        update = monitor.update(there, truth.rig_from_object[s : s + 1], 1 / 60)
        found += [] if update.object_change is None else [update.object_change]
    assert [(change.fiducial, change.since) for change in found] == [(SHAPE, 0)]
    assert found[0].size == pytest.approx(_apart(obj.points, other), abs=5 * found[0].sigma)


def changed_case(change: str, generator: torch.Generator) -> Case:
    """Six snapshots of an object that has changed, after ten."""
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    truth, points = simulate_truth(factory, obj, 16, generator, PhysicalDrift()), obj.points.clone()
    if change == "fiducial":
        points[5] += torch.tensor([0.6, -0.5, 0.6])
    elif change == "shape":
        points += 0.5 * torch.randn(8, 3, generator=generator, dtype=torch.float64)
    elif change.startswith("scale"):
        points = points.mean(0) + (1 + float(change.split()[1])) * (points - points.mean(0))
    follows, snapshots = RigFilter(factory, obj), []
    for s in range(16):
        image = truth.rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(obj.points if s < 10 else points))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        if change == "bad labels" and s >= 10:
            uv[0, :, s % 8] += 3.0
        there = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), image.visible)
        if s < 10:
            follows.update(there, truth.rig_from_object[s : s + 1])
        snapshots.append((there, truth.rig_from_object[s : s + 1]))
    return Case(follows.belief, snapshots[10:], [1 / 60] * 6, 6)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("change", ["nothing", "bad labels", "fiducial", "shape", "scale 0.01", "scale 0.1"])
def test_one_fit_tells_whether_parts_of_the_object_are_worth_weighing(change: str, seed: int) -> None:
    case = changed_case(change, torch.Generator().manual_seed(seed))
    verdict = weigh(case)
    gained = verdict.evidence(ObjectChanged.name) - verdict.evidence("steady") >= MISFIT_LEAD
    assert may_have_changed(case) >= gained
    if change != "bad labels":  # which may look like a change
        assert may_have_changed(case) == gained == (change != "nothing")


def test_few_questions_are_asked_of_a_print(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(3)
    across = torch.arange(12.0, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(across * 20, across * 15, indexing="ij"), -1).flatten(0, 1)
    obj = imgcal.CalibrationObject(torch.nn.functional.pad(points, (0, 1)), palette(len(points)).double())
    truth, asked = simulate_truth(rig, obj, 3, generator, PhysicalDrift()), []

    def noted(belief: RigBelief, fiducial: int | None, by: float) -> RigBelief:
        asked.append(fiducial)
        return belief  # with more than 400 values of the object, an answer takes seconds

    monkeypatch.setattr(object_change, "free_object", noted)
    seen = torch.ones(1, *truth.uv.shape[1:-1], dtype=torch.bool)
    there = Observations(truth.uv[:1], torch.full(seen.shape, NOISE, dtype=torch.float64), seen)
    case = Case(RigFilter(rig, obj).belief, [(there, truth.rig_from_object[:1])], [0.0], 1)
    assert [make().before for make in ObjectChanged().variants(case)] == [case.before]
    assert asked == [None]


def test_a_misfit_is_noticed_after_some_snapshots_and_counted() -> None:
    random, watch = np.random.default_rng(1), Misfit()
    assert [watch.update(random.chisquare(60), 60) for _ in range(500)] == [0] * 500
    taken = [watch.update(2 * random.chisquare(60), 60) for _ in range(10)]
    first = next(number for number, age in enumerate(taken) if age)
    assert first < 8 and first <= taken[first] <= first + 3


def test_one_wrong_snapshot_and_a_beginning_are_no_misfit() -> None:
    random, watch = np.random.default_rng(2), Misfit()
    assert [watch.update(9 * random.chisquare(60), 60) for _ in range(LEAST_USUAL - 1)] == [0] * (LEAST_USUAL - 1)
    watch = Misfit()
    for _ in range(100):
        watch.update(random.chisquare(60), 60)
    assert watch.update(1e4, 60) == 0


@pytest.mark.parametrize("bent", [False, True])
def test_an_object_that_never_was_as_its_file_says_explains_the_first_snapshots(bent: bool) -> None:
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(8)
    points = obj.points.clone()
    points[5] += bent * torch.tensor([0.6, -0.5, 0.6])
    truth = simulate_truth(factory, replace(obj, points=points), 16, generator, PhysicalDrift())
    uv = truth.uv + NOISE * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    seen = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), torch.ones(uv.shape[:-1]) > 0)
    before = RigFilter(factory, obj).belief
    result = absorb(before, seen, truth.rig_from_object)
    assert has_never_fitted(result, 16) == bent
    assert not has_never_fitted(result, 15)  # not asked then
    parts = [(seen.of_snapshots([s]), truth.rig_from_object[s : s + 1]) for s in range(16)]
    verdict = weigh(Case(before, parts, [0.1] * 16, 16))
    changed = verdict.best.finding.object_change
    assert (changed is not None and verdict.lead >= MISFIT_LEAD) == bent
    if bent:
        assert changed.fiducial == 5
    else:
        assert verdict.best.name == "steady" and verdict.lead > 0

"""Learning from several snapshots at once agrees with the batch estimate."""

from dataclasses import replace

import pytest
import torch

from imgcal import load_rig
from imgcal.errors import RefusedError
from imgcal.estimation import step_by_error
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief, absorb
from imgcal.synthesis import PhysicalDrift, simulate_volume
from imgcal.types import CalibrationObject, Observations
from tests.imgcal.monitoring.lights import ROOM, lights_of
from tests.imgcal.monitoring.made_snapshots import SQUARED, batch, made_snapshots, part, snapshots, worst


@pytest.fixture(scope="module")
def made():
    return made_snapshots()


@pytest.mark.parametrize("count", [1, 3])
def test_what_is_absorbed_together_is_the_batch_estimate(made, count: int) -> None:
    factory, obj, _, _ = made
    result = absorb(RigBelief.of_prior(factory, obj), *snapshots(made, 0, count), SQUARED)
    difference, ratio = worst(result.belief, batch(made, count))
    assert difference < 0.01
    assert ratio < 1.001


def test_an_object_with_tolerances_is_learnt_along(made) -> None:
    factory, obj, _, _ = made
    loose = replace(obj, tolerance=torch.full((8,), 0.3, dtype=torch.float64), scale_tolerance=1e-3)
    result = absorb(RigBelief.of_prior(factory, loose), *snapshots(made, 0, 4), SQUARED)
    fit = batch(made, 4, loose)
    difference, ratio = worst(result.belief, fit)
    assert difference < 0.01
    assert ratio < 1.001
    torch.testing.assert_close(result.belief.points_object, fit.points_object, atol=1e-3, rtol=0)


def test_a_snapshot_has_one_pose(made) -> None:
    factory, obj, truth, observations = made
    with pytest.raises(ValueError, match="found 2 poses of 1 snapshots"):
        absorb(RigBelief.of_prior(factory, obj), part(observations, 0, 1), truth.rig_from_object[:2])


def test_lights_of_a_snapshot_say_what_objects_of_one_fiducial_say() -> None:
    factory, obj, truth, observations = made_snapshots()
    given, truth_poses = part(observations, 0, 5), truth.rig_from_object[:5]
    places = truth_poses.apply(obj.points) + 1.0
    lights, seen, at = lights_of(given, places)
    together = absorb(RigBelief.of_prior(factory, lights), seen, at)
    one = CalibrationObject(torch.zeros(1, 3, dtype=torch.float64), torch.ones(1, 3, dtype=torch.float64))
    rows = [tensor.transpose(1, 2).flatten(0, 1)[:, :, None] for tensor in (given.uv, given.sigma, given.seen)]
    known = rows[2].sum((1, 2)) > 1
    eye = torch.eye(3, dtype=torch.float64).expand(int(known.sum()), 3, 3)
    alone = RigidTransform(eye, places.flatten(0, 1)[known])
    apart = absorb(RigBelief.of_prior(factory, one), Observations(*(row[known] for row in rows)), alone)
    torch.testing.assert_close(together.belief.information, apart.belief.information, rtol=1e-8, atol=1e-6)
    torch.testing.assert_close(together.brought.information(), apart.brought.information(), rtol=1e-8, atol=1e-4)
    torch.testing.assert_close(together.brought.pull.sum(0), apart.brought.pull.sum(0), rtol=1e-6, atol=1e-5)
    assert len(together.brought) == 5
    assert together.dof == apart.dof
    assert together.chi2 == pytest.approx(apart.chi2)
    assert together.evidence == pytest.approx(apart.evidence)
    found = together.rig_from_object.translation[:, ROOM:].flatten(0, 1)[known]
    torch.testing.assert_close(found, apart.rig_from_object.translation, rtol=0, atol=1e-6)
    assert bool(together.rig_from_object.translation[:, :ROOM].isnan().all())
    torch.testing.assert_close(
        together.residual.transpose(1, 2)[:, ROOM:].flatten(0, 1)[known], apart.residual[:, :, 0]
    )


def test_lights_say_nothing_of_the_size_of_the_rig_nor_of_where_it_is() -> None:
    factory, obj, truth, observations = made_snapshots()
    places = truth.rig_from_object[:8].apply(obj.points)
    lights, seen, at = lights_of(part(observations, 0, 8), places)
    prior = RigBelief.of_prior(factory, lights)
    found = absorb(prior, seen, at)
    rig, information = found.brought.rig, found.brought.information()
    by_error = step_by_error(rig) * prior.unit[:, None]
    away, size = rig.positions, torch.zeros_like(prior.unit)
    size[:, 3:6] = away
    sideways = torch.zeros_like(prior.unit)
    sideways[:, 3:6] = torch.linalg.cross(away, torch.ones_like(away))
    said = [
        float(error @ information @ error)
        for error in (torch.linalg.solve(by_error, step[..., None]).flatten() for step in (size, sideways))
    ]
    assert abs(said[0]) < 1e-9 * said[1]
    assert found.belief.scale_std() > 0.9 * prior.scale_std()


def test_lights_that_no_two_cameras_see_are_refused() -> None:
    factory, obj, truth, observations = made_snapshots()
    lights, seen, at = lights_of(part(observations, 0, 1), truth.rig_from_object[:1].apply(obj.points))
    alone = torch.zeros_like(seen.seen)
    alone[:, 0] = seen.seen[:, 0]
    with pytest.raises(RefusedError, match="no light is seen by two cameras"):
        absorb(RigBelief.of_prior(factory, lights), replace(seen, seen=alone), at)


@pytest.mark.parametrize("kept", [(0, 1), (0, 1, 2), (0, 1, 2, 3), tuple(range(8))], ids=len)
def test_lights_with_known_distances_say_what_the_rigid_object_says(kept) -> None:
    factory, obj, truth, observations = made_snapshots()
    rows = list(kept)
    rigid = replace(obj, points=obj.points[rows], colours=obj.colours[rows])
    given, poses = part(observations, 0, 6), truth.rig_from_object[:6]
    there = given.seen[:, :, rows] & (given.seen[:, :, rows].sum(1, keepdim=True) >= 2)
    given = Observations(given.uv[:, :, rows], given.sigma[:, :, rows], there)
    assert bool((there.any(1).sum(1) >= min(3, len(rows))).all())
    lights, seen, at = lights_of(given, poses.apply(rigid.points) + torch.tensor((0.3, -0.2, 0.4)).double())
    none = CalibrationObject.unknown(most=ROOM)
    swapped = [*range(ROOM, ROOM + len(rows)), *range(ROOM)]  # known markers come first
    seen = Observations(seen.uv[:, :, swapped], seen.sigma[:, :, swapped], seen.seen[:, :, swapped])
    at = RigidTransform(at.rotation, at.translation[:, swapped])
    known = absorb(RigBelief.of_prior(factory, replace(lights, parts=(rigid, none))), seen, at, SQUARED)
    expected = absorb(RigBelief.of_prior(factory, rigid), given, poses, SQUARED) if len(rows) > 2 else None
    apart = known.rig_from_object.translation[:, : len(rows)]
    torch.testing.assert_close(
        torch.cdist(apart, apart), torch.cdist(rigid.points, rigid.points).expand(6, -1, -1), rtol=0, atol=2e-2
    )
    free = 2 * int(given.seen.sum()) - 6 * rigid.pose_rank
    assert known.dof == free
    if expected is not None:
        std = expected.belief.std()
        torch.testing.assert_close(known.belief.std(), std, rtol=2e-2, atol=1e-9)
        off = (known.belief.rig.positions - expected.belief.rig.positions) / std[:, 3:6]
        assert float(off.abs().max()) < 0.1
        assert known.evidence == pytest.approx(expected.evidence, abs=1.0)
    alone = absorb(RigBelief.of_prior(factory, lights), seen, at)
    assert known.belief.scale_std() < 0.5 * alone.belief.scale_std()


def test_a_marker_slightly_off_the_line_of_a_stick_does_not_keep_snapshots_from_fitting() -> None:
    points = torch.tensor(((0.0, 0, 0), (159.6, 0.5, 0), (239.3, 0, 0))).double()
    stick, factory = CalibrationObject(points, torch.ones(3, 3).double()), load_rig("room10")
    generator, noise, count = torch.Generator().manual_seed(1), 0.3, 100
    truth = simulate_volume(factory, stick, count, generator, PhysicalDrift())
    uv = truth.uv + noise * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    given = Observations(uv, torch.full(uv.shape[:-1], noise).double(), truth.visible)
    start = truth.rig_from_object.apply(points) + 0.5 * torch.randn(count, 3, 3, generator=generator).double()
    lights, seen, at = lights_of(given, start)
    known = [*range(ROOM, ROOM + 3), *range(ROOM)]  # known markers come first
    seen = Observations(seen.uv[:, :, known], seen.sigma[:, :, known], seen.seen[:, :, known])
    at = RigidTransform(at.rotation, at.translation[:, known])
    lights = replace(lights, parts=(stick, CalibrationObject.unknown(most=ROOM)))
    belief = RigBelief.of_prior(factory, lights)
    for snapshot in range(60):
        found = absorb(belief, part(seen, snapshot, snapshot + 1), at[snapshot : snapshot + 1])
        there = found.rig_from_object.translation[0, :3]
        torch.testing.assert_close(torch.cdist(there, there), torch.cdist(points, points), rtol=0, atol=2e-2)
        belief = found.belief

"""Snapshots after a change determine its kind and size."""

import math
from collections.abc import Mapping
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

import imgcal
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.monitoring import CHANGES, Change, MeasurementUpdate, RigBelief, absorb
from imgcal.monitoring.pending_change import PendingChange, free_cameras
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CameraRig, Observations

NOISE, ZOOM = 0.1, 10.0


def zoomed() -> tuple[RigBelief, MeasurementUpdate, CameraRig]:
    """What was believed before a focal length changed, what 8 snapshots taught after it, and the rig then."""
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[1, CHANGES["focal_length"]] = ZOOM / 2**0.5
    return changed(step)


def changed(step: Tensor, seed: int = 2) -> tuple[RigBelief, MeasurementUpdate, CameraRig]:
    """The same for any change of camera 1, a step (4, 15) of its parameters."""
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_truth(factory, obj, 32, generator, PhysicalDrift())
    shift = torch.tensor([100.0, 60.0, 80.0]) * torch.randn(32, 3, generator=generator, dtype=torch.float64)
    carried = RigidTransform(truth.rig_from_object.rotation, truth.rig_from_object.translation + shift)
    results, belief = [], RigBelief.of_prior(factory.to(torch.float64), obj)
    for rig, part in ((truth.rig, slice(0, 24)), (truth.rig.retract(step), slice(24, 32))):
        poses = carried[part]
        image = rig.expand(len(poses.translation)).project(poses.apply(obj.points))
        uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
        seen = Observations(uv, torch.full(uv.shape[:-1], NOISE, dtype=torch.float64), image.visible)
        results.append(absorb(belief, seen, poses))
        belief = free_cameras(results[0].belief, {1: None})
    return results[0].belief, results[1], truth.rig.retract(step)


def test_the_kind_the_size_and_what_is_believed_then() -> None:
    before, result, rig = zoomed()
    still = torch.zeros_like(before.unit)
    since = PendingChange.of(result, before, 0.0, {1: None})
    assert (since.count, since.due, since.overdue) == (8, True, False)
    test = since.test(still)
    assert since.decide(test, 1, last=False) == ("focal_length", "focal_length")
    size, sigma = since.sizes(test, 1, "focal_length")["focal_length"]
    assert abs(size - ZOOM) < 4 * sigma < ZOOM
    since.kinds[1] = "focal_length"
    first, belief, information = since.adopt_kinds(test)
    assert torch.allclose(information, belief.factor @ belief.factor.mT)
    error = belief.rig.local(rig).flatten()
    assert 0.4 < float(error @ torch.linalg.solve(belief.covariance(), error)) / len(error) < 1.8
    assert bool((belief.std()[1, :6] <= before.std()[1, :6] * 1.001).all())
    assert float((first.rig.focal_length - before.rig.focal_length)[1].norm()) > 0.5 * ZOOM


def test_nothing_is_said_of_a_camera_that_has_shown_nothing_since() -> None:
    before, result, _ = zoomed()
    since = PendingChange.of(result, before, 0.0, {1: None})
    own = slice(15, 30)
    since.brought[own], since.brought[:, own], since.weighted[own] = 0.0, 0.0, 0.0
    since.count = since.most
    test, doubted = since.test(torch.zeros_like(before.unit)), Change(1, 8, "unknown", math.nan, math.nan)
    (found,), kinds = since.decide_kinds(test, {1: doubted}, last=True)
    assert (found.kind, kinds, found.also) == ("unknown", {1: None}, ()) and math.isnan(found.size)


@pytest.mark.parametrize("joint", [0.0, 50.0, 150.0])
def test_the_size_of_a_turn_is_right_wherever_the_joint_of_the_mount_is(joint: float) -> None:
    """A turn about a joint shifts the camera, which looks like more or less of a turn."""
    found = []
    for seed, degrees in enumerate((0.1, 0.3, 1.0, 5.0) * 2):
        axis = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        step = torch.zeros(4, 15, dtype=torch.float64)
        step[1, :3] = math.radians(degrees) * axis / axis.norm()
        rotation = imgcal.load_rig("T4").cam_from_rig.rotation[1].double()
        to_joint = torch.tensor([0.0, joint, 0.0], dtype=torch.float64)
        step[1, 3:6] = rotation.mT @ (to_joint - rotation_from_vector(step[1, :3]).mT @ to_joint)
        before, result, _ = changed(step, seed)
        since = PendingChange.of(result, before, 0.0, {1: None})
        size, sigma = since.sizes(since.test(torch.zeros_like(before.unit)), 1, "rotation")["rotation"]
        found.append((size - math.radians(degrees)) / sigma)
    z = torch.tensor(found)
    assert float(z.abs().max()) < 3.5
    assert float(z.square().mean().sqrt()) < 1.5


@pytest.mark.parametrize(
    ("tilt", "principal_point", "kind"), [(14, 15, "rotation"), (14, 16, "rotation"), (14, 18, "principal_point")]
)
def test_a_tilt_that_a_shift_of_the_lens_explains_as_well_is_a_rotation(tilt, principal_point, kind) -> None:
    """A rotation about any axis has one more parameter, and pays for it."""
    odds = {"tilt": tilt, "rotation": 10.0, "position": 5.0, "focal_length": 0.0, "principal_point": principal_point}
    odds |= {"tilt in place": tilt, "turn in place": 10.0}

    def evidence(changes: Mapping[int, str | None]) -> float:
        return odds.get(changes[1] or "", 8.0)

    before, result, _ = zoomed()
    since = PendingChange.of(result, before, 0.0, {1: None})
    since.most = since.count
    assert since.decide(SimpleNamespace(odds=evidence), 1, last=True)[1] == kind  # type: ignore[arg-type, index]


def test_a_shift_of_the_lens_needs_more_evidence_than_a_rotation() -> None:
    """A camera's mount moves more often than its lens: what explains the labels equally well is a rotation."""
    before, result, _ = zoomed()
    since = PendingChange.of(result, before, 0.0, {1: None})

    def decide(principal_point: float) -> tuple[str | None, str | None] | None:
        odds = dict.fromkeys(("rotation", "tilt", "turn in place", "tilt in place"), 12.0)
        odds |= {"position": 3.0, "principal_point": principal_point}
        test = SimpleNamespace(odds=lambda changes: odds.get(changes[1] or "", 5.0))
        return since.decide(test, 1, last=False)  # type: ignore[arg-type]

    assert decide(9.5) == ("rotation", "rotation")
    assert decide(13.0) is None and decide(19.5) is None
    assert decide(20.5) == ("principal_point", "principal_point")


@pytest.mark.parametrize(
    ("rotation", "principal_point", "kind"),
    [
        (9950.0, 0.0, "rotation"),
        (9800.0, 0.0, None),
        (9950.0, 9970.0, "rotation"),  # hardly better
        (9950.0, 9985.0, "principal_point"),
        (0.0, 9950.0, "principal_point"),
    ],
)
def test_a_change_of_all_kinds_is_reported_as_its_main_kind_if_there_is_one(rotation, principal_point, kind) -> None:
    """A lens or a place that was never quite right shows, once the camera has moved."""
    before, result, _ = zoomed()
    since = PendingChange.of(result, before, 0.0, {1: None})
    odds = {None: 10_000.0, "rotation": rotation, "principal_point": principal_point}
    test = SimpleNamespace(odds=lambda changes: odds.get(changes[1], 0.0))
    assert since.decide(test, 1, last=False) == (None, kind)  # type: ignore[arg-type]


def test_a_camera_that_is_let_free_may_be_anywhere_and_no_other() -> None:
    before, _, _ = zoomed()
    free, turned = free_cameras(before, {2: None}).std(), free_cameras(before, {2: "rotation"}).std()
    others = [0, 1, 3]
    torch.testing.assert_close(free[others], before.std()[others], rtol=1e-4, atol=1e-9)
    assert bool((free[2] > before.std()[2]).all())
    assert bool((turned[2, :3] > 2 * before.std()[2, :3]).all())
    assert bool((turned[2, 3:6] > 1.1 * before.std()[2, 3:6]).all())  # it turned about a joint of its mount
    torch.testing.assert_close(turned[2, 6:], before.std()[2, 6:], rtol=1e-4, atol=1e-9)

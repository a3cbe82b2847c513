"""First guess of the object's pose: planar or not, one camera or several, gaps, batch shapes."""

from dataclasses import replace

import pytest
import torch

from imgcal.estimation import initial_pose
from imgcal.geometry import geodesic_angle
from imgcal.synthesis import PoseRange
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import Observations


@pytest.mark.parametrize("batch", [(), (1,), (2, 3), (4,)])
@pytest.mark.parametrize("cameras", [4, 10])
def test_exact_from_exact_points(simulate, batch: tuple[int, ...], cameras: int) -> None:
    case = simulate(*batch, snapshots=5, cameras=cameras, noise=0.0, missing=0.2)
    pose = initial_pose(case.observations, case.truth, case.obj)
    assert pose.rotation.shape == (*batch, 5, 3, 3)
    assert geodesic_angle(pose.rotation, case.poses.rotation).max() < 1e-6
    assert (pose.translation - case.poses.translation).norm(dim=-1).max() < 1e-3


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("planar", [False, True])
def test_few_cameras_and_planar_objects(simulate, o10, asymmetric8, cameras: int, planar: bool) -> None:
    points = asymmetric8.points * torch.tensor([1.0, 1.0, 0.0 if planar else 1.0], dtype=torch.float64)
    obj, rig = replace(asymmetric8, points=points), o10.select(range(cameras))
    # A plane seen edge-on, or from straight above by a single camera, is a harder question than this test asks.
    tilted = PoseRange(phi_deg=(17.0, 63.0))
    poses = sample_rig_from_object(300, 850.0, points.mean(0), tilted, torch.Generator().manual_seed(0)).reshape(300, 1)
    uv = rig.project(poses.apply(points).squeeze(1)).uv.unsqueeze(1)
    observations = Observations(uv, torch.full_like(uv[..., 0], 0.05), torch.ones(uv.shape[:-1], dtype=torch.bool))
    pose = initial_pose(observations, rig, obj)
    right = geodesic_angle(pose.rotation, poses.rotation) < 1e-4
    assert float(right.double().mean()) >= 0.99


def test_three_fiducials_are_enough_for_many_cameras(simulate) -> None:
    case = simulate(20, snapshots=1, noise=0.0)
    seen = case.observations.seen.clone()
    seen[..., 3:] = False
    pose = initial_pose(replace(case.observations, seen=seen), case.truth, case.obj)
    right = geodesic_angle(pose.rotation, case.poses.rotation) < 1e-4
    assert float(right.double().mean()) >= 0.9


def test_near_enough_from_a_drifted_rig(simulate) -> None:
    case = simulate(50, snapshots=2, missing=0.2)
    pose = initial_pose(case.observations, case.factory, case.obj)
    assert geodesic_angle(pose.rotation, case.poses.rotation).max() < 0.1
    assert (pose.translation - case.poses.translation).norm(dim=-1).max() < 60


def test_batch_equals_one_by_one(simulate) -> None:
    case = simulate(3, snapshots=2, cameras=3, missing=0.1)
    together = initial_pose(case.observations, case.factory, case.obj)
    for b in range(3):
        one = Observations(case.observations.uv[b], case.observations.sigma[b], case.observations.seen[b])
        torch.testing.assert_close(initial_pose(one, case.factory, case.obj).rotation, together.rotation[b])


def test_unseen_pixels_do_not_matter(simulate) -> None:
    case = simulate(2, missing=0.3)
    changed = torch.where(case.observations.seen[..., None], case.observations.uv, 123.0)
    first, second = (
        initial_pose(observations, case.factory, case.obj)
        for observations in (case.observations, replace(case.observations, uv=changed))
    )
    assert torch.equal(first.rotation, second.rotation)


@pytest.mark.parametrize("cameras", [1, 4])
def test_the_compiled_minimization_is_that_of_tensors(simulate, cameras: int) -> None:
    case = simulate(2, snapshots=3, cameras=cameras, noise=0.3, missing=0.2)
    compiled = initial_pose(case.observations, case.factory, case.obj)
    watched = replace(case.factory, focal_length=case.factory.focal_length.clone().requires_grad_())
    tensors = initial_pose(case.observations, watched, case.obj)
    torch.testing.assert_close(compiled.rotation, tensors.rotation.detach(), rtol=0, atol=1e-9)
    torch.testing.assert_close(compiled.translation, tensors.translation.detach(), rtol=1e-9, atol=1e-6)

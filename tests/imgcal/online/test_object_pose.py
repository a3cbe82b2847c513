from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import EstimationOptions, Gauge
from imgcal.geometry import RigidTransform, rotation_from_vector, vector_from_rotation
from imgcal.monitoring import RigBelief, absorb
from imgcal.online import RigKeeper
from imgcal.online.object_pose import object_pose
from imgcal.synthesis import PhysicalDrift, Truth, simulate_truth, true_detections
from imgcal.types import Observations, RigPrior

RUNS, SNAPSHOTS, NOISE = 80, 4, 0.1
EXACT = imgcal.load_object("asymmetric8")
SQUARED = EstimationOptions(loss="squared", tolerance=1e-8)


def simulated(factory, obj, generator, shake=0.0):
    """A rig as its prior has it, an object as its tolerances have it, poses, and noisy blobs of what was seen."""
    normal = torch.randn(factory.num_cameras, factory.num_parameters, generator=generator, dtype=torch.float64)
    rig = factory.retract(factory.prior.std(factory) * normal)
    shift = obj.granted[:, None] * torch.randn(8, 3, generator=generator, dtype=torch.float64)
    turn = rotation_from_vector(torch.randn(SNAPSHOTS, 3, generator=generator, dtype=torch.float64))
    place = torch.tensor([0.0, 0.0, factory.working_distance]) + 60 * torch.randn(SNAPSHOTS, 3, generator=generator)
    poses = RigidTransform(turn, place.double())
    image = rig.expand(SNAPSHOTS).project_values(poses.apply(obj.points + shift), obj.radius)
    uv = image.uv + NOISE * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
    uv = uv + shake * torch.randn(SNAPSHOTS, factory.num_cameras, 1, 2, generator=generator, dtype=torch.float64)
    seen = image.visible & (torch.rand(image.visible.shape, generator=generator) > 0.2)
    given = torch.full((SNAPSHOTS, factory.num_cameras), shake, dtype=torch.float64) if shake else None
    return rig, poses, Observations(uv, torch.full(seen.shape, NOISE, dtype=torch.float64), seen, given)


def last_pose(belief, poses, observations, shake=0.0):
    """What is known of the pose in the last snapshot."""
    cameras = belief.rig.num_cameras
    truth = Truth(belief.rig, poses[-1:], observations.uv[-1:], observations.seen[-1:])
    blobs = true_detections(truth)
    no_more = np.zeros(cameras)
    return object_pose(
        belief, poses[-1], replace(blobs, sigma=np.full(len(blobs), NOISE)), no_more, no_more + shake,
        np.ones(cameras, dtype=bool),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("tolerance", "shake"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.5)], ids=["exact", "object within tolerances", "shaking"]
)
def test_errors_are_as_large_as_the_covariance_says(tolerance, shake):
    factory = replace(imgcal.load_rig("T4").to(torch.float64), prior=RigPrior())
    obj = replace(EXACT, tolerance=torch.full((8,), tolerance)) if tolerance else EXACT
    generator, squared = torch.Generator().manual_seed(3), []
    even = Gauge(torch.ones(4, dtype=torch.float64))
    for _ in range(RUNS):
        rig, poses, observations = simulated(factory, obj, generator, shake)
        found = absorb(RigBelief.of_prior(factory, obj), observations, poses, SQUARED)
        known = last_pose(found.belief, found.rig_from_object, observations, shake)
        # The true rig laid upon the estimate, and the pose with it.
        laid = even.align(rig, found.belief.rig)
        there = (laid.cam_from_rig.inverse() @ rig.cam_from_rig)[0] @ poses[-1]
        turn = vector_from_rotation(there.rotation @ known.rig_from_object.rotation.mT)
        error = torch.cat((turn, there.translation - known.rig_from_object.translation))
        squared.append(float(error @ torch.linalg.solve(known.covariance, error)) / 6)
    assert 0.85 < np.mean(squared) < 1.15  # 400 runs: 1.00, 1.02, 0.96 +- 0.03


def test_a_state_says_where_the_object_is_and_how_surely():
    factory = imgcal.load_rig("T4")
    truth = simulate_truth(factory, EXACT, 3, torch.Generator().manual_seed(1), PhysicalDrift())
    blobs = true_detections(truth)
    with RigKeeper(factory, EXACT) as keeper:
        first, second, third = (keeper.update(blobs.of_snapshots(s, s + 1), time=s / 60) for s in range(3))
        nothing = keeper.update(blobs.of_snapshots(2, 3).select(np.arange(0)), time=1.0)
    known = third.object_pose
    assert (known.markers, known.cameras) == (8, 4) and nothing.object_pose is None and nothing.refused
    assert np.allclose(known.matrix() @ [0, 0, 0, 1], [*third.rig_from_object.translation, 1])
    assert third.object_pose.std()[1] < first.object_pose.std()[1]  # the rig is known better
    doubted = replace(third, cameras={**third.cameras, "cam02": "doubtful", "cam03": "lost"})
    assert doubted.object_pose.cameras == 2 and doubted.object_pose.std()[1] > known.std()[1]
    blind = replace(third, cameras=dict.fromkeys(third.cameras, "lost"))
    assert blind.object_pose is None and second.object_pose is not None

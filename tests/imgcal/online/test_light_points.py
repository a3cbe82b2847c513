from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import Gauge
from imgcal.monitoring import RigBelief
from imgcal.online import RigKeeper
from imgcal.online.light_points import FoundLights, light_points
from imgcal.synthesis import simulate_volume, true_detections
from imgcal.types import RigPrior

NOISE = 0.1
FACTORY = imgcal.load_rig("room10").to(torch.float64)
WAND = imgcal.load_object("wand4")
PRIOR = RigPrior(focal_length=2e-4, principal_point=0.3, distortion=1e-4, rotation=1e-4, position=0.3)


def seen_lights(rig, seed, shake=0.0):
    """Four lights seen by a rig, and where they are."""
    truth = simulate_volume(rig, WAND, 1, torch.Generator().manual_seed(seed), None)
    random, blobs = np.random.default_rng(seed), true_detections(truth)
    shifts = shake * random.normal(size=(rig.num_cameras, 2))
    uv = blobs.uv + NOISE * random.normal(size=blobs.uv.shape) + shifts[blobs.camera]
    point = truth.rig_from_object.apply(WAND.points)[0]
    first = point.numpy() + random.normal(size=(4, 3))  # a millimetre off
    blobs = replace(blobs, uv=uv, sigma=np.full(len(blobs), NOISE))
    return FoundLights(blobs, blobs.fiducial, first), point


@pytest.mark.parametrize("shake", [0.0, 0.4])
def test_errors_are_as_large_as_is_said(shake):
    """Rigs as their prior has them; what moves with the whole rig is no error."""
    factory, nothing = replace(FACTORY, prior=PRIOR), np.zeros(10)
    belief, even = RigBelief.of_prior(factory, WAND), Gauge(torch.ones(10, dtype=torch.float64))
    generator, squared = torch.Generator().manual_seed(5), []
    for seed in range(40):
        normal = torch.randn(10, factory.num_parameters, generator=generator, dtype=torch.float64)
        rig = factory.retract(PRIOR.std(factory) * normal)
        found, truth = seen_lights(rig, seed, shake)
        known = light_points(belief, found, nothing, nothing + shake, np.ones(10, dtype=bool))
        laid = even.align(rig, factory)
        there = ((laid.cam_from_rig.inverse() @ rig.cam_from_rig)[0]).apply(truth).numpy()
        kept = np.linalg.norm(known.point[:, None] - there, axis=-1).argmin(1)
        squared += (np.square(known.point - there[kept]).sum(1) / known.error**2).tolist()
    assert len(squared) > 120 and 0.8 < np.mean(squared) < 1.2


def test_only_lights_that_two_trusted_cameras_see_are_given():
    found, truth = seen_lights(FACTORY, 3)
    nothing, cameras = np.zeros(10), found.blobs.camera[found.light == 1]
    belief = RigBelief.of_prior(FACTORY, WAND)
    every = light_points(belief, found, nothing, nothing, np.ones(10, dtype=bool))
    assert len(every) == 4 and np.allclose(every.point, truth, atol=1.0) and every.seen.shape == (10, 4)
    assert (every.seen.sum(0) == np.bincount(found.light)).all()
    trusted = np.ones(10, dtype=bool)
    trusted[cameras[1:]] = False  # one is left
    fewer = light_points(belief, found, nothing, nothing, trusted)
    assert len(fewer) < 4 and not fewer.seen[~trusted].any() and (fewer.seen.sum(0) >= 2).all()
    none = light_points(belief, found, nothing, nothing, np.zeros(10, dtype=bool))
    assert len(none) == 0 and none.seen.shape == (10, 0)


def test_a_state_has_all_lights_and_of_an_object_of_one_light_that_one():
    truth = simulate_volume(FACTORY, WAND, 1, torch.Generator().manual_seed(1), None)
    blobs, places = true_detections(truth), truth.rig_from_object.apply(WAND.points)[0].numpy()
    with RigKeeper(FACTORY, imgcal.load_object("lights")) as keeper:
        state = keeper.update(blobs, time=0.0)
        nothing = keeper.update(blobs.select(np.arange(0)), time=0.1)
    assert len(state.light_points) == 4 and nothing.light_points is None and nothing.refused
    away = np.linalg.norm(state.light_points.point[:, None] - places, axis=-1)
    assert (away.min(1) < 0.5).all() and len(set(away.argmin(1).tolist())) == 4
    one = imgcal.CalibrationObject(WAND.points[:1], WAND.colours[:1])
    single = blobs.select(blobs.fiducial == 0)
    with RigKeeper(FACTORY, one) as keeper:
        state = keeper.update(replace(single, fiducial=np.full(len(single), -1)), time=0.0)
    assert len(state.light_points) == 1 and np.allclose(state.light_points.point[0], places[0], atol=0.5)

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.estimation import cold_start
from imgcal.io import load_object, read_rig
from imgcal.synthesis import PhysicalDrift, arrange_rig, simulate_volume
from imgcal.types import Observations, RigPrior


def seen_by(rig, obj, snapshots, noise=0.05, seed=0):
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_volume(rig, obj, snapshots, generator, PhysicalDrift(distortion=0.01))
    uv = truth.uv + noise * torch.randn(truth.uv.shape, generator=generator, dtype=torch.float64)
    return truth, Observations(uv, torch.full_like(uv[..., 0], noise), truth.visible)


def rough(rig, factor):
    """Ideal lenses with another focal length."""
    lens = {"focal_length": factor * rig.focal_length, "distortion": torch.zeros_like(rig.distortion)}
    return replace(rig, prior=RigPrior(0.15, 20.0, 0.1, 1.0, 1e6), **lens)


def relative_error(found, truth):
    """Largest error of the distances between cameras, in parts of the largest of them."""
    there, here = (torch.cdist(rig.positions, rig.positions) for rig in (truth, found))
    return float((there - here).abs().max() / there.max())


@pytest.mark.parametrize(("shape", "factor"), [("ring", 1.25), ("dome", 0.8), ("row", 1.15)])
def test_a_rig_is_found_from_a_wand_and_rough_focal_lengths(shape, factor):
    rig = arrange_rig(shape, 5, 3000.0, height=1500.0, target=(0, 2500.0 if shape == "row" else 0, 900))
    truth, observations = seen_by(rig, load_object("wand4"), 40)
    found = cold_start(observations, rough(truth.rig, factor), load_object("wand4"))
    assert relative_error(found.rig, truth.rig) < 0.01
    assert ((found.rig.focal_length / truth.rig.focal_length - 1).abs() < 0.02).all()
    assert found.spread < 0.1 and not found.rig.positions[0].abs().max() > 1e-6
    assert torch.allclose(found.rig.cam_from_rig.rotation[0], torch.eye(3, dtype=torch.float64))


def test_wrong_labels_do_little():
    rig, wand = read_rig("room10").select([0, 3, 6]), load_object("wand4")
    truth, observations = seen_by(rig, wand, 60, seed=3)
    swapped = np.random.default_rng(0).random(observations.seen.shape[:2]) < 0.1
    observations.uv[torch.from_numpy(swapped)] = observations.uv[torch.from_numpy(swapped)][:, [2, 1, 0, 3]]
    assert relative_error(cold_start(observations, rough(truth.rig, 1.1), wand).rig, truth.rig) < 0.02


def test_each_camera_may_have_labelled_another_turn_of_a_cube():
    rig = arrange_rig("ring", 4, 2000.0, height=800.0, target=(0, 0, 500))
    cube = load_object("cube8")
    cube = replace(cube, points=1.5 * cube.points)
    truth, observations = seen_by(rig, cube, 20)
    rng = np.random.default_rng(0)
    turns = np.stack([motion.permutation for motion in cube.symmetries])[rng.integers(0, 24, (20, 4))]
    order = torch.from_numpy(turns)
    turned = Observations(
        observations.uv.gather(2, order[..., None].expand_as(observations.uv)),
        observations.sigma,
        observations.seen.gather(2, order),
    )
    assert relative_error(cold_start(turned, rough(truth.rig, 1.1), cube).rig, truth.rig) < 0.01


def test_a_camera_that_shares_nothing_is_named():
    rig, wand = read_rig("room10").select([0, 3, 6]), load_object("wand4")
    truth, observations = seen_by(rig, wand, 30)
    observations.seen[:15, 2] = False
    observations.seen[15:, :2] = False
    with pytest.raises(RefusedError, match="camera cam07 cannot be placed"):
        cold_start(observations, rough(truth.rig, 1.0), wand)
    observations.seen[:, 1] = False
    with pytest.raises(RefusedError, match="camera cam04 cannot be placed"):
        cold_start(observations, rough(truth.rig, 1.0), wand)

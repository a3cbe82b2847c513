import numpy as np
import pytest
import torch

from imgcal.association import lattice_shifts
from imgcal.geometry import RigidTransform
from imgcal.io import read_rig
from imgcal.matching.correlation import Scores
from imgcal.matching.maps import surprise_maps
from imgcal.matching.poses import Matcher, Ranked, Scene
from imgcal.matching.refinement import fit_and_measure, predictions, spacing
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.types import CalibrationObject
from renderers import palette

from .scenes import dim_frames


@pytest.fixture(scope="module")
def given():
    rig, obj, truth, (frames,) = dim_frames(seed=1)
    shots = [frames[name] for name in rig.camera_names]
    maps, response = surprise_maps(shots, 4, False, [None] * 4)
    scene = Scene(rig, obj, rig.prior.std(rig), 850.0)
    return scene, maps, response, shots, truth


def result(given, pose):
    scene, maps, response, shots, _ = given
    found = Matcher.on(scene, maps, 4 * scene.drift).rank(pose)
    return fit_and_measure(scene, found, maps, response, shots, False)


def test_fiducials_are_measured_where_they_are(given):
    truth = given[4]
    found = result(given, truth.rig_from_object)
    off = np.linalg.norm(found.uv - truth.uv[0].numpy(), axis=-1)
    assert found.seen.mean() > 0.85 and np.median(off[found.seen]) < 0.6
    assert (off[found.seen] < 6 * np.hypot(found.sigma[found.seen], 0.3)).all()


def test_nothing_is_measured_at_a_wrong_pose(given):
    pose = given[4].rig_from_object
    turn = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=torch.float64)
    found = result(given, RigidTransform(pose.rotation @ turn, pose.translation))
    assert found is None or found.seen.mean() < 0.5


def test_spacing_is_that_of_neighbours():
    uv = np.stack(np.meshgrid(np.arange(4) * 10.0, np.arange(3) * 30.0), -1).reshape(1, -1, 2)
    assert spacing(uv) == 10


@pytest.mark.parametrize("cameras", [[1], [0, 2]])
def test_a_camera_that_is_a_step_of_the_lattice_off_is_put_right(cameras):
    """The whole pattern shifted by one dot in some camera hides its edge only: what was found there is no more."""
    side = torch.arange(9, dtype=torch.float64)
    points = 25.0 * torch.cartesian_prod(side, side, torch.zeros(1, dtype=torch.float64))
    rig, obj = read_rig("T4").resized(torch.tensor((640, 340))), CalibrationObject(points - points.mean(0), palette(81))
    truth = simulate_truth(rig, obj, 1, torch.Generator().manual_seed(2), PhysicalDrift())
    uv, (v, u) = truth.uv[0].numpy(), np.mgrid[:340, :640]
    draw = np.random.default_rng(0)
    shots = [
        (40 + 25 * sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8) for x, y in dots) + draw.normal(0, 6, v.shape))
        for dots in uv
    ]
    shots = [shot.clip(0, 255).astype(np.uint8) for shot in shots]
    scene, pose = Scene(rig, obj, rig.prior.std(rig), 850.0), truth.rig_from_object
    expected = predictions(rig, scene, pose[0])
    motion = lattice_shifts(obj)[0]
    step = RigidTransform(torch.from_numpy(motion.rotation), torch.from_numpy(motion.translation))
    shift = (uv - expected).mean(1)
    shift[cameras] += (predictions(rig, scene, pose[0] @ step) - expected).mean(1)[cameras]
    maps, response = surprise_maps(shots, 4, False, [None] * 4)
    found = fit_and_measure(
        scene, Ranked(pose, Scores(np.full((1, 4), 20.0), shift[None])), maps, response, shots, False
    )
    assert found is not None and found.seen.mean() > 0.95
    assert np.linalg.norm(found.uv - uv, axis=-1)[found.seen].max() < 2

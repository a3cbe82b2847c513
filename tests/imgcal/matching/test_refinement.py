import numpy as np
import pytest
import torch

from imgcal.geometry import RigidTransform
from imgcal.matching.maps import surprise_maps
from imgcal.matching.poses import Matcher, Scene
from imgcal.matching.refinement import fitted, spacing

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
    return fitted(scene, found, maps, response, shots, False)


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

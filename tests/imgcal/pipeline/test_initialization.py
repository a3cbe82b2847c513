"""First guesses of networks from labelled fiducials, and the handling of a bad one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import data_path, load_object, read_rig
from imgcal.pipeline import calibrate, load_initializer, rms_length
from imgcal.pipeline.initialization import KINDS, Initializer
from imgcal.synthesis import PhysicalDrift, PoseRange, RelativeDrift, simulate_truth, synthesize, true_detections
from imgcal.types import Observations, Prediction

SNAPSHOTS = 3


class Oracle(nn.Module):
    """Knows the truth, or a turned one."""

    image_options = None

    def __init__(self, truth, turn=0.0):
        super().__init__()
        self.truth, self.turn = truth, turn

    def forward(self, views):
        assert views.uv.shape[0] == len(self.truth.rig_from_object.translation)
        rig = self.truth.rig.retract(torch.full_like(self.truth.rig.distortion[..., :1], self.turn).expand(-1, -1, 15))
        return (Prediction(rig, self.truth.rig_from_object),)


@pytest.fixture
def case():
    factory, obj = read_rig("O10"), load_object("asymmetric8")
    made = synthesize(factory, obj, SNAPSHOTS, torch.Generator().manual_seed(5), drift=None, pose_range=PoseRange())
    rig = RelativeDrift().apply(factory, torch.Generator().manual_seed(6))
    uv = rig.expand(SNAPSHOTS).project(made.rig_from_object.apply(obj.points)).uv
    seen = made.projection.visible.clone()
    seen[1, 2, 3] = False
    observations = Observations(uv, torch.full_like(seen, 0.1, dtype=torch.float64), seen)
    return factory, obj, observations, Prediction(rig.expand(SNAPSHOTS), made.rig_from_object)


def test_a_guess_is_the_mean_rig_of_the_snapshots(case):
    factory, obj, observations, truth = case
    guess = Initializer("oracle", Oracle(truth), factory).guess(observations, factory, obj)
    assert torch.allclose(guess.rig.focal_length, truth.rig.focal_length[0])
    assert guess.residual.abs().max() < 1e-6
    assert (guess.residual[1, 2, 3] == 0).all()


def test_images_of_another_size_are_taken(case):
    factory, obj, observations, truth = case
    half = factory.resized(factory.image_size // 2)
    small = replace(observations, uv=(observations.uv + 0.5) / 2 - 0.5)
    guess = Initializer("oracle", Oracle(truth), factory).guess(small, half, obj)
    assert torch.allclose(guess.rig.focal_length, truth.rig.focal_length[0] / 2)
    assert guess.residual.abs().max() < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_the_shipped_networks_are_near(case, kind):
    factory, obj, observations, _ = case
    guess = load_initializer(kind, factory, obj).guess(observations, factory, obj)
    assert rms_length(guess.residual, observations.seen) < 4.0


def test_a_shipped_network_does_not_mind_a_radius(case):
    factory, obj, *_ = case
    spheres = replace(obj, radius=torch.full((obj.num_fiducials,), 6.0, dtype=torch.float64))
    assert load_initializer("points", factory, spheres).name == "points-O10-asymmetric8"


def test_the_folder_of_a_run_is_its_network(tmp_path):
    o10, cube = read_rig("O10"), load_object("cube8")
    with pytest.raises(InputError, match=r"found a folder without model\.safetensors"):
        load_initializer(str(tmp_path), o10, cube)
    (tmp_path / "my-rig").mkdir()
    (tmp_path / "my-rig" / "model.safetensors").symlink_to(data_path("models", "points-O10-cube8.safetensors"))
    assert load_initializer(str(tmp_path / "my-rig"), o10, cube).name == "my-rig"


@pytest.mark.parametrize(
    ("name", "rig", "message"),
    [
        ("pointz", "O10", "expected none, points, vit, cnn"),
        ("points", "U7", "no shipped network for rig U7"),
        ("vit", "T4", "imgcal train"),
    ],
)
def test_what_does_not_fit_is_refused(name, rig, message):
    with pytest.raises(InputError, match=message):
        load_initializer(name, read_rig(rig), load_object("asymmetric8"))


def test_what_a_shipped_network_lacks_is_said():
    other = read_rig("T4")
    with pytest.raises(InputError, match=r"train one .* focal length of cam01: found"):
        load_initializer("vit", other, load_object("asymmetric8"))


@pytest.mark.parametrize(("turn", "used"), [(0.0, True), (0.3, False)])
def test_the_result_does_not_depend_on_the_guess(turn, used, o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, SNAPSHOTS, torch.Generator().manual_seed(2), PhysicalDrift())
    table = true_detections(truth)
    table.uv[:] += 0.05 * np.random.default_rng(2).standard_normal(table.uv.shape)
    table.sigma[:] = 0.05
    known = Prediction(truth.rig.expand(SNAPSHOTS), truth.rig_from_object)
    initializer = Initializer("oracle", Oracle(known, turn), o10)
    plain, guided = calibrate(table, o10, asymmetric8), calibrate(table, o10, asymmetric8, initializer=initializer)
    assert guided.guess_used == used
    assert guided.initialization.name == "oracle"
    assert plain.initialization is None and not plain.guess_used
    assert torch.allclose(guided.rig.focal_length, plain.rig.focal_length, atol=0.05)


class PerSnapshot(Oracle):
    """Explains every snapshot perfectly, each with a rig that is turned by another angle, and the object with it."""

    def forward(self, views):
        angles = torch.linspace(-0.2, 0.2, SNAPSHOTS, dtype=torch.float64)
        turn = rotation_from_vector(torch.stack((angles, -angles, angles.square()), -1))
        motion = RigidTransform(turn, torch.zeros(SNAPSHOTS, 3, dtype=torch.float64))
        there = self.truth.rig.cam_from_rig @ motion.inverse()[:, None]
        rig = replace(self.truth.rig, cam_from_rig=there)
        return (Prediction(rig, motion @ self.truth.rig_from_object),)


def test_a_guess_is_judged_by_the_mean_rig_that_the_start_is_made_of(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, SNAPSHOTS, torch.Generator().manual_seed(2), PhysicalDrift())
    known = Prediction(truth.rig.expand(SNAPSHOTS), truth.rig_from_object)
    result = calibrate(
        true_detections(truth), o10, asymmetric8, initializer=Initializer("oracle", PerSnapshot(known), o10)
    )
    assert result.initialization.residual.abs().max() < 1e-6  # of each snapshot's own rig
    assert not result.guess_used


def test_a_symmetric_object_may_be_labelled_in_any_turn(o10):
    cube, generator = load_object("cube8"), torch.Generator().manual_seed(7)
    made = synthesize(o10, cube, SNAPSHOTS, generator, drift=RelativeDrift())
    sigma = torch.full(made.projection.visible.shape, 0.1, dtype=torch.float64)
    initializer = load_initializer("points", o10, cube)
    upright = initializer.guess(Observations(made.projection.uv, sigma, made.projection.visible), o10, cube)
    for motion in (cube.symmetries[5], cube.symmetries[17]):
        uv = made.projection.uv[:, :, motion.permutation]
        turned = initializer.guess(Observations(uv, sigma, made.projection.visible), o10, cube)
        assert rms_length(turned.residual, made.projection.visible) < 1.0
        assert torch.allclose(turned.rig.focal_length, upright.rig.focal_length, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_some_cameras_in_any_order_are_enough(case, kind):
    factory, obj, observations, truth = case
    keep = [9, 2, 4, 1]
    rig = factory.select(keep)
    some = Observations(observations.uv[:, keep], observations.sigma[:, keep], observations.seen[:, keep])
    guess = load_initializer(kind, rig, obj).guess(some, rig, obj)
    assert guess.rig.camera_names == rig.camera_names
    assert rms_length(guess.residual, some.seen) < 4.0
    off = (guess.rig.focal_length - truth.rig.focal_length[0, keep]).abs().mean()
    assert off < (rig.focal_length - truth.rig.focal_length[0, keep]).abs().mean()


def test_a_camera_of_another_rig_is_refused(case):
    factory, obj, *_ = case
    stranger = replace(factory.select([0, 1, 2]), camera_names=("cam01", "cam02", "other"))
    with pytest.raises(InputError, match="no shipped network for rig O10"):
        load_initializer("points", stranger, obj)

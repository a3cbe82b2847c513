import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.types import check_rig, has_plausible_values


@pytest.fixture(scope="module")
def scene():
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    return rig, obj, true_detections(simulate_truth(rig, obj, 2, torch.Generator().manual_seed(0), None))


@pytest.mark.parametrize(
    ("name", "value"),
    [("sigma", 1e300), ("sigma", 1e-300), ("sigma", np.nan), ("sigma", -0.1), ("radius", -1.0), ("radius", np.inf)],
)
def test_blobs_that_cannot_be_are_named(name, value, scene):
    rig, obj, detections = scene
    column = getattr(detections, name).copy()
    column[3] = value
    for use in (imgcal.calibrate, imgcal.score):
        with pytest.raises(InputError, match=f"{name}.* row 3"):
            use(replace(detections, **{name: column}), rig, obj)


def test_observations_with_a_sigma_that_cannot_be_are_named(scene):
    rig, obj, detections = scene
    shape = (2, rig.num_cameras, obj.num_fiducials)
    uv = torch.from_numpy(detections.uv).reshape(*shape, 2)
    for sigma in (0.0, -0.1):
        seen, sigmas = torch.ones(shape, dtype=torch.bool), torch.full(shape, 0.1, dtype=uv.dtype)
        sigmas[1, 2, 3] = sigma
        with pytest.raises(InputError, match=r"sigma\[1, 2, 3\]"):
            imgcal.estimate(imgcal.Observations(uv, sigmas, seen), rig, obj)
        seen[1, 2, 3] = False  # what is not seen needs none
        assert imgcal.estimate(imgcal.Observations(uv, sigmas, seen), rig, obj).converged


@pytest.mark.parametrize(
    "change",
    [
        lambda rig: {"focal_length": rig.focal_length * 1e-150},
        lambda rig: {"focal_length": rig.focal_length * 1e300},
        lambda rig: {"focal_length": -rig.focal_length},
        lambda rig: {"principal_point": rig.principal_point * torch.nan},
        lambda rig: {"distortion": rig.distortion * torch.inf},
        lambda rig: {"cam_from_rig": RigidTransform(rig.cam_from_rig.rotation, rig.cam_from_rig.translation + 1e200)},
        lambda rig: {"cam_from_rig": RigidTransform(rig.cam_from_rig.rotation * 2, rig.cam_from_rig.translation)},
        lambda rig: {"image_size": rig.image_size * 0},
    ],
)
def test_rigs_that_cannot_be_are_refused(change, scene):
    rig, obj, detections = scene
    broken = replace(rig, **change(rig))
    for use in (lambda: imgcal.calibrate(detections, broken, obj), lambda: imgcal.RigKeeper(broken, obj)):
        with pytest.raises(InputError, match="camera cam01"):
            use()


def _turned(rig, change):
    return replace(rig, cam_from_rig=RigidTransform(change(rig.cam_from_rig.rotation), rig.cam_from_rig.translation))


SHEAR = torch.eye(3).double() + 0.01 * torch.tensor([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]]).double()
MIRROR = torch.diag(torch.tensor([1.0, -1, 1])).double()


def _uses(rig, obj, detections):
    shape = (2, rig.num_cameras, obj.num_fiducials)
    seen, uv = torch.ones(shape, dtype=torch.bool), torch.from_numpy(detections.uv).reshape(*shape, 2)
    observations = imgcal.Observations(uv, torch.full(shape, 0.1), seen)
    return {
        "calibrate": lambda rig: imgcal.calibrate(detections, rig, obj),
        "score": lambda rig: imgcal.score(detections, rig, obj),
        "keeper": lambda rig: imgcal.RigKeeper(rig, obj),
        "estimate": lambda rig: imgcal.estimate(observations, rig, obj),
    }


@pytest.mark.parametrize("use", ["calibrate", "score", "keeper", "estimate"])
@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda turn: turn * 0.999, r"R R\^T off from the identity by 0.002"),
        (lambda turn: turn @ SHEAR, r"R R\^T off"),
        (lambda turn: MIRROR @ turn, "a mirror"),
        (lambda turn: turn * torch.nan, r"R R\^T off .* nan"),
    ],
)
def test_rotations_that_are_none_are_refused(change, found, use, scene):
    with pytest.raises(InputError, match=f"camera cam01: rotation: found {found}.*, expected a rotation matrix"):
        _uses(*scene)[use](_turned(scene[0], change))


def test_rounded_rotations_are_taken(scene):
    rig, _, _ = scene
    check_rig(_turned(rig, lambda turn: turn.float().double()))
    check_rig(_turned(rig, lambda turn: turn.round(decimals=6)))


@pytest.mark.parametrize("use", ["calibrate", "score", "keeper", "estimate"])
@pytest.mark.parametrize(
    ("change", "found"),
    [
        (
            lambda rig: {"cam_from_rig": RigidTransform(rig.cam_from_rig.rotation, rig.cam_from_rig.translation[:1])},
            "translation",
        ),
        (lambda rig: {"principal_point": rig.principal_point[:1]}, "principal_point"),
        (lambda rig: {"image_size": rig.image_size[:1]}, "image_size"),
        (lambda rig: {"distortion": rig.distortion[:, :4]}, "width 4"),
        (lambda rig: {"lens_model": ("brown_conrady",) * 2}, "2 lens models"),
        (lambda rig: {"camera_names": rig.camera_names[:3]}, "focal_length"),
        (lambda rig: {"camera_names": ("cam01",) * 4}, "more than once"),
        (lambda rig: {"prior": imgcal.RigPrior(rotation=-0.01)}, "prior: rotation"),
        (lambda rig: {"prior": imgcal.RigPrior(rotation=math.nan)}, "prior: rotation"),
        (lambda rig: {"prior": imgcal.RigPrior(position=math.inf)}, "prior: position"),
        (lambda rig: {"prior": imgcal.RigPrior(0, 0, 0, 0, 0)}, "zero for all"),
        (lambda rig: {"drift_rate": imgcal.DriftRate(position=math.nan)}, "drift_rate: position"),
        (lambda rig: {"working_distance": math.nan}, "working_distance"),
    ],
)
def test_rigs_whose_values_do_not_fit_together_are_refused(change, found, use, scene):
    with pytest.raises(InputError, match=f"rig T4: .*{found}"):
        _uses(*scene)[use](replace(scene[0], **change(scene[0])))


@pytest.mark.parametrize("use", ["calibrate", "score", "keeper"])
def test_what_is_no_rig_is_named(use, scene):
    with pytest.raises(InputError, match="rig: found 'T4', expected a CameraRig"):
        _uses(*scene)[use]("T4")
    with pytest.raises(InputError, match="found a batch of rigs"):
        _uses(*scene)[use](scene[0].expand(2))


def test_what_is_no_object_is_named(scene):
    rig, obj, detections = scene
    for use in (imgcal.calibrate, imgcal.score):
        with pytest.raises(InputError, match="object: found 'asymmetric8', expected a CalibrationObject"):
            use(detections, rig, "asymmetric8")
    for radius in ((), (1,), (3,), (8, 1)):
        with pytest.raises(InputError, match="object asymmetric8: found radius of shape"):
            replace(obj, radius=torch.ones(radius))
    with pytest.raises(InputError, match="points"):
        replace(obj, points=obj.points.numpy())


@pytest.mark.parametrize("change", [{"points": torch.full((8, 3), 1e30)}, {"radius": torch.zeros(8)}])
def test_objects_that_cannot_be_are_refused(change, scene):
    rig, obj, detections = scene
    with pytest.raises(InputError, match="fiducial 0"):
        imgcal.calibrate(detections, rig, replace(obj, **change))


def test_values_that_an_estimate_cannot_have_are_told_apart(scene):
    rig, _, _ = scene
    assert has_plausible_values(rig)
    assert not has_plausible_values(replace(rig, focal_length=-rig.focal_length))
    assert not has_plausible_values(replace(rig, distortion=rig.distortion * torch.nan))

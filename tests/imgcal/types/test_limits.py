from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.synthesis import simulate_truth, true_detections


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


@pytest.mark.parametrize("change", [{"points": torch.full((8, 3), 1e30)}, {"radius": torch.zeros(8)}])
def test_objects_that_cannot_be_are_refused(change, scene):
    rig, obj, detections = scene
    with pytest.raises(InputError, match="fiducial 0"):
        imgcal.calibrate(detections, rig, replace(obj, **change))

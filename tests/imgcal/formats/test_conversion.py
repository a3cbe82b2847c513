import numpy as np
import pytest
import torch

from imgcal.errors import InputError, RefusedError
from imgcal.formats import Holds, describe_lens, fill_image_sizes, fit_to_target, from_camera_rig, to_camera_rig
from imgcal.formats.conversion import NATIVE
from imgcal.types import CameraRig
from tests.imgcal.formats.rigs import apart, brown, fisheye, rig_of


def test_ours_projects_as_theirs_does() -> None:
    rig = rig_of(brown(-0.1, 0.02, 0.001, -0.002, 0.01), brown(0.05))
    ours = to_camera_rig(rig, "name")
    assert (ours.name, ours.camera_names) == ("name", ("side0", "side1"))
    points = torch.tensor([[100.0, 20.0, 1200.0], [-50.0, 100.0, 900.0]], dtype=torch.float64)
    for uv, camera in zip(ours.project(points).uv.numpy(), rig.cameras, strict=True):
        assert np.abs(uv - camera.project(points.numpy())).max() < 1e-9


def test_there_and_back(o10: CameraRig) -> None:
    there = from_camera_rig(o10)
    back = to_camera_rig(fit_to_target(there, NATIVE, "ours").rig, "O10")
    assert torch.equal(back.distortion, o10.distortion)
    assert torch.equal(back.cam_from_rig.translation, o10.cam_from_rig.translation)
    assert back.camera_names == o10.camera_names
    assert (back.name, back.working_distance, back.prior) == (o10.name, o10.working_distance, o10.prior)
    assert apart(there, from_camera_rig(back)) < 1e-9


def test_each_camera_keeps_its_own_lens_model() -> None:
    rig = rig_of(brown(-0.1, 0.02), fisheye(0.01, -0.02, 0.003, -0.001), brown(0.1, 0, 0, 0, 0, 0.2))
    ours = to_camera_rig(fit_to_target(rig, NATIVE, "ours").rig, "x")
    assert ours.lens_models == ("brown_conrady", "equidistant", "rational")
    points = torch.tensor([[100.0, 20.0, 1200.0], [250.0, 100.0, 900.0]], dtype=torch.float64)
    for uv, camera in zip(ours.project(points).uv.numpy(), rig.cameras, strict=True):
        assert np.abs(uv - camera.project(points.numpy())).max() < 1e-9
    assert apart(rig, from_camera_rig(ours)) < 1e-9


def test_image_sizes_are_asked_for_by_name() -> None:
    rig = rig_of(brown(), brown(), size=(0, 0))
    unknown = type(rig)(
        "x", tuple(type(c)(c.name, c.lens, None, c.rotation, c.translation) for c in rig.cameras), "mm", "f"
    )
    with pytest.raises(
        InputError, match=r"cameras side0, side1: the file does not state the size of the images.*side0=1280x720"
    ):
        fill_image_sizes(unknown, "file", {})
    with pytest.raises(InputError, match="camera side1: the file does not state the size"):
        fill_image_sizes(unknown, "file", {"side0": (640, 480)})
    found = fill_image_sizes(unknown, "file", {"": (1280, 960), "side1": (640, 480)})
    assert [camera.image_size for camera in found.cameras] == [(1280, 960), (640, 480)]
    with pytest.raises(InputError, match="found camera side7"):
        fill_image_sizes(unknown, "file", {"side7": (640, 480)})
    with pytest.raises(InputError, match="found 640x480 pixels, --image-size says 1x1"):
        fill_image_sizes(found, "file", {"side1": (1, 1)})


def test_a_lens_that_cannot_be_said_is_refused() -> None:
    rig = rig_of(brown(0.1, 0, 0, 0, 0, 0.3), brown())
    with pytest.raises(RefusedError, match=r"camera side0: it cannot express its lens \(OpenCV, 6 coefficients\).* px"):
        fit_to_target(rig, Holds((4,)), "it", 1e-3)
    held = fit_to_target(rig, Holds((4,)), "it", 10.0)
    assert 0 < max(fit.worst for fit in held.fits) < 10
    assert held.fits[1].exact
    assert held.rig.cameras[0].lens.length == 4
    assert describe_lens(fisheye(0.1)) == "fisheye, equidistant, 1 coefficient"


def test_values_that_no_rig_has() -> None:
    rig = rig_of(brown(), brown()).scale(1e9, "mm")
    with pytest.raises(InputError, match="translation"):
        to_camera_rig(rig, "x")

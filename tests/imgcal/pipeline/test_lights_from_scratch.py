"""Without a factory calibration, from one light: up to scale, or with a given distance; from a stick."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal import CameraRig, InputError, RefusedError, load_rig
from imgcal.association import Lights
from imgcal.geometry import RigidTransform
from imgcal.pipeline import calibrate_from_scratch
from imgcal.pipeline.lights_from_scratch import _scale_of_stick
from imgcal.synthesis import simulate_volume, true_detections
from imgcal.types import CalibrationObject, RigPrior
from scripts.benchmarks.lights import LIGHTS, Scene, simulate
from tests.imgcal.association.stick_scenes import PAIR, TRIPLE

CAMERAS = [0, 2, 5, 7]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """One light, a quarter of it hidden, and no false blobs."""
    scene = simulate(markers=1, moments=260, drift=1.0, seed=5)
    blobs = scene.detections
    kept = (scene.fiducial >= 0) & np.isin(blobs.camera, CAMERAS)
    blobs = blobs.select(kept)
    camera = np.searchsorted(CAMERAS, blobs.camera)
    names = tuple(scene.rig.camera_names[c] for c in CAMERAS)
    return replace(scene, rig=scene.rig.select(CAMERAS), detections=replace(blobs, camera=camera, camera_names=names))


def unplaced(rig: CameraRig) -> CameraRig:
    """What a user knows: images, and focal lengths to ten percent."""
    nowhere = RigidTransform.identity(rig.num_cameras, dtype=torch.float64)
    rough = replace(rig, cam_from_rig=nowhere, distortion=torch.zeros_like(rig.distortion), volume=None)
    return replace(rough, focal_length=1.1 * rig.focal_length, prior=RigPrior(0.15, 25.0, 0.1))


def test_rig_up_to_scale(scene: Scene) -> None:
    found = calibrate_from_scratch(scene.detections, unplaced(scene.rig), LIGHTS)
    apart, true = (torch.cdist(rig.positions, rig.positions) for rig in (found.rig, scene.rig))
    assert torch.allclose(apart / apart.max(), true / true.max(), atol=0.01)
    assert found.from_scratch
    assert found.scale.source == "none"
    assert found.scale.values["sigma_percent"] is None
    assert "scale is unknown" in found.scale.values["note"]
    assert found.lights is not None
    assert found.lights.agreement.agrees.all()


def test_distance_gives_the_scale(scene: Scene) -> None:
    first, second = scene.rig.camera_names[1], scene.rig.camera_names[3]
    true = torch.cdist(scene.rig.positions, scene.rig.positions)
    length = float(true[1, 3])
    found = calibrate_from_scratch(scene.detections, unplaced(scene.rig), LIGHTS, distance=(first, second, length))
    apart = torch.cdist(found.rig.positions, found.rig.positions)
    assert abs(float(apart[1, 3]) - length) < 0.5
    assert torch.allclose(apart, true, rtol=0.02)
    assert found.scale.source == "distance"
    assert torch.allclose(found.rig.positions[1], torch.zeros(3).double(), atol=1e-6)


def test_a_distance_must_be_one(scene: Scene) -> None:
    cameras, name = unplaced(scene.rig), scene.rig.camera_names[0]
    for distance in ((name, "cam99", 100.0), (name, name, 100.0), (name, scene.rig.camera_names[1], -3.0)):
        with pytest.raises(InputError, match="distance: found"):
            calibrate_from_scratch(scene.detections, cameras, LIGHTS, distance=distance)


def test_crowds_are_refused(scene: Scene) -> None:
    blobs = scene.detections
    crowded = replace(
        blobs,
        **{
            name: np.concatenate((getattr(blobs, name),) * 2)
            for name in ("sigma", "camera", "snapshot", "radius", "flags")
        },
        fiducial=np.full(2 * len(blobs), -1),
        uv=np.concatenate((blobs.uv, (blobs.uv + 80) % 900)),
    )
    with pytest.raises(RefusedError, match="expected at least 24: carry one light alone"):
        calibrate_from_scratch(crowded, unplaced(scene.rig), LIGHTS)


@pytest.mark.parametrize("points", [PAIR, TRIPLE])
def test_a_stick_gives_the_scale(points: tuple[tuple[float, float, float], ...]) -> None:
    rig, random = load_rig("room10").select(CAMERAS), np.random.default_rng(3)
    stick = CalibrationObject(torch.tensor(points).double(), torch.ones(len(points), 3), name="stick")
    seen = true_detections(simulate_volume(rig, stick, 120, torch.Generator().manual_seed(3), None))
    uv = seen.uv + 0.1 * random.standard_normal(seen.uv.shape)
    blobs = replace(seen, uv=uv, sigma=np.full(len(seen), 0.1), fiducial=np.full(len(seen), -1))
    found = calibrate_from_scratch(blobs.select(random.permutation(len(blobs))), unplaced(rig), stick)
    apart, true = (torch.cdist(one.positions, one.positions) for one in (found.rig, rig))
    assert float((apart - true).abs().max()) < 5.0
    assert torch.allclose(found.rig.positions[0], torch.zeros(3).double(), atol=1e-6)
    assert found.scale.source == "object"


def test_a_stick_of_another_length_is_refused() -> None:
    places = np.random.default_rng(0).uniform(-1000, 1000, (40, 3))
    moment, nothing = np.repeat(np.arange(20), 2), np.zeros(40)
    lights = Lights(np.zeros((40, 3), dtype=int), moment, places, nothing, nothing)
    stick = CalibrationObject(torch.tensor(PAIR).double(), torch.ones(2, 3), name="stick")
    with pytest.raises(RefusedError, match="too few show them at the distances of stick"):
        _scale_of_stick(lights, stick)


def test_one_light_with_labels_leaves_out_what_has_none(scene: Scene) -> None:
    blobs = scene.detections
    light = CalibrationObject(torch.zeros(1, 3).double(), torch.ones(1, 3))
    false = replace(blobs, uv=(blobs.uv + 300) % 900, fiducial=np.full(len(blobs), -1))
    columns = ("uv", "sigma", "camera", "snapshot", "radius", "flags", "fiducial")
    labelled = replace(blobs, fiducial=np.zeros(len(blobs), dtype=int))
    both = replace(blobs, **{n: np.concatenate((getattr(labelled, n), getattr(false, n))) for n in columns})
    found, alone = (calibrate_from_scratch(one, unplaced(scene.rig), light) for one in (both, blobs))
    assert torch.equal(found.rig.focal_length, alone.rig.focal_length)

"""A running rig that sees sticks or several objects: their distances give it its size."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.synthesis import SimulatedRig
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior

LOW, HIGH = torch.tensor([[-900.0, -900.0, 400.0], [900.0, 900.0, 1700.0]], dtype=torch.float64)
TOO_LARGE = 0.002
PRIOR = RigPrior(1e-4, 0.1, 1e-4, 1e-4, 8.0)
"""Nearly all that is unknown is where the cameras are, and so the size of the rig."""


def stick(*along: float) -> CalibrationObject:
    points = torch.tensor([[part, 0.0, 0.0] for part in along], dtype=torch.float64)
    return CalibrationObject(points, torch.ones(len(along), 3).double(), name="stick")


OBJECTS = {
    "stick": [stick(-250, -80, 250)],
    "two objects": [imgcal.load_object("wand4"), stick(-250, 250)],
    "equal objects": [imgcal.load_object("wand4"), imgcal.load_object("wand4")],
}


def resized(rig: CameraRig, ratio: float) -> CameraRig:
    positions = rig.positions.mean(0) + ratio * (rig.positions - rig.positions.mean(0))
    rotation = rig.cam_from_rig.rotation
    cam_from_rig = RigidTransform(rotation, -(rotation @ positions[..., None])[..., 0])
    return replace(rig, cam_from_rig=cam_from_rig, prior=PRIOR)


def size(rig: CameraRig) -> float:
    return float((rig.positions - rig.positions.mean(0)).norm())


def joined(parts: list[Detections]) -> Detections:
    """Blobs of several objects as one snapshot, without labels."""
    uv, sigma, camera, snapshot, radius, flags = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("uv", "sigma", "camera", "snapshot", "radius", "flags")
    )
    labels = np.full(len(uv), -1)
    return Detections(uv, sigma, camera, snapshot, labels, radius, flags, parts[0].camera_names, ("now",))


def watched(
    objects: list[CalibrationObject], given: CalibrationObject, count: int, path: Path | None = None
) -> imgcal.RigState:
    """Follow objects with a rig that is believed too large; a path: save and restore halfway."""
    rig = imgcal.load_rig("room10").to(torch.float64)
    worlds = [SimulatedRig(rig, obj, LOW, HIGH, seed=seed) for seed, obj in enumerate(objects)]
    keeper, events = imgcal.RigKeeper(resized(rig, 1 + TOO_LARGE), given), list[imgcal.Event]()
    for number in range(count):
        seconds = 40 * number / count
        # each carried elsewhere
        blobs = joined([world.snapshot(seconds + 300 * seed) for seed, world in enumerate(worlds)])
        state = keeper.update(blobs, time=seconds)
        events += state.events
        if path is not None and number == count // 2:
            keeper.save(path)
            keeper.__exit__(None, None, None)
            keeper = imgcal.RigKeeper.restore(path)
    keeper.__exit__(None, None, None)
    assert not [event for event in events if event.kind not in ("camera_lost", "camera_back")]
    return state


@pytest.mark.parametrize("name", OBJECTS)
def test_known_distances_give_the_size_of_a_running_rig(name: str, tmp_path: Path) -> None:
    objects = OBJECTS[name]
    state = watched(objects, CalibrationObject.of_several(objects), 120)
    before = resized(imgcal.load_rig("room10").to(torch.float64), 1.0)
    off = size(state.rig) / size(before) - 1
    assert abs(off) < min(4 * state.belief.scale_std(), 0.2 * TOO_LARGE)
    assert state.belief.scale_std() < 0.2 * TOO_LARGE
    assert "lights cannot improve it" not in state.sentence
    seen = set(state.detections.fiducial[state.detections.fiducial >= 0].tolist())
    assert len(seen & set(range(sum(obj.num_fiducials for obj in objects)))) >= 2
    if len(objects) == 1:
        again = watched(objects, objects[0], 120, tmp_path / "keeper.json")
        assert torch.equal(again.rig.positions, state.rig.positions)


def test_unknown_lights_leave_the_size_as_it_was() -> None:
    state = watched(OBJECTS["stick"], CalibrationObject.unknown(), 40)
    assert size(state.rig) / size(imgcal.load_rig("room10").to(torch.float64)) - 1 > 0.5 * TOO_LARGE
    assert "lights cannot improve it" in state.sentence

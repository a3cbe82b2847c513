"""The default checks of a keeper report a wrong object, and blame no camera."""

from dataclasses import replace

import torch

import imgcal
from imgcal.online import Event
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections


def told(points_after: torch.Tensor) -> list[Event]:
    """Keep a rig whose object is another one from snapshot 45 on."""
    factory, obj, generator = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(3)
    truth = simulate_truth(factory, obj, 60, generator, PhysicalDrift())
    events: list[Event] = []
    with imgcal.RigKeeper(factory, obj) as keeper:
        for s in range(60):
            points = points_after if s >= 45 else obj.points
            image = truth.rig.expand(1).project(truth.rig_from_object[s : s + 1].apply(points))
            uv = image.uv + 0.1 * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
            there = replace(truth, uv=uv, rig_from_object=truth.rig_from_object[s : s + 1])
            blobs = true_detections(there)
            events += keeper.update(replace(blobs, sigma=0 * blobs.sigma + 0.1), s / 60).events
    return events


def test_an_object_of_another_size_is_told_and_no_camera_blamed() -> None:
    points = imgcal.load_object("asymmetric8").points
    (event,) = told(points.mean(0) + 1.003 * (points - points.mean(0)))
    assert (event.kind, event.camera) == ("object_exchanged", None)
    assert event.size is not None
    assert abs(event.size - 0.3) < 0.05
    assert event.since == 45 / 60


def test_a_bent_object_is_told_and_no_camera_blamed() -> None:
    points = imgcal.load_object("asymmetric8").points.clone()
    points[2] += torch.tensor([0.6, -0.5, 0.6])
    events = told(points)
    assert [event.kind for event in events] == ["object_bent"]

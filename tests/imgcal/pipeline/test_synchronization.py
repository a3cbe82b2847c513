"""Unsynchronized cameras are distinguished from noise, lenses and wrong objects by the object's speed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import associate
from imgcal.pipeline.synchronization import LEAST_VIEWS, _verdict, find_unsynchronized
from imgcal.types import Detections
from scripts.benchmarks.rig_streams import Conditions, Stream

COUNT = 24


def capture(spread: float, seed: int = 2) -> Detections:
    """Labelled snapshots at 6 a second, of cameras whose moments are spread (s, standard deviation)."""
    conditions = Conditions(rate=6.0, labelled=True, clutter=0.0, hidden=0.0)
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), seed, conditions)
    rng, parts = np.random.default_rng(seed), []
    pace = np.tile(
        (0.1, 0.1, 0.1, 0.5, 1.0, 1.0, 1.0, 0.5), COUNT // 8
    )  # of the object's motion: it rests now and then
    times = pace.cumsum() / 6
    for number in range(COUNT):
        now = made.snapshot(number)
        off = rng.normal(0, spread, made.rig.num_cameras) if spread else np.zeros(made.rig.num_cameras)
        images = [
            made.rig.expand(1)
            .project_values(
                made.poses_at(torch.tensor([times[number] + pace[number] * float(later)], dtype=torch.float64)).apply(
                    made.obj.points
                ),
                made.obj.radius,
            )
            .uv[0, camera]
            for camera, later in enumerate(off)
        ]
        uv = torch.stack(images).numpy()[now.camera, now.fiducial]
        parts.append(replace(now, uv=uv + 0.1 * rng.standard_normal(uv.shape)))
    return Detections.join(parts)


def asked(seen: Detections):
    rig, obj = imgcal.load_rig("T4").to(torch.float64), imgcal.load_object("asymmetric8")
    return find_unsynchronized(associate(seen, rig, obj), rig, obj)


def images(share: float, seed: int = 1, count: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Speeds (px a snapshot), shifts (px) and scatter (px^2) of images that are off by a share of their speed."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0, 40, count)
    off = share * speed[:, None] * rng.standard_normal((count, 2)) / np.sqrt(2) + 0.2 * rng.standard_normal((count, 2))
    return speed, np.linalg.norm(off, axis=1), 0.02 * rng.chisquare(8, count) / 8


def test_shifts_that_grow_with_speed_are_moments_that_are_apart() -> None:
    found = _verdict(*images(0.05))
    assert found is not None
    assert found.share == pytest.approx(0.05, rel=0.2)
    assert found.still == pytest.approx(0.2 * np.sqrt(2), rel=0.3)
    assert "not synchronized" in str(found) and found.values["note"] == str(found)


def test_noise_and_errors_of_single_points_are_not() -> None:
    assert _verdict(*images(0.0)) is None
    speed, shift, scatter = images(0.05)
    assert _verdict(speed, shift, scatter * (1 + speed**2)) is None  # the points of an image disagree as well: blur


@pytest.mark.parametrize("seed", [2, 3])
def test_cameras_that_expose_together_are_not_blamed(seed: int) -> None:
    assert asked(capture(0.0, seed)) is None


def test_a_few_images_say_nothing() -> None:
    assert asked(capture(0.005).of_snapshots(0, LEAST_VIEWS // 8)) is None

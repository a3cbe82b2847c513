"""Cameras with clocks of their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.pipeline import calibrate
from imgcal.synthesis import simulate_board, true_detections


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_cameras_with_clocks_of_their_own_are_recognized(late):
    rig, generator = imgcal.load_rig("T4"), torch.Generator().manual_seed(9)
    obj = imgcal.load_object("charuco")
    truth = simulate_board(rig, obj, 1, generator, None)
    random, count = np.random.default_rng(1), 40
    time = np.cumsum(np.where(np.arange(count) % 13 < 6, 0.05, 0.4))  # slow, then fast
    moments = time[:, None] + late * np.gradient(time)[:, None] * random.standard_normal((count, 4))
    step = torch.from_numpy(
        np.stack([60 * np.sin(moments), 25 * np.cos(0.8 * moments), 20 * np.sin(0.5 * moments)], -1)
    )
    points = truth.rig_from_object[0].apply(obj.points)
    uv = torch.stack([rig.expand(count).project(points + step[:, c, None]).uv[:, c] for c in range(4)], 1)
    seen = true_detections(replace(truth, rig_from_object=_repeated(truth, count), uv=uv, visible=None))
    noisy = seen.uv + 0.1 * random.standard_normal(seen.uv.shape)
    found = calibrate(replace(seen, uv=noisy), rig, obj)
    assert (found.unsynchronized is not None) == (late > 0)
    if found.unsynchronized is not None:
        assert "not synchronized" in str(found.unsynchronized)
        assert 0.3 * late < found.unsynchronized.share < 2 * late


def _repeated(truth, count):
    from imgcal.geometry import RigidTransform

    pose = truth.rig_from_object
    return RigidTransform(pose.rotation.expand(count, 3, 3), pose.translation.expand(count, 3))

import numpy as np
import torch

from imgcal.geometry import RigidTransform
from imgcal.matching.correlation import BLIND, EVEN, HIDDEN, correlate, gains
from imgcal.matching.maps import Maps, surprise_maps

from .scenes import dim_frames


def slow(maps, gain, rig, obj, pose, reach):
    """One pose, shift by shift."""
    uv = rig.project(pose.apply(obj.points)).uv.numpy()
    scores, shifts = [], []
    for camera in range(rig.num_cameras):
        step = int(np.ceil(reach[camera] / maps.factor))
        cells = np.floor((uv[camera] + 0.5) / maps.factor).astype(int)
        width, height = maps.size[camera]
        total = np.zeros((2 * step + 1, 2 * step + 1))
        for i in range(-step, step + 1):
            for j in range(-step, step + 1):
                u, v = cells[:, 0] + j, cells[:, 1] + i
                inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
                total[i + step, j + step] = gain[camera, v[inside], u[inside]].sum()
        at = np.unravel_index(total.argmax(), total.shape)
        mean = total.max() + np.log(np.exp(np.maximum(total - total.max(), -700)).mean())
        scores.append(np.log(BLIND + (1 - BLIND) * np.exp(mean)))
        shifts.append([(at[1] - step) * maps.factor, (at[0] - step) * maps.factor])
    return np.array(scores), np.array(shifts)


def test_scores_are_those_of_every_shift_tried_alone():
    rig, obj, truth, (frames,) = dim_frames()
    maps, _ = surprise_maps([frames[name] for name in rig.camera_names], 4, False, [None] * 4)
    maps = maps.pool(8)
    reach, gain = np.array([20.0, 33.0, 8.0, 40.0]), gains(maps)
    off = RigidTransform(truth.rig_from_object.rotation, truth.rig_from_object.translation + 300)
    poses = RigidTransform.cat([truth.rig_from_object, off])
    found = correlate(maps, gain, rig, obj, poses, reach)
    for k in range(2):
        score, shift = slow(maps, gain, rig, obj, poses[k], reach)
        assert np.allclose(found.log_odds[k], score, atol=1e-3)
        assert (found.shift[k] == shift).all()
    assert found.total[0] > found.total[1] + 10


def test_gains_are_log_odds():
    """Under the null, surprise is exponential: the mean odds are one. A marker's surprise is larger."""
    surprise = np.random.default_rng(0).exponential(size=(1, 400, 500)).astype(np.float32)
    gain = gains(Maps(surprise, 1, np.array([[500, 400]]), np.zeros((1, 2), int)))
    assert abs(np.exp(gain).mean() - 1) < 0.15
    marker = -np.log(np.random.default_rng(1).uniform(size=100_000)) / EVEN  # ranks to the power of 1 / EVEN
    odds = np.log(HIDDEN + (1 - HIDDEN) * EVEN * np.exp((1 - EVEN) * marker))
    assert odds.mean() > 1 and gain.mean() < 0
    assert torch.tensor(gain).isfinite().all()

"""Noise beyond the blobs' own is estimated, and the first snapshots are learned with it."""

from dataclasses import replace

import numpy as np
import pytest

import imgcal
from imgcal.online import RigKeeper
from scripts.benchmarks.rig_streams import Conditions, Stream


@pytest.mark.parametrize(("said", "expected"), [(0.3, 0.0), (0.03, 0.3)])
def test_the_noise_is_found(said: float, expected: float) -> None:
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 8, Conditions(noise=0.3, clutter=0.0))
    with RigKeeper(made.factory, made.obj) as keeper:
        for time, blobs in made.snapshots(10):
            state = keeper.update(replace(blobs, sigma=np.full(len(blobs), said)), time)
    error = state.gauge.difference(state.rig, made.rig) / state.std
    assert 0.5 < float(error.square().mean().sqrt()) < 1.7
    absorbed_noise = keeper.noise
    assert absorbed_noise == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize("since", [0, 100])
def test_a_camera_that_is_noisier_than_it_says_has_not_moved_and_is_found_to(since: int) -> None:
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 2, Conditions())
    generator = np.random.default_rng(1)
    with RigKeeper(made.factory, made.obj) as keeper:
        for number, (time, blobs) in enumerate(made.snapshots(300)):
            noise = 0.3 * generator.standard_normal((len(blobs), 2)) * (blobs.camera == 1)[:, None]
            state = keeper.update(replace(blobs, uv=blobs.uv + noise * (number >= since)), time)
            assert state.events == ()
        assert keeper._memory.noise.additive == pytest.approx([0, 0.3, 0, 0], abs=0.07)
    error = state.gauge.difference(state.rig, made.rig) / state.std
    assert float(error[:, :10].square().mean().sqrt()) < 1.7

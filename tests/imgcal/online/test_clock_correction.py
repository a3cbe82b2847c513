"""Blobs of a late camera are put where they would have been in time; those of others stay where they are."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.online.clock_correction import clock_shifts, shift_blobs
from tests.imgcal.online.states import state_at

LATE = np.array([0.0, 0.0, 0.012, 0.0])
POSES = [(state.time, state.rig_from_object.reshape(1)) for state in (state_at(n, n / 60) for n in range(12))]


def test_blobs_of_a_late_camera_are_put_where_they_would_have_been() -> None:
    late, intime = (state_at(12, 0.2, lambda camera, by=by: by[camera]) for by in (LATE, 0 * LATE))
    blobs = replace(late.detections, fiducial=np.full(32, -1))
    off = np.linalg.norm(blobs.uv - intime.detections.uv, axis=1)
    assert off[16:24].min() > 2
    lag = clock_shifts(blobs, LATE, late.belief, POSES, 0.2)
    assert (lag[blobs.camera != 2] == 0).all()
    assert np.linalg.norm((blobs.uv + lag - intime.detections.uv)[16:24], axis=1).max() < 0.15
    assert (shift_blobs(blobs, lag, LATE).sigma[16:24] > blobs.sigma[16:24]).all()


@pytest.mark.parametrize("rate", [5, 6, 8, 10, 30])
def test_the_motion_is_known_at_every_rate_at_which_slips_are_found(rate: int) -> None:
    start = 1.7e9  # rounds times like those of a real stream
    poses = [(start + n / rate, state_at(n, n / rate).rig_from_object.reshape(1)) for n in range(12)]
    late, intime = (state_at(12, 11 / rate, lambda camera, by=by: by[camera]) for by in (LATE, 0 * LATE))
    before = clock_shifts(late.detections, LATE, late.belief, poses[:-1], poses[-1][0])
    assert np.isfinite(before).all()  # its blobs can be labelled
    lag = clock_shifts(late.detections, LATE, late.belief, poses, poses[-1][0])
    sigma = shift_blobs(late.detections, lag, LATE).sigma
    off = np.linalg.norm(late.detections.uv + lag - intime.detections.uv, axis=1)
    assert (off < 2 * sigma).all()


def test_where_nobody_knows_how_the_object_moves_a_late_camera_says_nothing() -> None:
    state = state_at(12, 5.0)
    for poses in ([], POSES[:1], POSES):
        lag = clock_shifts(state.detections, LATE, state.belief, poses, 5.0)
        assert np.isnan(lag[16:24]).all()
        assert (lag[:16] == 0).all()

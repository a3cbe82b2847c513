"""Replayed noise keeps the statistics of the recording, and the simulated room behaves as described."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import imgcal
from imgcal.synthesis import arrange_rig
from scripts.benchmarks.replayed_noise import BRIDGED, LEAST_RUN, Replay, Series, series_of, statistics
from scripts.benchmarks.replayed_stream import REPLAYED, Disturbances, Place, ReplayedStream, calibrated_stream
from scripts.benchmarks.rig_streams import Bump

CALM = Disturbances(wrong=0.0, people_every=math.inf, away_every=math.inf, merged=0.0)


def autoregressive(frames, decay, shared, own, seed, markers=5):
    """Residuals (F, N, 2): a shift of all markers that decays from frame to frame, and white noise of each."""
    random = np.random.default_rng(seed)
    white = random.standard_normal((frames, 2)) * shared * math.sqrt(1 - decay**2)
    shift = lfilter([1.0], [1.0, -decay], white, axis=0)
    return shift[:, None] + own * random.standard_normal((frames, markers, 2))


@pytest.mark.parametrize("decay", [0.0, 0.8, 0.95])
def test_replayed_residuals_are_correlated_as_the_recorded_ones(decay):
    recorded = autoregressive(12_000, decay, 0.1, 0.05, 0)
    series = series_of(recorded, np.random.default_rng(0))
    replayed = Replay([series], 5, np.random.default_rng(1)).draw(30_000)[:, 0]
    before, after = statistics(recorded), statistics(replayed)
    assert after["spread_px"] == pytest.approx(before["spread_px"], rel=0.03)
    assert after["shift_px"] == pytest.approx(math.hypot(0.1, 0.05 / math.sqrt(5)), rel=0.05)
    assert after["independent_px"] == pytest.approx(0.05 / math.sqrt(5), rel=0.05)
    for lag in ("1", "5", "20", "60"):
        # Residuals of two blocks are independent: of those a lag apart, lag / (mean length of a block) are.
        kept = 1 - int(lag) / 150
        assert after["shift_correlation"][lag] == pytest.approx(kept * before["shift_correlation"][lag], abs=0.06)


def test_gaps_are_bridged_or_end_a_run():
    recorded = autoregressive(1000, 0.9, 0.1, 0.02, 1)
    holed = recorded.copy()
    holed[300 : 300 + BRIDGED] = np.nan
    holed[600 : 601 + BRIDGED] = np.nan
    holed[700:, 2] = np.nan  # one marker
    series = series_of(holed, np.random.default_rng(0))
    assert len(series.residual) == 1000 - 1 - BRIDGED
    assert np.isfinite(series.residual).all()
    np.testing.assert_array_equal(series.residual[600:660], recorded[601 + BRIDGED : 661 + BRIDGED])
    np.testing.assert_array_equal(series.residual[:300], recorded[:300])
    assert statistics(series.residual)["shift_px"] == pytest.approx(0.1, rel=0.3)
    with pytest.raises(imgcal.InputError, match="found 0 frames"):
        series_of(recorded[: LEAST_RUN - 1], np.random.default_rng(0))


def test_more_markers_than_were_recorded_share_the_shift_and_nothing_else():
    series = series_of(autoregressive(5000, 0.8, 0.1, 0.05, 2), np.random.default_rng(0))
    drawn = Replay([series], 8, np.random.default_rng(1)).draw(5000)[:, 0]
    own = drawn[:, :5] - drawn[:, :5].mean(1, keepdims=True)
    more = drawn[:, 5:] - drawn[:, :5].mean(1, keepdims=True)
    assert abs((own[:, 0] * more[:, 0]).mean()) < 0.1 * (own[:, 0] ** 2).mean()
    assert np.corrcoef(drawn[:, 0, 0], drawn[:, 7, 0])[0, 1] > 0.7


@pytest.fixture
def place():
    rig = arrange_rig("ring", 4, 3000.0, height=2000.0, target=(0.0, 0.0, 1000.0))
    assert rig.volume is not None
    return Place(rig, rig, imgcal.load_object("wand4"), rig.volume)


def stream_in(place, given, *bumps, noise=0.1, length=400):
    silent = [Series(noise * np.random.default_rng(9).standard_normal((500, 4, 2)))]
    conditions = replace(REPLAYED, labelled=True, clutter=0.0, hidden=0.0)
    return ReplayedStream(
        place.factory, place.obj, 3, conditions, bumps, place=place, sources=silent, length=length, given=given
    )


def errors(stream, number):
    """Distances (M,) of a snapshot's blobs from where the true rig puts their markers, and the snapshot."""
    blobs = stream.snapshot(number)
    exact = stream.rig.project(stream.path[number].apply(stream.points), stream.obj.radius).uv.numpy()
    return np.linalg.norm(blobs.uv - exact[blobs.camera, blobs.fiducial], axis=1), blobs


def test_blobs_lie_where_the_true_rig_and_the_true_object_put_them(place):
    stream = stream_in(place, CALM, noise=1e-9)
    assert max(errors(stream, number)[0].max() for number in range(20)) < 1e-6
    off = (stream.points - place.obj.points).norm(dim=-1)
    assert (off >= 0.2).all() and (off <= 0.6).all()


def test_a_bump_comes_once_and_on_time(place):
    bump = Bump(205, 2, "rotation", math.radians(0.5))
    stream = stream_in(place, CALM, bump, noise=1e-9)
    for number in range(0, 400, 3):
        assert errors(stream, number)[0].max() < 1e-6
        turned = stream.rig.cam_from_rig.rotation[2] @ place.truth.cam_from_rig.rotation[2].T
        angle = math.degrees(math.acos(min(1.0, (float(turned.trace()) - 1) / 2)))
        assert angle == pytest.approx(0.5 if number >= 205 else 0.0, abs=1e-4)


def test_markers_that_come_near_each_other_are_one_blob_between_them(place):
    plain, merging = (stream_in(place, replace(CALM, merged=limit), noise=1e-9) for limit in (0.0, 60.0))
    fewer = 0
    for number in range(0, 400, 5):
        (_, apart), (off, merged) = errors(plain, number), errors(merging, number)
        fewer += len(apart) - len(merged)
        assert len(off) == 0 or off.max() < 60.0 * 4
        for camera in range(4):
            spots = merged.uv[merged.camera == camera]
            each = np.linalg.norm(spots[:, None] - spots[None], axis=-1)[np.triu_indices(len(spots), 1)]
            whole = apart.uv[apart.camera == camera]
            if len(spots) == len(whole):
                assert len(each) == 0 or each.min() >= 60.0
            else:
                assert len(spots) < len(whole)
    assert fewer > 20


def test_people_hide_cameras_and_the_object_goes_away(place):
    given = replace(CALM, people_every=1.0, people_for=(0.5, 1.0), away_every=3.0, away_for=(0.5, 1.0))
    calm, busy = stream_in(place, CALM), stream_in(place, given)
    seen = {"calm": 0, "busy": 0}
    dark = 0
    for number in range(400):
        seen["calm"] += len(calm.snapshot(number))
        blobs = len(busy.snapshot(number))
        seen["busy"] += blobs
        dark += blobs == 0
    assert 0.2 < seen["busy"] / seen["calm"] < 0.9
    assert dark >= 25


def test_wrong_blobs_are_wrong_for_one_snapshot(place):
    stream = stream_in(place, replace(CALM, wrong=0.05), noise=1e-9)
    wrong = []
    for number in range(300):
        off, blobs = errors(stream, number)
        wrong += [(number, int(c)) for c in blobs.camera[off > 1.0]]
        assert ((off < 1e-6) | ((off > 2.9) & (off < 30.1))).all()
    images = 300 * 4
    assert 0.02 * images < len(set(wrong)) < 0.08 * images


@pytest.mark.usefixtures("captures")
@pytest.mark.parametrize(("place", "seed"), [("ring8", 3), ("room10", 2)])
def test_recorded_errors_that_pass_are_no_motion_of_a_camera(place, seed):
    """Both were refused: "cam01 moved before snapshot 64", "cam10 or cam05 moved before snapshot 1560"."""
    _, calibration = calibrated_stream(place, seed, 10)
    assert calibration.moved == ()

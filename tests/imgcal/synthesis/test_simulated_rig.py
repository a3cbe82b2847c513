import numpy as np
import pytest
import torch

from imgcal.synthesis import SimulatedRig
from imgcal.synthesis.simulated_rig import NOISE, WARM

LOW, HIGH = torch.tensor([[-300.0, -200.0, 700.0], [300.0, 200.0, 1000.0]]).double()


@pytest.fixture
def running(o10, asymmetric8):
    return SimulatedRig(o10, asymmetric8, LOW, HIGH, seed=3)


def test_blobs_are_where_the_true_rig_sees_the_object(running, o10, asymmetric8):
    blobs = running.snapshot(4.0)
    uv = running.rig.project(running.pose(4.0).apply(asymmetric8.points)).uv.numpy()
    distance = np.linalg.norm(uv[blobs.camera] - blobs.uv[:, None], axis=-1).min(1)
    assert np.mean(distance < 5 * NOISE) > 0.97 and len(blobs) > 70 and (blobs.fiducial == -1).all()


def test_the_object_stays_in_its_box_and_moves(running, asymmetric8):
    places = torch.stack([running.pose(t).apply(asymmetric8.points).mean(0) for t in np.arange(0.0, 200.0, 0.5)])
    assert (places > LOW).all() and (places < HIGH).all()
    assert ((places.amax(0) - places.amin(0)) > 30.0).all()


def test_a_bump_turns_one_camera(running):
    before = running.rig
    running.bump(4, turn_deg=0.3, way_mm=1.0)
    step = running.rig.local(before)
    assert step[4, :3].norm().rad2deg() == pytest.approx(0.3) and step[4, 3:6].norm() == pytest.approx(1.0)
    assert step[[0, 1, 2, 3, 5]].abs().max() < 1e-9


def test_lenses_warm_up_slowly_and_cool_down(running, o10):
    running.snapshot(0.0)
    running.warm = True
    running.snapshot(10.0)
    early = (running.rig.focal_length / o10.focal_length - 1).mean()
    running.snapshot(1000.0)
    assert 0 < early < 0.2 * WARM
    assert (running.rig.focal_length / o10.focal_length - 1).mean() == pytest.approx(WARM, rel=0.3)
    running.warm = False
    running.snapshot(3000.0)
    assert (running.rig.focal_length / o10.focal_length - 1).abs().max() < 1e-8


def test_frames_are_small_and_dark_where_nothing_is_seen(running, o10):
    running.snapshot(0.0)
    running.covered.add(0)
    frames = running.frames(160)
    assert set(frames) == set(o10.camera_names) and frames["cam02"].shape == (85, 160)
    assert frames["cam01"].max() < 30 < frames["cam02"].max()
    running.away = True
    assert max(frame.max() for frame in running.frames(160).values()) < 30
    assert set(running.snapshot(0.1).camera.tolist()) <= set(range(1, 10)) and len(running.snapshot(0.2)) < 5

"""A running rig that is known by its last snapshots: cameras that move, and cameras that see nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_rig
from imgcal.online import RigKeeper
from imgcal.synthesis import FrameModel, PhysicalDrift, Truth, simulate_frames, simulate_truth, true_detections
from imgcal.types import CalibrationObject
from tests.imgcal.streams import Stream


def run(stream, keeper, snapshots, rig=None, **seen):
    """Update with some snapshots; gives the states."""
    return [keeper.update(stream.blobs(s, rig, **seen)[0], s / 60) for s in snapshots]


def moved(states):
    return [event.camera for state in states for event in state.events if event.kind == "moved"]


@pytest.mark.parametrize("horizon", [1, 2, 5, 20])
@pytest.mark.parametrize(
    ("turn_deg", "shift_mm"), [(0.1, 0.0), (0.5, 0.0), (2.0, 0.0), (10.0, 0.0), (0.0, 3.0), (0.0, 30.0)]
)
def test_a_bumped_camera_is_followed_at_once_and_no_other_is_blamed(horizon, turn_deg, shift_mm):
    stream = Stream("T4", "asymmetric8", horizon + 16, seed=horizon)
    camera, first = horizon % 4, horizon + 4
    after = stream.bumped([camera], turn_deg, shift_mm)
    with RigKeeper(stream.rig, stream.obj, horizon=horizon) as keeper:
        assert not moved(run(stream, keeper, range(first)))
        states = run(stream, keeper, range(first, horizon + 16), after)
    for s, state in enumerate(states):
        assert state.refused is None
        assert s < 3 or stream.errors(state.rig, first + s, after).max() < 0.3
    assert set(moved(states)) <= {stream.rig.camera_names[camera]}
    if horizon >= 5:
        assert moved(states[:3]) == [stream.rig.camera_names[camera]]
    if horizon == 20:
        (told,) = [event for state in states for event in state.events if event.change not in (None, "unknown")][:1]
        assert told.change == ("rotation" if turn_deg else "position")
        assert abs(told.size - (turn_deg or shift_mm)) < 5 * told.sigma
    elif moved(states):
        assert set(states[-1].cameras.values()) == {"ok"}


def test_without_a_horizon_what_is_known_of_other_cameras_is_kept():
    stream = Stream("T4", "asymmetric8", 80)
    with RigKeeper(stream.rig, stream.obj) as keeper, RigKeeper(stream.rig, stream.obj, horizon=5) as short:
        everything, latest = run(stream, keeper, range(80))[-1], run(stream, short, range(80))[-1]
    assert bool((everything.std[:, 6] < 0.6 * latest.std[:, 6]).all())


@pytest.mark.parametrize("turn_deg", [0.3, 2.0])
def test_two_cameras_bumped_at_once_while_the_object_jumps(turn_deg):
    stream = Stream("U7", "asymmetric8", 30, seed=3, jump=22)
    after = stream.bumped([0, 4], turn_deg)
    with RigKeeper(stream.rig, stream.obj, horizon=20) as keeper:
        run(stream, keeper, range(22))
        states = run(stream, keeper, range(22, 30), after)
    assert set(moved(states)) == {"cam01", "cam05"}
    assert stream.errors(states[-1].rig, 29, after).max() < 0.3


@pytest.mark.parametrize("horizon", [1, 5, 20])
def test_nothing_moves_in_a_rig_that_stands_still(horizon):
    stream = Stream("T4", "asymmetric8", 60)
    with RigKeeper(stream.rig, stream.obj, horizon=horizon) as keeper:
        states = run(stream, keeper, range(60), noise=0.1, false=0.3)
    assert not [event for state in states for event in state.events]


@pytest.mark.parametrize("horizon", [1, 5, 20])
def test_a_wand_in_a_room_is_never_refused_for_cameras_that_do_not_see_it(horizon):
    stream = Stream("room10", "wand4", 60)
    with RigKeeper(stream.rig, stream.obj, horizon=horizon) as keeper:
        for s in range(60):
            blobs, labels = stream.blobs(s, hidden=[s // 10, 5 + s // 20], false=0.3)
            state = keeper.update(blobs, s / 60)
            found = state.detections.fiducial[-len(labels) :]
            assert state.refused is None
            assert ((found < 0) | (found == labels)).mean() > 0.9
            assert not moved([state])
            learnt = np.unique(state.detections.camera[state.detections.fiducial >= 0])
            assert s < 10 or np.median(stream.errors(state.rig, s)[learnt]) < 0.5


def test_a_camera_that_is_out_keeps_its_last_values():
    stream = Stream("T4", "asymmetric8", 30)
    with RigKeeper(stream.rig, stream.obj, horizon=3) as keeper:
        last = run(stream, keeper, range(4))[-1]
        for s, state in enumerate(run(stream, keeper, range(4, 30), hidden=[1]), start=4):
            errors = stream.errors(state.rig, s)
            assert errors[[0, 2, 3]].max() < 0.5 and errors[1] < 8.0  # the factory is 28 px off
        back = run(stream, keeper, [29])[-1]
    assert torch.allclose(state.rig.focal_length[1], last.rig.focal_length[1], atol=2.0)
    before = stream.rig.prior.std(stream.rig)[1, 6:8]
    assert bool((state.std[1, 6:8] < 0.5 * before).all())
    assert stream.errors(back.rig, 29).max() < 0.5


def test_a_camera_that_has_seen_nothing_has_the_factory_values_and_prior():
    stream = Stream("T4", "asymmetric8", 8)
    with RigKeeper(stream.rig, stream.obj, horizon=3) as keeper:
        state = run(stream, keeper, range(8), hidden=[3])[-1]
    assert state.cameras["cam04"] == "unseen"
    assert torch.allclose(state.rig.focal_length[3], stream.rig.focal_length[3])
    assert torch.allclose(state.std[3, 6:], stream.rig.prior.std(stream.rig)[3, 6:], rtol=1e-6)


def test_a_horizon_of_no_snapshots_is_refused():
    with pytest.raises(InputError, match="horizon: found 0, expected at least 1 snapshot"):
        RigKeeper(read_rig("T4"), load_object("asymmetric8"), horizon=0)


def test_it_goes_on_from_its_file_bit_for_bit(tmp_path):
    stream = Stream("T4", "asymmetric8", 30)
    after = stream.bumped([1], 0.5)
    shots = [stream.blobs(s, after if s >= 15 else None, hidden=[2] if 8 <= s < 20 else [])[0] for s in range(30)]
    with RigKeeper(stream.rig, stream.obj, horizon=4) as keeper:
        states = []
        for s, blobs in enumerate(shots):
            states.append(keeper.update(blobs, s / 60))
            if s == 16:
                keeper.save(tmp_path / "state.json")
    with RigKeeper.restore(tmp_path / "state.json") as again:
        for s in range(17, 30):
            state = again.update(shots[s], s / 60)
            assert torch.equal(state.belief.factor, states[s].belief.factor)
            assert torch.equal(state.rig.focal_length, states[s].rig.focal_length)
            assert (state.cameras, state.events) == (states[s].cameras, states[s].events)


def test_a_large_cloud_is_followed_and_a_large_lattice_is_not():
    rig, generator = read_rig("T4"), torch.Generator().manual_seed(0)
    cloud = 120 * (torch.rand(100, 3, generator=generator, dtype=torch.float64) - 0.5)
    lattice = torch.cartesian_prod(*[torch.arange(n).double() * 12 for n in (10, 10, 1)])
    for points in (cloud, lattice - lattice.mean(0)):
        obj = CalibrationObject(points, torch.ones_like(points))
        truth = simulate_truth(rig, obj, 1, torch.Generator().manual_seed(0), PhysicalDrift(rotation_deg=0.05))
        labelled = true_detections(truth)
        blobs = replace(labelled, fiducial=np.full(len(labelled), -1))
        with RigKeeper(rig, obj, horizon=2) as keeper:
            for time in (0.0, 0.1):
                found = keeper.update(blobs, time).detections.fiducial
        right = [((found < 0) | (m.permutation[labelled.fiducial] == found)).all() for m in obj.symmetries]
        assert any(right) and (found >= 0).mean() > 0.9


def test_frames_of_a_camera_that_is_out_or_dark_stop_nothing():
    rig, obj = read_rig("T4").resized(torch.tensor([1024, 544])), load_object("asymmetric8")
    generator = torch.Generator().manual_seed(4)
    start = simulate_truth(rig, obj, 1, generator, PhysicalDrift())
    pose, times = start.rig_from_object[0], torch.arange(4.0)[:, None].double()
    turn = rotation_from_vector(times * torch.tensor([0.004, 0.006, -0.003], dtype=torch.float64))
    poses = RigidTransform(turn @ pose.rotation, pose.translation + 0.1 * times)
    truth = Truth(start.rig, poses, start.rig.expand(4).project(poses.apply(obj.points)).uv)
    frames = list(simulate_frames(truth, obj, FrameModel(), generator))
    dark = {name: np.full_like(frame, 12) for name, frame in frames[0].items()}
    with imgcal.RigKeeper(rig, obj, horizon=2) as keeper:
        assert keeper.update(frames[0], 0.0).refused is None
        assert keeper.update(dark, 0.1).refused is not None
        for number, shot in enumerate(frames[1:], start=2):
            state = keeper.update({**shot, "cam03": None if number % 2 else dark["cam03"]}, 0.1 * number)
            assert state.refused is None and float(np.nanmax(state.residual)) < 0.2


@pytest.mark.parametrize("name", ["lights", "a light"])
def test_lights_need_all_snapshots(name):
    obj = load_object("lights")
    if name == "a light":
        obj = replace(obj, unknown_markers=False)
    with pytest.raises(InputError, match="leave the horizon out"):
        RigKeeper(read_rig("T4"), obj, horizon=5)

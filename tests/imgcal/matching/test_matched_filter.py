from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal import InputError, RefusedError, RigKeeper, calibrate
from imgcal.association import Snapshot
from imgcal.detection import DetectionOptions, detect_snapshot, to_detections
from imgcal.geometry import geodesic_angle
from imgcal.io import load_object
from imgcal.matching import MatchedFilter
from imgcal.matching.correlation import Scores
from imgcal.matching.matched_filter import distinct
from imgcal.matching.poses import Ranked, Scene, turn_object
from imgcal.pipeline import recalibration
from renderers import SensorModel

from .scenes import DIM, dim_frames


def snapshot_of(frames, rig, obj, candidates=()):
    blobs = to_detections([detect_snapshot(frames, DetectionOptions())], rig.camera_names, ("0",))
    return Snapshot(frames, blobs, rig, obj, rig.prior.std(rig), tuple(candidates))


def errors(rows, truth, snapshot=0):
    return np.linalg.norm(rows.uv - truth.uv[snapshot].numpy()[rows.camera, rows.fiducial], axis=1)


def test_twelve_degrees_off_and_too_dim_for_blobs():
    rig, obj, truth, (frames,) = dim_frames()
    axis = torch.tensor([0.5, 1.0, -1.0], dtype=torch.float64)
    start = turn_object(truth.rig_from_object[0], np.radians(12) * axis / axis.norm(), obj)
    proposal = MatchedFilter().propose(snapshot_of(frames, rig, obj, [start]))
    assert proposal.reason == "" and proposal.margin > 20
    assert float(geodesic_angle(proposal.rig_from_object.rotation, truth.rig_from_object.rotation[0])) < 0.02
    assert len(proposal.detections) > 22 and np.median(errors(proposal.detections, truth)) < 0.6


def test_another_object_and_an_empty_frame_are_declined():
    rig, _, _, (frames,) = dim_frames()
    other = load_object("cube8")
    empty = {name: np.full_like(frame, 20) for name, frame in frames.items()}
    for shown in (frames, empty):
        proposal = MatchedFilter().propose(snapshot_of(shown, rig, other))
        assert proposal.reason or proposal.margin < 20


def test_calibrates_where_blobs_are_refused_and_says_who_did_it():
    rig, obj, truth, shots = dim_frames(snapshots=2, seed=2)
    stacks = {name: [shot[name] for shot in shots] for name in rig.camera_names}
    with pytest.raises(RefusedError):
        calibrate(stacks, rig, obj)
    result = calibrate(stacks, rig, obj, detector="auto")
    assert dict(result.detectors) == {"matched": 2} and result.identity == "unique"
    labelled = result.labelled_detections
    rows = labelled.select(labelled.fiducial >= 0)
    off = np.linalg.norm(rows.uv - truth.uv.numpy()[rows.snapshot, rows.camera, rows.fiducial], axis=1)
    assert len(rows) > 50 and (off < 3 * np.maximum(rows.sigma, 1.0)).all()


def test_blobs_come_first_where_they_decide():
    rig, obj, _, (frames,) = dim_frames(model=replace(DIM, sensor=SensorModel()))
    assert dict(calibrate(frames, rig, obj, detector="auto").detectors) == {"classical": 1}


@pytest.mark.parametrize("detector", ["auto", "matched"])
def test_copies_of_frames_are_not_looked_at(detector):
    rig, obj, _, shots = dim_frames(snapshots=3, seed=2, model=replace(DIM, sensor=SensorModel()))
    stacks = {name: [shot[name] for shot in (*shots, shots[1])] for name in rig.camera_names}
    result = calibrate(stacks, rig, obj, detector=detector)
    assert result.labelled.used == [0, 1, 2] and result.repeats.images == rig.num_cameras
    assert result.labelled.snapshots[3].reason == "a copy of snapshot 1"


def test_copies_are_named_where_the_calibration_by_blobs_is_refused(monkeypatch):
    rig, obj, _, shots = dim_frames(snapshots=3, seed=2, model=replace(DIM, sensor=SensorModel()))
    stacks = {name: [shot[name] for shot in (*shots, shots[1])] for name in rig.camera_names}
    fit, asked = recalibration.fit_with_timing, []

    def refuse_first(*given):
        asked.append(given)
        if len(asked) == 1:
            raise RefusedError("estimation: refused for a test")
        return fit(*given)

    monkeypatch.setattr(recalibration, "fit_with_timing", refuse_first)
    result = calibrate(stacks, rig, obj, detector="auto")
    assert result.labelled.used == [0, 1, 2] and result.repeats.images == rig.num_cameras
    assert result.labelled.snapshots[3].reason == "a copy of snapshot 1"


def test_a_running_rig_looks_too():
    rig, obj, _, shots = dim_frames(snapshots=2, seed=2)
    with RigKeeper(rig, obj) as blobs_alone, RigKeeper(rig, obj, detector="auto") as keeper:
        for number, shot in enumerate(shots):
            assert blobs_alone.update(shot, number / 60).refused is not None
            assert keeper.update(shot, number / 60).refused is None
    with pytest.raises(InputError, match="detector"):
        RigKeeper(rig, obj, detector="eye")


def test_of_a_cube_every_turn_is_the_same_pose():
    rig, obj, truth, (frames,) = dim_frames(obj="cube8", seed=3)
    scene, pose = Scene(rig, obj, rig.prior.std(rig), 850.0), truth.rig_from_object
    turns = torch.tensor([[0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.05], [0.0, 0.0, np.pi / 4]], dtype=torch.float64)
    scores = Scores(np.full((1, 4), 9.0), np.zeros((1, 4, 2)))
    others = Ranked(turn_object(pose, turns, obj), Scores(np.full((3, 4), 9.0), np.zeros((3, 4, 2))))
    assert distinct(others, Ranked(pose, scores), scene).tolist() == [False, False, True]
    result = calibrate(frames, rig, obj, detector="matched")
    assert result.identity == "ambiguous" and result.labelled.snapshots[0].alternatives == 24


def test_around_a_known_pose_nothing_else_is_looked_at():
    rig, obj, truth, (frames,) = dim_frames(size=(1280, 680))
    start = turn_object(truth.rig_from_object[0], torch.tensor([0.01, -0.02, 0.01], dtype=torch.float64), obj)
    prior = 0.2 * rig.prior.std(rig)
    given = replace(snapshot_of(frames, rig, obj, [start]), prior_std=prior)
    first = MatchedFilter().propose(given)
    v, u = np.mgrid[:680, :1280]
    noise = np.random.default_rng(0).integers(0, 255, (680, 1280)).astype(np.uint8)
    painted, count = {}, 0
    for name, uv in zip(rig.camera_names, truth.uv[0].numpy(), strict=True):
        (left, top), (right, bottom) = uv.min(0) - 180, uv.max(0) + 180
        far = (u < left) | (u > right) | (v < top) | (v > bottom)
        painted[name], count = np.where(far, noise, frames[name]), count + far.sum()
    assert count > 500_000
    second = MatchedFilter().propose(replace(given, frames=painted))
    assert first.margin > 40 and second.margin == first.margin
    assert np.array_equal(first.detections.uv, second.detections.uv)
    lost = MatchedFilter().propose(replace(given, frames=painted, candidates=()))
    assert lost.margin != first.margin

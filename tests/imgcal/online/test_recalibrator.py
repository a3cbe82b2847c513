from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.detection import detect
from imgcal.errors import InputError, RefusedError
from imgcal.geometry.rotations import rotation_from_vector
from imgcal.geometry.transforms import RigidTransform
from imgcal.io import load_object, load_rig
from imgcal.online.recalibrator import Recalibrator
from imgcal.synthesis.captures import FrameModel, Truth, simulate_frames, simulate_truth, true_detections
from imgcal.synthesis.rigs import PhysicalDrift
from imgcal.types.calibration_object import CalibrationObject


@pytest.fixture(scope="module")
def small():
    """A small rig, an object, and what the rig sees while the object moves smoothly and then jumps."""
    rig, obj = load_rig("T4").resized(torch.tensor([1024, 544])), load_object("asymmetric8")
    generator = torch.Generator().manual_seed(4)
    start = simulate_truth(rig, obj, 1, generator, PhysicalDrift())
    pose, times = start.rig_from_object[0], torch.tensor([0.0, 1, 2, 3, 4, 400])[:, None].double()
    turn = rotation_from_vector(times * torch.tensor([0.004, 0.006, -0.003], dtype=torch.float64))
    poses = RigidTransform(turn @ pose.rotation, pose.translation + 0.1 * times)
    truth = Truth(start.rig, poses, start.rig.expand(6).project(poses.apply(obj.points)).uv)
    return rig, obj, truth, list(simulate_frames(truth, obj, FrameModel(), generator))


def test_every_snapshot_gives_a_rig_with_right_labels(small):
    rig, obj, truth, frames = small
    with Recalibrator(rig, obj) as recalibrator:
        for s, snapshot in enumerate(frames):
            result = recalibrator.update(snapshot)
            seen = result.observations.seen[0]
            assert seen.sum() >= 26
            distance = (result.observations.uv[0] - truth.uv[s]).norm(dim=-1)
            assert distance[seen].max() < 0.5
            assert result.identity == ("unique" if s in (0, 5) else "by_tracking")


def test_a_window_of_snapshots_knows_the_rig_better(small):
    rig, obj, truth, frames = small
    errors = []
    for window in (1, 5):
        with Recalibrator(rig, obj, window=window) as recalibrator:
            for snapshot in frames:
                result = recalibrator.update(snapshot)
        assert len(result.labelled.snapshots) == window
        errors.append(float(result.rig.local(truth.rig)[:, 6:10].square().mean().sqrt()))
    assert errors[1] < errors[0]


def test_a_dark_snapshot_is_refused_and_the_next_one_is_not(small):
    rig, obj, _, frames = small
    with Recalibrator(rig, obj) as recalibrator:
        recalibrator.update(frames[0])
        with pytest.raises(RefusedError):
            recalibrator.update({name: np.full_like(frame, 12) for name, frame in frames[0].items()})
        assert recalibrator.update(frames[1]).rms < 0.1


def test_blobs_found_elsewhere_give_the_same_rig(small):
    rig, obj, truth, frames = small
    found = [detect(snapshot) for snapshot in frames[:2]]
    with Recalibrator(rig, obj) as by_frames, Recalibrator(rig, obj) as by_blobs, Recalibrator(rig, obj) as by_labels:
        for snapshot, blobs in zip(frames, found, strict=False):
            first, second = by_frames.update(snapshot), by_blobs.update(blobs)
            assert first.identity == second.identity
            assert torch.equal(first.rig.focal_length, second.rig.focal_length)
        labelled = true_detections(truth)
        coded = by_labels.update(replace(labelled.select(labelled.snapshot == 0), snapshot_names=("0",)))
        assert coded.identity == "coded" and coded.rms < 0.02
        with pytest.raises(InputError, match="found 6 snapshots"):
            by_labels.update(labelled)


def test_a_blob_that_is_off_loses_its_label_and_is_no_reason_to_start_anew(small):
    rig, obj, truth, _ = small
    exact = replace(true_detections(truth), fiducial=np.full(truth.uv[..., 0].numel(), -1))
    first, second = (replace(exact.select(exact.snapshot == s), snapshot_names=("",)) for s in (0, 1))
    second.uv[3] += [1.5, -1.0]  # as of two markers that overlap
    with Recalibrator(rig, obj) as recalibrator:
        recalibrator.update(first)
        result = recalibrator.update(second)
    assert result.labelled.snapshots[0].reason == "near the last prediction"
    assert result.labelled.detections.fiducial[3] == -1 and int(result.observations.seen.sum()) == len(second) - 1
    assert result.rms < 0.02


def test_a_large_cloud_is_followed_and_a_large_lattice_is_not():
    rig, generator = load_rig("T4"), torch.Generator().manual_seed(0)
    cloud = 120 * (torch.rand(100, 3, generator=generator, dtype=torch.float64) - 0.5)
    lattice = torch.cartesian_prod(*[torch.arange(n).double() * 12 for n in (10, 10, 1)])
    for points, reason in ((cloud, "near the last"), (lattice - lattice.mean(0), "explains")):
        obj = CalibrationObject(points, torch.ones_like(points))
        truth = simulate_truth(rig, obj, 1, torch.Generator().manual_seed(0), PhysicalDrift(rotation_deg=0.05))
        labelled = true_detections(truth)
        blobs = replace(labelled, fiducial=np.full(len(labelled), -1))
        with Recalibrator(rig, obj) as recalibrator:
            recalibrator.update(blobs)
            result = recalibrator.update(blobs)
        assert result.labelled.snapshots[0].reason.startswith(reason)
        found = result.labelled.detections.fiducial
        right = [((found < 0) | (m.permutation[labelled.fiducial] == found)).all() for m in obj.symmetries]
        assert any(right) and (found >= 0).mean() > 0.9

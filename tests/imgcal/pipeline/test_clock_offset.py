"""A lost or repeated frame of one camera is named with the camera and the snapshot; a bump is not taken for one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_rig
from imgcal.pipeline import LateCamera, calibrate
from imgcal.pipeline.clock_offset import timing_motion
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import MovedError
from tests.imgcal.pipeline.short_search import SHORT

COUNT = 14


def moving_object(*, camera=2, first=COUNT, by=0, bump=0.0, step=30.0, tilt=0.15):
    """Blobs of T4 and a hand-moved object; from snapshot `first` on, one camera shows another moment or is bumped."""
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    generator = torch.Generator().manual_seed(0)
    truth = simulate_truth(rig, obj, COUNT + 2, generator, PhysicalDrift())
    time = torch.arange(COUNT + 2).double()[:, None]
    phase = 6.28 * torch.rand(6, generator=generator).double()
    shift = step * torch.sin(time * torch.tensor([0.7, 0.5, 0.9]) + phase[:3])
    turn = rotation_from_vector(tilt * torch.sin(time * torch.tensor([0.6, 0.8, 0.4]) + phase[3:]))
    base = truth.rig_from_object[0]
    poses = RigidTransform(turn @ base.rotation, base.translation + shift)
    image = truth.rig.expand(COUNT + 2).project(poses.apply(obj.points.double()))
    uv, visible = image.uv[:COUNT].clone(), image.visible[:COUNT].clone()
    shown = torch.arange(first, COUNT) + by
    uv[first:, camera] = image.uv[shown, camera] + bump
    visible[first:, camera] = image.visible[shown, camera]
    blobs = true_detections(replace(truth, rig_from_object=poses[:COUNT], uv=uv, visible=visible))
    noise = 0.05 * np.random.default_rng(0).standard_normal(blobs.uv.shape)
    unlabelled = np.full(len(blobs), -1)
    return rig, obj, replace(blobs, uv=blobs.uv + noise, sigma=np.full(len(blobs), 0.05), fiducial=unlabelled)


@pytest.mark.parametrize(
    ("first", "by", "words"),
    [(7, 1, "one snapshot later: a frame was lost"), (3, 1, "later"), (7, -1, "earlier: a frame was repeated")],
)
def test_a_slip_is_named_with_camera_and_snapshot(first, by, words):
    rig, obj, blobs = moving_object(first=first, by=by)
    with pytest.raises(RefusedError) as refused:
        calibrate(blobs, rig, obj, SHORT)
    assert str(refused.value).startswith(f"camera cam03: from snapshot {blobs.snapshot_names[first]} on, its frames")
    assert words in str(refused.value) and "--without cam03" in refused.value.for_command


def test_a_slip_is_named_where_labels_are_given_and_the_object_jumps():
    """No motion links one snapshot to the next; most of the camera's labels are then refused."""
    rig, obj = read_rig("O6"), load_object("asymmetric8")
    blobs = true_detections(simulate_truth(rig, obj, 24, torch.Generator().manual_seed(11), PhysicalDrift()))
    noise = 0.05 * np.random.default_rng(0).standard_normal(blobs.uv.shape)
    late = (blobs.camera == 3) & (blobs.snapshot >= 10)
    shown = np.where(late, blobs.snapshot + 1, blobs.snapshot)
    blobs = replace(blobs, uv=blobs.uv + noise, sigma=np.full(len(blobs), 0.05), snapshot=shown).select(shown < 24)
    with pytest.raises(RefusedError, match=r"camera cam04: from snapshot 00011 on, its frames show .* earlier"):
        calibrate(blobs, rig, obj, SHORT)


def test_a_slip_near_the_end_is_said_beside_the_result():
    rig, obj, blobs = moving_object(first=11, by=1)
    result = calibrate(blobs, rig, obj)
    assert result.late == (LateCamera("cam03", blobs.snapshot_names[11], 1),)
    assert float(result.rms) < 0.1


def test_a_steady_capture_has_no_slip():
    rig, obj, blobs = moving_object()
    assert calibrate(blobs, rig, obj).late == ()


def test_little_motion_proves_nothing_about_timing():
    rig, obj, blobs = moving_object()
    assert calibrate(blobs, rig, obj).untimed == ()
    _, _, still = moving_object(step=0.01, tilt=0.0)
    _, _, late = moving_object(step=0.01, tilt=0.0, first=0, by=1)
    for given in (still, late):
        result = calibrate(given, rig, obj)
        assert result.late == () and result.untimed == rig.camera_names
    assert calibrate(still.of_snapshots(0, 1), rig, obj).untimed == rig.camera_names


def test_even_motion_is_what_a_turned_camera_shows():
    random = torch.Generator().manual_seed(0)
    first = 500 * torch.rand(1, 2, 5, 2, generator=random, dtype=torch.float64)
    time = torch.arange(9.0).double()[:, None, None, None]
    velocity = torch.tensor([[[[20.0, 3.0]]]]).double()
    seen = torch.ones(9, 2, 5, dtype=torch.bool)
    assert float(timing_motion(first + time * velocity, seen, np.arange(9) - 1).max()) < 1e-9
    swaying = timing_motion(
        first + 20 * torch.sin(time) * torch.tensor([1.0, 0.0]).double()[:, None, None], seen, np.arange(9) - 1
    )
    assert float(swaying[0]) > 5 and float(swaying[1]) == 0
    seen[:, 1] = False
    apart = timing_motion(first + 20 * torch.sin(time), seen, np.full(9, -1))
    assert apart.tolist() == [0.0, 0.0]  # what is two snapshots apart says nothing of one


def test_a_bump_is_no_slip():
    rig, obj, blobs = moving_object(first=7, bump=25.0)
    with pytest.raises(MovedError, match="camera cam03 moved before snapshot"):
        calibrate(blobs, rig, obj, SHORT)

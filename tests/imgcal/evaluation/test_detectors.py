"""Detectors are judged by the truth, which they do not know."""

from dataclasses import replace

import pytest
import torch

from imgcal.detection import DetectionOptions
from imgcal.evaluation import WRONG_PX, WRONG_RATIO, Contender, Scene, compare_detectors, draw_capture, judge
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate
from imgcal.synthesis import FrameModel, PhysicalDrift, simulate_truth, true_detections


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(read_rig("T4"), load_object("asymmetric8"), {"easy": FrameModel(), "same": FrameModel()}, snapshots=2)


@pytest.fixture(scope="module")
def calibrated(scene):
    truth = simulate_truth(scene.rig, scene.obj, 4, torch.Generator().manual_seed(3), PhysicalDrift())
    return calibrate(true_detections(truth), scene.rig, scene.obj), truth


def test_a_calibration_is_right_by_the_true_rig_and_wrong_by_another(calibrated, scene):
    result, truth = calibrated
    wrong, rms, worst, claimed = judge(result, truth.rig)
    assert not wrong and 0 < rms < worst < 0.15 < claimed < 0.5
    wrong, rms, worst, claimed_again = judge(result, scene.rig)  # the factory's, which it is not
    assert wrong and worst > max(WRONG_PX, WRONG_RATIO * claimed) and claimed_again == claimed


def test_the_frame_of_the_truth_does_not_matter(calibrated):
    result, truth = calibrated
    moved = replace(truth.rig, cam_from_rig=truth.rig.cam_from_rig @ truth.rig_from_object[0])
    assert judge(result, moved)[1] == pytest.approx(judge(result, truth.rig)[1], rel=1e-3)


def test_large_errors_that_are_owned_up_to_are_not_wrong(calibrated, scene):
    result, _ = calibrated
    unsure = replace(
        result,
        estimate=replace(result.estimate, inflation=torch.full((result.rig.num_cameras,), 1e8, dtype=torch.float64)),
    )
    wrong, rms, _, claimed = judge(unsure, scene.rig)
    assert not wrong and rms > 1 and claimed > 1


def test_everybody_gets_the_same_frames_and_own_settings(scene):
    blind = {"same": DetectionOptions(threshold=60_000)}
    contenders = [Contender("default"), Contender("blind to one", detection=blind, seed=4)]
    counted = []
    found = compare_detectors(contenders, scene, 1, seed=2, progress=counted.append)
    assert [(one.contender, one.difficulty, one.status) for one in found] == [
        ("default", "easy", "calibrated"),
        ("blind to one", "easy", "calibrated"),
        ("default", "same", "calibrated"),
        ("blind to one", "same", "refused"),
    ]
    assert counted == [1, 1] and {one.capture for one in found} == {200_000}
    first, again, other, refused = found
    assert first.held_out_px == again.held_out_px == other.held_out_px and first.held_out_px < 0.2
    assert first.frames == 8 and first.visible == 64 and 56 < first.right_labels <= first.labels <= 64
    assert refused.reason and refused.held_out_px is None and refused.training_seed == 4


def test_captures_depend_on_their_seed_alone(scene):
    truth, frames = draw_capture(scene, "easy", 5)
    again, others = draw_capture(scene, "same", 5), draw_capture(scene, "easy", 6)
    assert torch.equal(truth.uv, again[0].uv) and not torch.equal(truth.uv, others[0].uv)
    camera = scene.rig.camera_names[1]
    assert len(frames[camera]) == 2 and (frames[camera][1] == again[1][camera][1]).all()

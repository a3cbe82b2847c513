from dataclasses import replace

import numpy as np
import torch

from imgcal.detection import DetectionOptions, detect
from imgcal.io import load_object, read_rig
from imgcal.synthesis import (
    DIFFICULTIES,
    FrameModel,
    PhysicalDrift,
    RelativeDrift,
    join_truths,
    simulate_frames,
    simulate_shots,
    simulate_truth,
    true_detections,
)
from imgcal.types import CalibrationObject
from renderers import SensorModel


def test_one_rig_many_poses(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, 4, torch.Generator().manual_seed(0), RelativeDrift(0.05, 0.05))
    assert truth.uv.shape == (4, 10, 8, 2)
    assert truth.rig.batch_shape == ()
    for s in range(4):
        projection = truth.rig.project(truth.rig_from_object[s].apply(asymmetric8.points))
        assert projection.visible.all()
        assert torch.allclose(projection.uv, truth.uv[s])
    table = true_detections(truth)
    assert len(table) == 4 * 10 * 8
    assert np.array_equal(table.uv.reshape(4, 10, 8, 2), truth.uv.numpy())


def test_a_camera_has_one_focus_for_all_objects(asymmetric8):
    rig, cube8, generator = read_rig("T4"), load_object("cube8"), torch.Generator().manual_seed(0)
    first = simulate_truth(rig, asymmetric8, 2, generator, None)
    truth = join_truths([first, simulate_truth(rig, cube8, 2, generator, None)])
    several = CalibrationObject.of_several([asymmetric8, cube8])
    for shot in simulate_shots(truth, several, FrameModel(difficulty=DIFFICULTIES["defocus"]), generator):
        defocus = shot.markers.smear.defocus
        assert torch.equal(defocus, defocus[:, :1].expand(-1, 16)) and len(defocus[:, 0].unique()) == 4


def test_detected_centres_are_the_true_ones(o10, asymmetric8):
    """Spheres: the centre of the ellipse, not the image of the centre, is what a camera shows."""
    obj = replace(asymmetric8, radius=torch.full((8,), 8.0, dtype=torch.float64))
    rig = o10.select([0, 4])
    generator = torch.Generator().manual_seed(1)
    truth = simulate_truth(rig, obj, 1, generator, PhysicalDrift())
    frames = next(simulate_frames(truth, obj, FrameModel(SensorModel(bit_depth=16, read_noise=1.0)), generator))
    found = detect(frames, DetectionOptions(max_radius=40))
    for camera in range(2):
        centres = found.uv[found.camera == camera]
        distance = np.linalg.norm(centres[:, None] - truth.uv[0, camera].numpy()[None], axis=-1)
        assert distance.min(0).max() < 0.002
    # The bias that a model of points would have is many times larger.
    points = rig_uv(truth, obj)
    assert np.abs(points - truth.uv[0].numpy()).max() > 0.015


def rig_uv(truth, obj):
    return truth.rig.project(truth.rig_from_object[0].apply(obj.points)).uv.numpy()

import numpy as np
import torch

import imgcal
from imgcal.association import Snapshot
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.types import Detections, RigPrior
from scripts.results.infrared import Case, Tally, tables


def case() -> tuple[Case, Detections]:
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("cube8")
    truth = simulate_truth(rig, obj, 1, torch.Generator().manual_seed(0), None)
    exact = true_detections(truth)
    snapshot = Snapshot({}, exact, rig, obj, RigPrior().std(rig))
    visible = np.ones((4, 8), dtype=bool)
    visible[0, 0] = visible[1, 1] = False
    return Case(snapshot, truth.uv[0].numpy(), visible, truth.rig_from_object[0]), exact


def test_right_wrong_and_what_hardly_shows() -> None:
    made, exact = case()
    uv = exact.uv.copy()
    uv[0] += 50.0  # of camera 0, fiducial 0, which is hidden: a wrong claim all the same
    uv[4] += (3.0, 4.0001)  # wrong
    uv[5] += (0.6, 0.8)  # right, one pixel off
    tally = Tally()
    tally.add(made, Detections(**{**vars(exact), "uv": uv, "sigma": np.full(len(uv), 0.5)}), 0.1)
    said = tally.result()
    assert said["visible"] == 30
    assert said["claimed"] == 31  # fiducial 1 of camera 1 is hidden and rightly placed: neither right nor wrong
    assert said["right_percent"] == 100 * 29 / 30
    assert said["wrong_percent"] == 100 * 2 / 31
    np.testing.assert_allclose(said["rms_px"], (0.5 / 29) ** 0.5)
    np.testing.assert_allclose(said["nees"], 0.5 / 0.25 / 29)


def test_believed_poses_are_turned_as_said() -> None:
    made, _ = case()
    believed = made.believed(12.0, 3).candidates[0]
    assert isinstance(believed, RigidTransform)
    angle = float(torch.rad2deg(geodesic_angle(believed.rotation, made.pose.rotation)))
    assert abs(angle - 12) < 1e-6
    centre = made.snapshot.obj.points.mean(0, keepdim=True)
    assert 1 < float((believed.apply(centre) - made.pose.apply(centre)).norm()) < 40


def test_tables_show_every_method_where_it_was_asked() -> None:
    said = {"right_percent": 90.0, "wrong_percent": 1.0, "rms_px": 0.2, "nees": 1.1}
    levels = {"clean": {"blobs": {"1": said, "12": said}, "net, encoder zeroed": {"1": said}}}
    lost = {"net": {"accepted": 1, "refused": 2, "wrong labels": 0}}
    others = {"T4, cube8, clean": {"blobs": {"1": said}}}
    made = tables({"levels": levels, "others": others, "lost": lost, "turned_deg": 12.0, "harder": levels})
    assert "net, encoder zeroed | 90.0 / 1.0" in made["infrared levels"]
    assert "zeroed" not in made["infrared turned"]
    assert "blobs, 12 degrees off" in made["infrared harder"]
    assert "| net | 2 | 1 | 0 |" in made["infrared lost"]
    assert "0.20 / 1.10" in made["infrared accuracy"]
    assert "T4, cube8, clean" in made["infrared others"]

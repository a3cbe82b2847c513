from pathlib import Path

import numpy as np
import torch

import imgcal
from imgcal.association import Snapshot
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.networks import InfraredConfig, InfraredNetwork, use_generators
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.types import Detections, RigPrior
from scripts.results import infrared_families, saliency
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


def test_families_stand_with_their_spread_over_seeds(tmp_path: Path) -> None:
    seeds = {
        str(k): {"right": right, "wrong": 0.04, "nees": 1.0, "missed": 1.04 - right, "curve": [[0, 0.9], [1200, 0.3]]}
        for k, right in enumerate((0.7, 0.8))
    }
    frames = {str(k): {"right_percent": 90.0 + 2 * k, "wrong_percent": 1.0} for k in range(2)}
    result = {
        "encoders": {name: {"parameters": 250_000, "flops": 178e6, "seeds": seeds} for name in ("cnn", "vit")},
        "frames": {level: {"cnn": frames, "vit": frames} for level in ("clean", "combined")},
    }
    made = infrared_families.tables(result)
    assert "| vit | 250 k | 178 M | 2 | 75.0 ± 7.1 | 4.0 ± 0.0 | 1.00 ± 0.00 |" in made["infrared families"]
    assert "| combined | 91.0 ± 1.4 / 1.0 ± 0.0 |" in made["infrared families frames"]
    infrared_families.draw(result, tmp_path / "families.png")
    assert (tmp_path / "families.png").stat().st_size < 100_000


def test_networks_are_compared_on_the_same_crops(tmp_path: Path) -> None:
    with use_generators(torch.Generator().manual_seed(0)):
        network = InfraredNetwork(InfraredConfig(encoder="vit-small", channels=4, blocks=1)).eval()
    once, again = (infrared_families.on_crops(network, 24) for _ in range(2))
    assert once == again
    assert 0 <= once["right"] <= 1
    (tmp_path / "metrics.jsonl").write_text('{"step": 10, "validation_missed": 0.5}\n{"step": 11, "loss": 1.0}\n')
    assert infrared_families.curve(tmp_path) == [(120, 0.5)]


def test_what_is_looked_at_lies_within_a_distance() -> None:
    maps = torch.zeros(2, 9, 9)
    maps[0, 4, 4], maps[0, 4, 7] = 1.0, 1.0  # half at the place itself, half three pixels beside it
    maps[1, 0, 0] = 1.0
    half, most = saliency.reaches(maps, torch.tensor([[4.0, 4.0], [3.0, 4.0]]))
    assert half.tolist() == [0.0, 5.0]
    assert most.tolist() == [3.0, 5.0]


def test_only_pixels_that_a_network_sees_count() -> None:
    with use_generators(torch.Generator().manual_seed(0)):
        network = InfraredNetwork(InfraredConfig(encoder="cnn-small", channels=4, blocks=1)).eval()
    batch = saliency.crops_of(network, 4)
    found = saliency.saliency(network, batch, torch.zeros(4, dtype=torch.long))
    assert found.shape == batch.crops.shape
    assert bool((found.flatten(1).amax(1) > 0).all())

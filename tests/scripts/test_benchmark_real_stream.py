"""How bumps of the real stream are made, and how reports of them are judged."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import InputError
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from scripts.benchmarks import real_stream
from scripts.benchmarks.real_stream import judge, summarize
from scripts.benchmarks.wand_recording import Arrangement, Recording, turned


def event(frame, kind="moved", camera="cam02", change="unknown", size=None):
    return {"frame": frame, "event": kind, "camera": camera, "change": change, "size": size, "sigma": 0.01}


def test_what_a_turned_camera_sees_is_what_it_would_see():
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    truth = simulate_truth(factory, obj, 1, torch.Generator().manual_seed(1), PhysicalDrift())
    blobs = true_detections(truth)
    found = turned(blobs, truth.rig, 1, 0.3)
    angle = math.radians(0.3)
    way = torch.tensor([math.cos(2.4), math.sin(2.4), 0.0], dtype=torch.float64) * angle
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[1, :3] = way
    image = truth.rig.retract(step).expand(1).project(truth.rig_from_object.apply(obj.points), obj.radius)
    expected = image.uv[0].numpy()[found.camera, found.fiducial]
    assert np.abs(found.uv - expected).max() < 0.01  # apparent centres of spheres turn almost as points do
    others = blobs.camera != 1
    np.testing.assert_array_equal(found.uv[found.camera != 1], blobs.uv[others])
    assert len(turned(blobs.select(others), truth.rig, 1, 0.3)) == others.sum()


def test_points_that_are_turned_out_of_the_image_are_gone():
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    blobs = true_detections(simulate_truth(factory, obj, 1, torch.Generator().manual_seed(1), PhysicalDrift()))
    assert not (turned(blobs, factory, 1, 80.0).camera == 1).any()


def test_a_bump_is_right_only_in_time_and_where_it_was():
    seeing = range(120, 600)
    judged = judge([event(130), event(150, change="rotation", size=0.3)], "cam02", "rotation", 100, seeing, 1.0)
    assert (judged["in_time"], judged["right_kind"], judged["others_blamed"]) == (True, True, [])
    assert judged["delay_s"] == judged["seen_s"] == pytest.approx(10 / 60)
    late = judge([event(190)], "cam02", "rotation", 100, seeing, 1.0)
    assert (late["in_time"], late["right_kind"]) == (False, False)
    wrong = judge([event(130, camera="cam03"), event(80), event(140, "drift")], "cam02", "rotation", 100, seeing, 1.0)
    assert (wrong["delay_s"], wrong["others_blamed"], wrong["false_before"]) == (None, ["cam03"], 1)
    assert wrong["other_events"] == {"drift": 1}
    quiet = judge([event(50, "camera_lost"), event(130, "camera_back")], "cam02", "rotation", 100, seeing, 1.0)
    assert (quiet["false_before"], quiet["other_events"]) == (0, {})
    rows = [{"stride": 1, "degrees": 0.3, **found} for found in (judged, late, wrong)]
    (row,) = summarize(rows)
    assert (row["bumps"], row["in_time"], row["right"], row["others_blamed"]) == (3, 1, 1, 1)


def test_only_the_time_in_which_the_bumped_camera_sees_the_object_counts():
    seeing = [*range(120, 144, 3), *range(300, 400, 3)]
    found = judge([event(303)], "cam02", "rotation", 100, seeing, 1.0, stride=3)
    assert (found["delay_s"], found["seen_s"], found["in_time"]) == (
        pytest.approx(183 / 60),
        pytest.approx(27 / 60),
        True,
    )
    assert not judge([event(399)], "cam02", "rotation", 100, seeing, 1.0, stride=3)["in_time"]


def test_finished_cases_are_written_if_a_later_one_fails(tmp_path, monkeypatch):
    row = {**judge([event(130)], "cam02", "rotation", 100, range(120, 600), 1.0), "stride": 1, "degrees": 0.3}

    def run(case):
        if case.camera:
            raise RuntimeError("killed")
        return row

    known = SimpleNamespace(calibration=SimpleNamespace(rms=0.1))
    monkeypatch.setattr(real_stream, "calibrated", lambda anew, arrangement: known)
    monkeypatch.setattr(real_stream, "WORK", tmp_path)
    monkeypatch.setattr(real_stream, "run", run)
    out = tmp_path / "real_stream.json"
    monkeypatch.setattr("sys.argv", f"real_stream --strides --bumps 0.3 --cameras 0 1 --out {out}".split())
    with pytest.raises(RuntimeError, match="killed"):
        real_stream.main()
    written = json.loads(out.read_text())
    assert [one["camera"] for one in written["bump_runs"]] == ["cam02"]
    assert written["bumps"][0]["bumps"] == 1


def test_parts_of_the_recording_are_calibrated_and_followed():
    usual = Arrangement()
    assert (usual.calibrated.tolist(), usual.followed) == ([*range(0, 2400, 8)], [*range(2400, 4800)])
    middle = Arrangement("1600:1616", "0:2,3200:3202")
    assert (middle.calibrated.tolist(), middle.followed) == ([1600, 1608], [0, 1, 3200, 3201])
    backwards = Arrangement("0:16", "4800:4797")
    assert backwards.backwards and backwards.followed == [0, 1, 2]
    for wrong in ("", "0", "5:5", "0:4801", "0:2,5:3", "-1:4"):
        with pytest.raises(InputError, match="expected ranges within 0:4800"):
            _ = Arrangement(follow=wrong).followed


def test_a_recording_is_played_backwards():
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    blobs = true_detections(simulate_truth(rig, obj, 3, torch.Generator().manual_seed(1), PhysicalDrift()))
    given = Recording(blobs, np.array([10, 11, 4000]), rig, obj)
    back = given.backwards()
    assert back.frames.tolist() == [799, 4788, 4789]
    for frame, mirrored in ((10, 4789), (11, 4788), (4000, 799)):
        np.testing.assert_array_equal(given.frame(frame).uv, back.frame(mirrored).uv)
        assert given.counts[frame].tolist() == back.counts[mirrored].tolist()


def test_another_arrangement_is_not_written_over_the_usual_result(monkeypatch):
    monkeypatch.setattr("sys.argv", ["real_stream", "--follow", "0:2400"])
    with pytest.raises(InputError, match="out: found nothing"):
        real_stream.main()

"""The benchmark from frames to a rig runs at a minimal size, and OpenCV's results are correct."""

import json
from dataclasses import replace

import numpy as np
import pytest

from imgcal.io import load_object, read_rig
from scripts.benchmarks import end_to_end
from scripts.benchmarks import end_to_end_growth as growth
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peers import opencv_live


def test_smoke(tmp_path):
    result = json.loads(json.dumps(end_to_end.measure(Effort(smoke=True))))
    ours = result["methods"][end_to_end.OURS]
    for name, row in result["methods"].items():
        assert row["refused"] == 0 and 0 < row["re_px"] < 2, name
        assert ours["re_px"] <= row["re_px"]
    assert result["endurance"]["refused"] == 0
    tables = end_to_end.tables(result)
    assert set(tables) == {"end to end", "endurance", *(f"growth {axis}" for axis in growth.AXES)}
    end_to_end.draw(result, tmp_path / "end_to_end.png")
    assert (tmp_path / "end_to_end.png").stat().st_size > 1000


def test_opencv_labels_and_calibrates_a_camera():
    scene = growth.make_scene(read_rig("O10"), load_object("asymmetric8"))
    points, uv, view = scene.obj.points.numpy(), scene.truth.uv[0, 3].numpy(), growth.view_of(scene, 3)
    shuffled = np.random.default_rng(0).permutation(len(uv))
    known = growth.view_of(replace(scene, rig=scene.truth.rig), 3)  # as after the snapshot before
    labels, places = opencv_live.labelled(uv[shuffled], points, known)
    np.testing.assert_array_equal(labels, shuffled)
    found = opencv_live.calibrated(labels, places, points, view, (2048, 1088))
    np.testing.assert_allclose(found.project(points), uv, atol=0.3)
    places[2] += [4.0, -3.0]
    fitting, _ = opencv_live.without_outliers(labels, places, points, found)
    assert set(labels) - set(fitting) == {labels[2]}


def test_images_of_another_size_show_the_same():
    rig, obj = read_rig("O10"), load_object("asymmetric8")
    scene = growth.make_scene(rig, obj)
    half = growth.wide(scene.truth.rig, 1024, 544)
    uv = half.project(scene.truth.rig_from_object[0].apply(obj.points)).uv
    middle = (scene.truth.uv[0].numpy() - [1023.5, 543.5]) / 2 + [511.5, 271.5]
    np.testing.assert_allclose(uv.numpy(), middle, atol=1e-9)


def test_powers_are_slopes():
    rows = [{"n": n, "linear": 3.0 * n, "square": 0.1 * n * n} for n in (1, 2, 4, 8, 16)]
    assert float(growth._power(rows, "linear")) == pytest.approx(1)
    assert float(growth._power(rows, "square")) == pytest.approx(2)

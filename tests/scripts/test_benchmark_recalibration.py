"""The recalibration benchmark runs, and its peers agree with imgcal where they solve the same problem."""

import json

import numpy as np
import pytest
import torch

from imgcal.estimation import relative_difference
from scripts.benchmarks import recalibration
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peer import debian_mrcal
from scripts.benchmarks.recalibration_cases import KINDS, NOISE, bound, make_cases, rigs, score
from scripts.benchmarks.recalibration_methods import CERES, COLMAP, EVERY, FREE, IMGCAL, MRCAL, OPENCV, SCIPY, methods


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def solved(cases, *names):
    """Answers by name, one a case."""
    with methods(cases, names) as found:
        for method in found.values():
            for index in range(len(cases)):
                assert method.solve(index) > 0
    return {name: method.answers() for name, method in found.items()}


def installed(name):
    if name in (CERES, COLMAP):
        pytest.importorskip("pycolmap")
        pytest.importorskip("pyceres")
    if name == MRCAL and not debian_mrcal():
        pytest.skip("mrcal is not installed")


def test_smoke_run(tmp_path):
    result = json.loads(json.dumps(recalibration.measure(Effort(smoke=True))))
    tables = recalibration.tables(result)
    assert set(tables) == {f"recalibration {name}" for name in ("one", "snapshots", "basin", "alone")}
    assert all(name in tables["recalibration one"] for name in EVERY)
    assert all(name in tables["recalibration snapshots"] for name in FREE)
    recalibration.draw(result, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5000
    assert result["alone"]["compiled_minus_tensors_in_standard_deviations"] < 1e-6


@pytest.mark.parametrize("name", [SCIPY, CERES])
@pytest.mark.parametrize("snapshots", [1, 3])
def test_same_cost_has_the_same_minimum(name, snapshots):
    installed(name)
    cases = make_cases(2, snapshots, seed=3)
    found = solved(cases, IMGCAL, name)
    ours, theirs = (rigs(answers, cases.truth) for answers in (found[IMGCAL], found[name]))
    difference = relative_difference(ours, theirs) / cases.prior_std
    assert difference.abs().max() < 0.01


@pytest.mark.parametrize("name", [COLMAP, MRCAL, OPENCV])
def test_peers_without_prior_find_the_true_rig_from_many_snapshots(name):
    installed(name)
    cases = make_cases(1, 12, seed=4)
    judged = score(solved(cases, name)[name], cases)
    assert judged.fit[0] < 1.1 * NOISE
    assert judged.held_out[0] < NOISE / 2
    limit = bound(cases)
    assert all(judged.squares[kind][0] < 9 * limit[kind][0] for kind in KINDS)


def test_absent_peer_is_a_row(monkeypatch):
    monkeypatch.setattr("scripts.benchmarks.recalibration_methods.peer", lambda module: None)
    monkeypatch.setattr("scripts.benchmarks.recalibration_methods.debian_mrcal", lambda: None)
    with methods(make_cases(1, 1, seed=1), EVERY) as found:
        assert not {CERES, COLMAP, MRCAL} & set(found)
    timing = {"p50": 1.0, "p99": 2.0, "best": 1.0, "calls": 3}
    size = {"start": timing, "bound": dict.fromkeys(KINDS, 1.0), "methods": dict.fromkeys(EVERY)}
    size["methods"][IMGCAL] = timing | {"solved": 1, "failures": 1}
    assert (
        f"| {MRCAL} | absent |"
        in recalibration.tables(
            {
                "snapshots": {"1": size},
                "basin": {"scales": [1], "converged": {"1": {MRCAL: None}}},
                "alone": {"times": {}},
            }
        )["recalibration one"]
    )


def test_bound_is_what_imgcal_reaches():
    cases = make_cases(40, 2, seed=5)
    judged, limit = score(solved(cases, IMGCAL)[IMGCAL], cases, fresh=2), bound(cases)
    for kind in KINDS:
        assert 0.8 < np.sqrt(judged.squares[kind].mean() / limit[kind].mean()) < 1.25

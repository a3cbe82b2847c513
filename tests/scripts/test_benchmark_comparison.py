"""Comparison of benchmark cells with committed ones: made-up results of two machines."""

import copy
import json
import math

import pytest

from imgcal.errors import InputError
from scripts.benchmarks import __main__ as suite
from scripts.benchmarks import comparison
from scripts.benchmarks.comparison import cells_of, compare, is_peer, report


def timed(ms):
    return {"p50": ms, "p99": 3 * ms, "best": 0.9 * ms, "calls": 10}


BEFORE = {
    "recalibration": {
        "machine": "made up",
        "seconds": 12,
        "snapshots": {
            "1": {"cases": 5, "methods": {"imgcal": timed(1.0) | {"error": 0.3}, "mrcal": timed(8.0)}},
            "20": {"cases": 5, "methods": {"imgcal": timed(4.0) | {"error": 0.1}, "mrcal": timed(40.0)}},
        },
        "alone": {"times": {"one snapshot, covariance": timed(2.0)}},
    },
    "end_to_end": {
        "growth": {"cameras": [{"n": 2, "identity, cold": 5.0, "OpenCV, labels to cameras": 2.0}]},
        "endurance": {"first": timed(7.0), "rss_mb": [100.0, 101.0]},
    },
    "networks": {"networks": {"points-O10": {"alone": timed(3.0), "megabytes": 3.3}}},
}


def on_a_machine(times, results=None):
    """The same results where everything takes so many times as long; sizes stay."""
    changed = copy.deepcopy(BEFORE if results is None else results)
    for method in (m for s in changed["recalibration"]["snapshots"].values() for m in s["methods"].values()):
        method["p50"] *= times
    changed["recalibration"]["alone"]["times"]["one snapshot, covariance"]["p50"] *= times
    for row in changed["end_to_end"]["growth"]["cameras"]:
        row["identity, cold"] *= times
        row["OpenCV, labels to cameras"] *= times
    changed["end_to_end"]["endurance"]["first"]["p50"] *= times
    changed["networks"]["networks"]["points-O10"]["alone"]["p50"] *= times
    return changed


def grown(changes):
    return {(change.benchmark, change.cell): change.growth for change in changes}


def test_another_machine_changes_no_cell():
    changes = compare(BEFORE, on_a_machine(1.7))
    assert len(changes) == 7
    assert all(change.growth == pytest.approx(1) for change in changes)


def test_a_slower_cell_is_found_on_a_faster_machine_and_named():
    after = on_a_machine(0.5)
    after["recalibration"]["snapshots"]["20"]["methods"]["imgcal"]["p50"] *= 1.3
    worst, second = compare(BEFORE, after)[:2]
    assert (worst.benchmark, worst.cell) == ("recalibration", "snapshots, 20, methods, imgcal")
    assert worst.growth == pytest.approx(1.3) and worst.before == 4.0 and worst.after == pytest.approx(2.6)
    assert second.growth == pytest.approx(1)


def test_each_table_has_its_own_peers():
    after = on_a_machine(1.0)
    for method in after["recalibration"]["snapshots"]["1"]["methods"].values():
        method["p50"] *= 2  # a busy moment hits one table
    found = grown(compare(BEFORE, after))
    assert found["recalibration", "snapshots, 1, methods, imgcal"] == pytest.approx(1)
    assert found["recalibration", "snapshots, 20, methods, imgcal"] == pytest.approx(1)
    # What has no peers beside it has those of its file: of 2 and 1, the geometric mean.
    assert found["recalibration", "alone, times, one snapshot, covariance"] == pytest.approx(1 / math.sqrt(2))
    assert found["networks", "networks, points-O10, alone"] == pytest.approx(1 / 2 ** (1 / 3))


def test_sizes_are_compared_as_they_are_and_what_is_gone_fails():
    after = on_a_machine(3.0)
    after["networks"]["networks"]["points-O10"]["megabytes"] = 6.6
    del after["end_to_end"]["growth"]["cameras"][0]["identity, cold"]
    found = grown(compare(BEFORE, after))
    assert found["networks", "networks, points-O10, megabytes"] == pytest.approx(2)
    assert found["end_to_end", "growth, cameras, 2, identity, cold"] == math.inf


def test_a_peer_that_is_absent_makes_no_ratio():
    after = on_a_machine(2.0)
    del after["recalibration"]["snapshots"]["1"]["methods"]["mrcal"]
    assert grown(compare(BEFORE, after))["recalibration", "snapshots, 1, methods, imgcal"] == pytest.approx(1)


def test_names_of_peers():
    assert (
        is_peer(("rows", "`cv2.projectPoints`"))
        and is_peer(("OpenCV, labels to cameras",))
        and is_peer(("python alone",))
    )
    assert not is_peer(("rows", "imgcal's kornia path")) and not is_peer(("labels to a rig",))


def write(folder, results):
    folder.mkdir()
    for name, result in results.items():
        (folder / f"{name}.json").write_text(json.dumps(result))
    return folder


def test_the_report_counts_what_fails(tmp_path, capsys):
    committed, same = write(tmp_path / "committed", BEFORE), write(tmp_path / "same", on_a_machine(1.1))
    assert report(same, tuple(BEFORE), committed) == 0
    assert "7 cells compared, 0 beyond 1.15" in capsys.readouterr().out
    slow = on_a_machine(1.0)
    slow["recalibration"]["alone"]["times"]["one snapshot, covariance"]["p50"] *= 1.2
    assert report(write(tmp_path / "slow", slow), tuple(BEFORE), committed) == 1
    assert "| recalibration | alone, times, one snapshot, covariance | 2 | 2.4 | **1.20** |" in capsys.readouterr().out
    assert report(tmp_path / "slow", tuple(BEFORE), committed, limit=1.25) == 0


def test_a_result_that_is_not_there_is_named(tmp_path):
    folder = write(tmp_path / "committed", BEFORE)
    with pytest.raises(InputError, match=r"found no splatting\.json"):
        report(folder, ("splatting",), folder)


def test_committed_results_have_a_time_of_ours_in_each_benchmark():
    for name in suite.BENCHMARKS:
        result = comparison.results_in(comparison.COMMITTED, [name])[name]
        assert cells_of(result).ours, name
        assert all(change.growth == pytest.approx(1) for change in compare({name: result}, {name: result}))


def test_the_suite_compares_what_it_has_measured_and_leaves_the_page_alone(tmp_path, monkeypatch, capsys):
    committed, aside = write(tmp_path / "committed", BEFORE), tmp_path / "aside"
    monkeypatch.setattr(comparison, "COMMITTED", committed)
    monkeypatch.setattr(comparison.report, "__defaults__", (committed, 1.15))

    def measure(name, options):
        slow = on_a_machine(1.0)
        slow["networks"]["networks"]["points-O10"]["alone"]["p50"] *= 2
        (options.folder / f"{name}.json").write_text(json.dumps(slow[name]))

    monkeypatch.setattr(suite, "_measure", measure)
    assert suite.main(["networks", "--compare", "--out", str(aside)]) == 1
    assert "networks, points-O10, alone" in capsys.readouterr().out
    assert [path.name for path in aside.iterdir()] == ["networks.json"] and not (tmp_path / "aside.md").exists()

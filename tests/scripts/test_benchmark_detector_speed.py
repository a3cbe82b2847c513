"""The benchmark of the detectors that look at frames: its stages are all there, and make up the whole."""

import json
import os

import pytest
import torch

from scripts.benchmarks import detector_speed
from scripts.benchmarks.detector_speed import COLUMNS, PAGE, RESULT, Options, Stopwatch, measure, of_threads, table
from scripts.output import read_json


@pytest.mark.benchmark
def test_smoke():
    result = json.loads(json.dumps(measure(Options(threads=(1,), levels=("clean",), snapshots=1, rounds=1))))
    said = result["by_threads"]["1"]["clean"]
    assert set(said["matched"]) | set(said["learned"]) == set(COLUMNS)
    for row in said.values():
        parts = sum(stage["cpu_ms"] for name, stage in row.items() if name != "all")
        assert parts == pytest.approx(row["all"]["cpu_ms"], rel=1e-6)
        assert all(stage["cpu_ms"] > 0 for stage in row.values())
    assert table(result).count("\n| matched, clean, 1 |") == 1


def test_what_is_timed_still_exists():
    for places in detector_speed.STAGES.values():
        assert all(attribute in vars(owner) for owner, attribute in places)


def test_stages_add_up():
    watch = Stopwatch()
    for _ in range(2):
        assert watch.timed("sum", sum)([1, 2]) == 3
    assert set(watch.taken) == {"sum"} and watch.taken["sum"][1] > 0


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system has no affinity")
def test_cores_and_threads_are_given_back():
    before = os.sched_getaffinity(0), torch.get_num_threads()
    with of_threads(1):
        assert len(os.sched_getaffinity(0)) == 1 and torch.get_num_threads() == 1
    assert (os.sched_getaffinity(0), torch.get_num_threads()) == before


def test_the_committed_result_is_on_its_page():
    assert table(read_json(RESULT)) in PAGE.read_text("utf-8")

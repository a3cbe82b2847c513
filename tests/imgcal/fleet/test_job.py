import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import imgcal
from imgcal.fleet import Item, Settings
from imgcal.fleet import job as jobs
from imgcal.fleet.job import content_key, process, result_columns
from imgcal.formats.conversion import from_camera_rig
from imgcal.formats.writing import convert_rig
from imgcal.io import data_path
from imgcal.synthesis import simulate_truth, true_detections
from tests.imgcal.fleet.small_captures import write_capture


def item(path: Path | str, **changes: Any) -> Item:
    return Item(0, str(path), **({"rig": "T4", "object": "asymmetric8", "device": "d", "time": None} | changes))


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    write_capture(tmp_path / "a.csv", 0)
    return tmp_path / "a.csv"


def test_a_capture_becomes_a_row(capture: Path) -> None:
    row = process(item(capture), Settings(keep_rig=True))
    assert row is not None and row["status"] == "ok" and row["snapshots"] == 2
    assert row["cpu_seconds"] > 0
    assert len(row["offset"]) == 60 and len(row["information_factor"]) == 60 * 61 // 2
    assert row["rms_px"] < 0.2 and row["rig_file"].startswith("format: imgcal-rig/1")
    assert process(item(capture), Settings(), frozenset({row["key"]})) is None


def test_the_key_says_what_a_result_depends_on(capture: Path, tmp_path: Path) -> None:
    def key(**changes: Any) -> str:
        return content_key(capture, item(capture, **changes), Settings())

    before = key()
    assert before == key() and before != key(device="e") and before != key(rig="U7")
    assert before != content_key(capture, item(capture), Settings(blind_cameras=True))
    assert before == content_key(capture, item(capture), Settings(seconds=1.0))
    capture.write_text(capture.read_text() + "\n")
    assert key() != before


def test_the_key_covers_every_file_of_a_rig(capture: Path, tmp_path: Path) -> None:
    """EasyMocap keeps a rig in two files: naming one is enough to read both."""
    (tmp_path / "em").mkdir()
    for name, content in convert_rig(from_camera_rig(imgcal.load_rig("T4")), "easymocap", "T4").files.items():
        (tmp_path / "em" / name).write_bytes(content)
    named = item(capture, rig=str(tmp_path / "em" / "intri.yml"))
    before = content_key(capture, named, Settings())
    (tmp_path / "em" / "extri.yml").write_text((tmp_path / "em" / "extri.yml").read_text() + "\n")
    assert content_key(capture, named, Settings()) != before
    assert process(item(capture, rig=str(tmp_path / "em")), Settings())["status"] != "fault"


def test_shipped_samples_go_by_their_names() -> None:
    row = process(item(data_path("samples", "O10"), rig="sample:O10", object="sample:O10"), Settings())
    assert row is not None and row["status"] == "ok", row


@pytest.mark.parametrize(
    ("changes", "status", "reason"),
    [
        ({"rig": "O10"}, "unusable", "cam"),
        ({"rig": "missing.yaml"}, "unusable", "missing.yaml"),
        ({"fault": "row 3: found no rig"}, "unusable", "row 3"),
        ({"capture": "nowhere.csv"}, "unusable", "nowhere.csv"),
        ({"capture": "nosuch://bucket/a.csv"}, "unreachable", "nosuch"),
    ],
)
def test_what_is_wrong_is_said_in_the_row(capture: Path, changes: dict[str, Any], status: str, reason: str) -> None:
    path = changes.pop("capture", capture)
    row = process(item(path, **changes), Settings())
    assert row is not None
    if changes.get("rig") == "O10":  # six cameras of it see nothing: sound, but it cannot decide
        assert row["status"] in ("unusable", "refused")
    else:
        assert row["status"] == status
    assert reason in row["reason"]


@pytest.mark.parametrize(
    ("behaviour", "status"),
    [
        (lambda *_: time.sleep(60), "timed_out"),
        (lambda *_: bytearray(1 << 40), "out_of_memory"),
        (lambda *_: [][0], "fault"),
    ],
)
def test_captures_that_hang_or_grow(
    capture: Path, behaviour: Any, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "_recalibrate", behaviour)
    row = process(item(capture), Settings(seconds=0.5, memory_mb=500))
    assert row is not None and row["status"] == status
    assert row["seconds"] < 10 and row["key"]


def test_devices_and_pipes_are_not_waited_for(capture: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    started = time.perf_counter()
    for place in ("/dev/zero", str(tmp_path / "pipe")):
        for changes in ({"capture": place}, {"rig": place}, {"object": place}):
            row = process(replace(item(capture), **changes), Settings(seconds=5.0))
            assert row is not None and row["status"] == "unusable"
            assert row["reason"].startswith(f"{place}: found a device or pipe, expected")
    assert time.perf_counter() - started < 5.0


def test_the_limit_holds_where_every_exception_is_caught(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stubborn(*_: object, **__: object) -> None:
        while True:
            try:
                time.sleep(60)
            except Exception:
                continue

    monkeypatch.setattr(jobs, "calibrate", stubborn)
    row = process(item(capture), Settings(seconds=0.5))
    assert row is not None and row["status"] == "timed_out" and row["seconds"] < 30


def test_a_system_that_can_limit_nothing_still_calibrates(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows has neither module nor timer."""
    monkeypatch.setattr(jobs, "resource", None)
    monkeypatch.delattr(signal, "setitimer")
    monkeypatch.delattr(signal, "SIGALRM")
    row = process(item(capture), Settings(seconds=0.0))
    assert row is not None and row["status"] == "ok"


def test_where_snapshots_scatter_the_standard_deviations_say_so() -> None:
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), None)
    plain = imgcal.calibrate(true_detections(truth), factory, obj)
    factors = torch.full((4,), 2.0, dtype=torch.float64)
    scattered = replace(plain, estimate=replace(plain.estimate, inflation=factors))
    before, after = (np.array(result_columns(result)["std"]) for result in (plain, scattered))
    assert (after >= before * (1 - 1e-9)).all() and after[6] > 1.9 * before[6]  # a focal length

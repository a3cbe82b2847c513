import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, cast

import pytest

import imgcal
from imgcal.fleet import (
    Dataset,
    Done,
    Engine,
    Lost,
    Manifest,
    Settings,
    recalibrate_fleet,
    refusals,
    rig_kinds,
    write_manifest,
)
from imgcal.fleet.job import current_key
from tests.imgcal.fleet.small_captures import write_capture


def manifest(folder: Path) -> Manifest:
    return Manifest(str(folder / "manifest.csv"), "T4", "asymmetric8")


def test_what_is_missing_or_changed_is_done_once(fleet: Path, engine: Engine) -> None:
    dataset = Dataset(fleet / "out")
    first = recalibrate_fleet(manifest(fleet), dataset, engine, batch=2)
    assert (first.read, first.known, dict(first.status)) == (6, 0, {"ok": 6})
    again = recalibrate_fleet(manifest(fleet), dataset, engine, batch=2)
    assert (again.read, again.known, dict(again.status)) == (6, 6, {})
    write_capture(fleet / "3.csv", 33)
    changed = recalibrate_fleet(manifest(fleet), dataset, engine, batch=2)
    assert (changed.known, dict(changed.status)) == (5, {"ok": 1})
    assert dataset.latest(("device",)).num_rows == 6
    (kind,) = rig_kinds(dataset)
    assert sorted(kind.devices) == [f"d{n}" for n in range(6)] and list(kind.given) == ["temperature"]
    with pytest.raises(imgcal.RefusedError, match="at least 8"):
        kind.learn()


def test_rows_are_those_of_calibrate(fleet: Path, engine: Engine) -> None:
    dataset = Dataset(fleet / "out")
    recalibrate_fleet(manifest(fleet), dataset, engine)
    rows = {row["device"]: row for row in dataset.latest().to_pylist()}
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    result = imgcal.calibrate(imgcal.load_detections(fleet / "2.csv", rig), rig, obj)
    # Processes that compile at the same time inline differently, and so round differently.
    offset = result.rig.local(rig).flatten().tolist()
    assert rows["d2"]["offset"] == pytest.approx(offset, rel=1e-5, abs=1e-8)
    assert rows["d2"]["rms_px"] == pytest.approx(float(result.rms), rel=1e-6)


def test_one_bad_capture_is_a_row_and_the_same_twice_is_one(fleet: Path, engine: Engine) -> None:
    (fleet / "bad.csv").write_text("snapshot,camera,u,v\n0,cam01,one,2\n")
    rows = [{"capture": name} for name in ("0.csv", "bad.csv", "0.csv", "gone.csv")]
    write_manifest(fleet / "manifest.csv", rows)
    dataset = Dataset(fleet / "out")
    count = recalibrate_fleet(manifest(fleet), dataset, engine, batch=1)
    assert (count.read, count.known, dict(count.status)) == (4, 1, {"ok": 1, "unusable": 2})
    assert sum(number for status, _, number in refusals(dataset) if status == "unusable") == 2


def test_captures_in_a_bucket(fleet: Path, engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    moto = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    server = moto.ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    try:
        url = f"http://127.0.0.1:{server._server.server_port}"
        for name, value in (("AWS_ACCESS_KEY_ID", "a"), ("AWS_SECRET_ACCESS_KEY", "b"), ("AWS_ENDPOINT_URL", url)):
            monkeypatch.setenv(name, value)
        system = s3fs.S3FileSystem()
        system.mkdir("captures")
        for name in ("0.csv", "manifest.csv"):
            system.put(str(fleet / name), f"captures/{name}")
        rows = Manifest("s3://captures/manifest.csv", "T4", "asymmetric8").batches(6)
        from imgcal.fleet import Settings
        from imgcal.fleet.job import process

        items = next(iter(rows))
        there, not_there = process(items[0], Settings()), process(items[1], Settings())
        assert there is not None and there["status"] == "ok" and there["capture"] == "s3://captures/0.csv"
        assert not_there is not None and not_there["status"] == "unreachable"
    finally:
        server.stop()


def test_what_comes_back_counts_again(fleet: Path, engine: Engine) -> None:
    """The latest result of a capture is that of its present content, also where that was seen before."""
    dataset, content = Dataset(fleet / "out"), (fleet / "1.csv").read_text()
    recalibrate_fleet(manifest(fleet), dataset, engine)
    (fleet / "1.csv").rename(fleet / "away")
    recalibrate_fleet(manifest(fleet), dataset, engine)
    (fleet / "away").rename(fleet / "1.csv")
    back = recalibrate_fleet(manifest(fleet), dataset, engine)
    assert (back.known, dict(back.status)) == (5, {"ok": 1})
    write_capture(fleet / "1.csv", 11)
    recalibrate_fleet(manifest(fleet), dataset, engine)
    (fleet / "1.csv").write_text(content)
    assert dict(recalibrate_fleet(manifest(fleet), dataset, engine).status) == {"ok": 1}
    assert recalibrate_fleet(manifest(fleet), dataset, engine).known == 6
    assert len(rig_kinds(dataset)[0].devices) == 6


def test_a_corrected_number_is_learned_from(fleet: Path, engine: Engine) -> None:
    dataset = Dataset(fleet / "out")
    recalibrate_fleet(manifest(fleet), dataset, engine)
    table = (fleet / "manifest.csv").read_text()
    (fleet / "manifest.csv").write_text(table.replace("23", "43"))
    assert "43" in (fleet / "manifest.csv").read_text()
    recalibrate_fleet(manifest(fleet), dataset, engine)
    (kind,) = rig_kinds(dataset)
    assert sorted(kind.given["temperature"]) == [20.0, 21.0, 22.0, 24.0, 25.0, 43.0]


def test_rig_files_are_made_when_they_are_asked_for_and_go_with_their_capture(fleet: Path, engine: Engine) -> None:
    dataset, rigs = Dataset(fleet / "out"), fleet / "rigs"
    recalibrate_fleet(manifest(fleet), dataset, engine)
    keep = Settings(keep_rig=True)
    assert dict(recalibrate_fleet(manifest(fleet), dataset, engine, keep).status) == {"ok": 6}
    assert recalibrate_fleet(manifest(fleet), dataset, engine, keep).known == 6
    assert recalibrate_fleet(manifest(fleet), dataset, engine).known == 6
    dataset.write_rigs(rigs)
    assert len(list(rigs.iterdir())) == 6
    (fleet / "2.csv").write_text("snapshot,camera,u,v\n0,cam01,1,2\n")
    recalibrate_fleet(manifest(fleet), dataset, engine, keep)
    dataset.write_rigs(rigs)
    assert len(list(rigs.iterdir())) == 5


def test_what_crashes_its_process_is_tried_once_more_only_if_asked(fleet: Path) -> None:
    class Crashing:
        def run(self, function: Any, batches: Any, *arguments: Any, seconds: float) -> Any:
            yield from (
                Lost(item, timed_out=False, reason="signal: 9")
                if item.row == 0
                else Done([item], function([item], *arguments))
                for batch in batches
                for item in batch
            )

    dataset, engine = Dataset(fleet / "out"), cast(Engine, Crashing())
    first = recalibrate_fleet(manifest(fleet), dataset, engine)
    assert dict(first.status) == {"ok": 5, "crashed": 1}
    known = dataset.keys()
    assert current_key(next(manifest(fleet).batches(1))[0], Settings()) in known
    assert len(known) == 6 and len(dataset.keys(again=True)) == 5


KILLED = """
import sys
from pathlib import Path
from imgcal.fleet import Dataset, Engine, Manifest, recalibrate_fleet
folder = Path(sys.argv[1])
def tell(count):
    print(count.read, flush=True)
if __name__ == "__main__":
    import imgcal.fleet.run as run
    run.SECONDS = 0.0  # every batch is written at once
    with Engine(cores=1) as engine:
        recalibrate_fleet(Manifest(str(folder / "manifest.csv"), "T4", "asymmetric8"), Dataset(folder / "out"), engine, tell=tell, batch=1)
"""  # noqa: E501


def test_a_driver_that_is_killed_goes_on_where_it_was(fleet: Path, engine: Engine) -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED, str(fleet)], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        timer = threading.Timer(120, child.kill)
        timer.start()
        for line in child.stdout:
            if line.strip() == "2":
                break
        child.kill()
        timer.cancel()
    dataset = Dataset(fleet / "out")
    done = len(dataset.keys())
    assert done >= 1
    count = recalibrate_fleet(manifest(fleet), dataset, engine, batch=1)
    assert (count.known, count.status["ok"]) == (done, 6 - done)
    assert dataset.latest(("device",)).num_rows == 6

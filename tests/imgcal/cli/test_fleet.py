import json
from pathlib import Path

import pytest
import yaml

from imgcal import load_rig
from imgcal.cli.main import main
from imgcal.fleet import Dataset, Engine, write_manifest
from tests.imgcal.fleet.conftest import engine  # noqa: F401  one Ray for the file
from tests.imgcal.fleet.small_captures import write_capture


@pytest.mark.usefixtures("engine")
def test_a_fleet_teaches_its_prior(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = []
    for number in range(10):
        write_capture(tmp_path / f"{number}.csv", number)
        rows.append(
            {"capture": f"{number}.csv", "device": f"<d{number}>", "time": f"2026-01-{number + 1:02d}T00:00:00"}
        )
    rows.append({"capture": "gone.csv", "device": "lost", "time": None})
    write_manifest(tmp_path / "captures.csv", rows)
    out = tmp_path / "fleet"
    options = ["--rig", "T4", "--object", "asymmetric8", "--out", str(out)]
    assert main(["fleet", str(tmp_path / "captures.csv"), *options, "--keep-rigs"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("11 captures, 10 ok, 1 unusable")
    prior = yaml.safe_load((out / "prior.yaml").read_text())["prior"]
    assert 0.002 < prior["rotation"] < 0.006 and 0.8 < prior["position"] < 2.5
    lessons = json.loads((out / "lessons.json").read_text())
    assert lessons["devices"] == 10 and len(lessons["spreads"]) == 5
    assert len(list((out / "rigs").glob("*.yaml"))) == 10
    page = (out / "report.html").read_text()
    assert "10 of 11 captures recalibrated" in page and "gone.csv" in page and "<d1>" not in page
    factory = (Path("data/rigs/T4.yaml").resolve()).read_text()
    (tmp_path / "rig.yaml").write_text(factory.partition("prior:")[0] + (out / "prior.yaml").read_text())
    capture = ["calibrate", str(tmp_path / "3.csv"), "--rig", str(tmp_path / "rig.yaml"), "--object", "asymmetric8"]
    assert main([*capture, "--out", str(tmp_path / "one"), "--no-report"]) == 0


@pytest.mark.usefixtures("engine")
def test_each_kind_of_rig_teaches_what_it_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = []
    for number in range(8):
        write_capture(tmp_path / f"{number}.csv", number)
        rows.append(f"{number}.csv,T4,d{number},{20 + number},{100 * number if number else ''}")
    write_capture(tmp_path / "other.csv", 9, load_rig("U7"))
    table = tmp_path / "captures.csv"
    table.write_text("\n".join(["capture,rig,device,temperature,hours", *rows, "other.csv,U7,u,,", ""]))
    command = ["fleet", str(table), "--object", "asymmetric8", "--out", str(tmp_path / "fleet")]
    assert main([*command, "--covariates", "pressure"]) == 2
    assert "found pressure, expected numbers that every row has: temperature" in capsys.readouterr().err
    assert main([*command, "--covariates", "temperature"]) == 0
    said = capsys.readouterr()
    assert "note: hours: found none for d0, but one for 7 other devices; no rates were learned" in said.err
    assert "no prior: --covariates: found temperature, expected numbers that every row has: there are none" in said.err
    assert list(yaml.safe_load((tmp_path / "fleet" / "prior.yaml").read_text())) == ["prior"]
    table.write_text(table.read_text().replace("d0,20,", "d0,20,50"))
    assert main(command) == 0
    said = capsys.readouterr()
    assert "8 done before" in said.out and "in an hour; " in said.out and "after 356.2 h, the mean age" in said.out
    assert list(yaml.safe_load((tmp_path / "fleet" / "prior.yaml").read_text())) == ["prior", "drift_rate"]
    assert json.loads((tmp_path / "fleet" / "lessons.json").read_text())["hours"] == 356.25
    assert "growth in an hour" in (tmp_path / "fleet" / "report.html").read_text()


def test_hurried_input(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """What is wrong is said before processes are started, which takes seconds."""

    def start(self: Engine) -> Engine:
        raise AssertionError("started")

    monkeypatch.setattr(Engine, "__enter__", start)
    (tmp_path / "m.csv").write_text("frames\na\n")
    (tmp_path / "zero.csv").write_text("")
    (tmp_path / "header.csv").write_text("capture,rig\n")
    (tmp_path / "good.csv").write_text("capture\na.csv\n")
    (tmp_path / "file").write_text("")
    out = ["--out", str(tmp_path / "o")]
    for arguments, expected in (
        ([str(tmp_path / "m.csv"), *out], "found columns frames; expected capture among them"),
        ([str(tmp_path / "zero.csv"), *out], "zero.csv: found an empty file, expected a CSV table"),
        ([str(tmp_path / "header.csv"), *out], "header.csv: found no rows, expected captures"),
        ([str(tmp_path / "good.csv"), "--out", str(tmp_path / "file" / "o")], "expected a folder to write to"),
        ([str(tmp_path / "good.csv"), *out, "--cores", "0"], "--cores: found 0, expected at least 1"),
        ([str(tmp_path / "m.csv"), *out, "--rig", "nothing"], "nothing"),
        ([str(tmp_path / "m.csv"), *out, "--seconds", "0"], "--seconds: found 0"),
        ([str(tmp_path / "none.csv"), *out], "none.csv: cannot be read"),
    ):
        assert main(["fleet", *arguments]) == 2
        said = capsys.readouterr().err
        assert expected in said and said.count("\n") == 1
    assert not (tmp_path / "o").exists()
    with Dataset(tmp_path / "o").open_writer():
        assert main(["fleet", str(tmp_path / "good.csv"), *out]) == 2
    assert "another run is writing to it" in capsys.readouterr().err

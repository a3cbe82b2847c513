import json
from pathlib import Path

import pytest
import torch
import yaml

from imgcal.cli.main import main
from imgcal.io import RigCovariance, load_rig_covariance, read_rig, save_rig
from imgcal.types import CameraRig
from tests.imgcal.cli.conftest import Workplace
from tests.imgcal.io.test_posterior_file import posterior_for


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["convert", *map(str, arguments)])
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.fixture
def camchain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    assert run(capsys, "T4", "--to", "kalibr", "--out", tmp_path / "camchain.yaml", "--fit-limit", "5")[0] == 0
    return tmp_path / "camchain.yaml"


def test_a_kalibr_file_becomes_ours(camchain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, camchain, "--out", tmp_path / "rig.yaml")
    assert code == 0
    assert "Kalibr camchain: 4 cameras; frame: camera cam0" in out
    assert "(imgcal rig file); re-read: worst difference" in out and "px on 588 points, lens models the same" in out
    assert read_rig(tmp_path / "rig.yaml").camera_names == ("cam0", "cam1", "cam2", "cam3")


@pytest.mark.parametrize(
    ("name", "more", "said"),
    [
        ("camchain.yaml", (), True),
        ("my-kalibr.yaml", (), True),
        ("rig.yaml", (), False),
        ("camchain.yaml", ("--to", "imgcal"), False),
    ],
)
def test_a_name_that_suggests_another_format_gets_a_note(
    name: str, more: tuple[str, ...], said: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(capsys, "T4", "--out", tmp_path / name, *more)
    note = "note: --out ends in .yaml, so an imgcal rig file is written; --to kalibr writes a Kalibr camchain"
    assert code == 0 and (note in out) == said and "(imgcal rig file)" in out
    assert read_rig(tmp_path / name).num_cameras == 4


def test_commands_take_it_as_a_rig(workplace: Workplace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    toml = tmp_path / "calib.toml"
    assert run(capsys, workplace.rig, "--to", "pose2sim", "--out", toml)[0] == 0
    scores = []
    for rig in (workplace.rig, toml):
        truth = workplace.capture / "truth" / "detections.csv"
        assert main(["score", str(truth), "--rig", str(rig), "--object", str(workplace.object)]) == 0
        scores.append(json.loads(capsys.readouterr().out))
    assert scores[0]["per_camera"].keys() == scores[1]["per_camera"].keys()
    assert scores[1]["rms_px"] == pytest.approx(scores[0]["rms_px"], rel=1e-3)


def test_a_file_of_one_camera_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "T4", "--to", "ros", "--out", tmp_path / "ros", "--cameras", "cam01", "cam02")[0] == 0
    code = main(["score", str(tmp_path), "--rig", str(tmp_path / "ros" / "cam01.yaml"), "--object", "asymmetric8"])
    said = capsys.readouterr().err
    assert code == 2
    assert "this is a ROS camera_info file of one camera, without its pose in the rig" in said
    assert run(capsys, tmp_path / "ros" / "cam01.yaml", "--out", tmp_path / "one.yaml")[0] == 0
    assert read_rig(tmp_path / "one.yaml").num_cameras == 1


def test_a_rig_file_of_ours_has_one_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, error = run(capsys, "O10", "--out-unit", "m", "--out", tmp_path / "rig.yaml")
    assert (code, error) == (2, "imgcal: --out-unit m: an imgcal rig file is always in mm\n")
    assert not (tmp_path / "rig.yaml").exists()
    assert run(capsys, "O10", "--out-unit", "mm", "--out", tmp_path / "rig.yaml")[0] == 0


def test_nothing_is_guessed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "model"
    assert run(capsys, "T4", "--to", "colmap", "--out", folder)[0] == 0
    code, _, error = run(capsys, folder, "--out", tmp_path / "rig.yaml")
    assert code == 2
    assert "the file does not state its unit of length" in error
    assert not (tmp_path / "rig.yaml").exists()
    assert run(capsys, folder, "--out", tmp_path / "rig.yaml", "--unit", "0.5m")[0] == 0
    half = read_rig(tmp_path / "rig.yaml").positions
    distance = ["--distance", "cam01", "cam02", "100"]
    assert run(capsys, folder, "--out", tmp_path / "rig.yaml", *distance)[0] == 0
    positions = read_rig(tmp_path / "rig.yaml").positions
    assert float((positions[1] - positions[0]).norm()) == pytest.approx(100)
    assert not half.allclose(positions)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "x.toml"], "--to: cannot tell the format from x.toml"),
        (["--out", "x.yaml", "--to", "calibr"], "found the format 'calibr'"),
        (["--out", "x.yaml", "--to", "motive"], "can only be read"),
        (["--out", "x.yaml", "--unit", "m"], "in mm, expected neither"),
        (["--out", "x.yaml", "--image-size", "12"], "--image-size: found '12'"),
        (["--out", "x.yaml", "--image-size", "cam01=1x1"], "--image-size says 1x1"),
        (["--out", "x.yaml", "--fit-limit", "nan"], "--fit-limit"),
        (["--out", "x.yaml", "--cameras", "cam77"], "--cameras: found cam77"),
        (["--out", "x.yaml", "--to", "ros"], "choose with --cameras"),
        (["--out", "no/such/folder.yaml"], "cannot be written"),
    ],
)
def test_what_is_refused(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, error = run(capsys, "T4", *arguments)
    assert (code, error.count("\n")) == (2, 1)
    assert said in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("more", [(), ("--to", "kalibr"), ("--into", "original.xcp")])
def test_a_missing_source_is_asked_for(
    more: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, error = run(capsys, "--out", tmp_path / "x.yaml", *more)
    assert (code, error.count("\n")) == (2, 1)
    assert "SOURCE: found none, expected a calibration to convert: imgcal convert SOURCE --out x.yaml" in error


def test_the_source_survives(camchain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = camchain.read_bytes()
    code, _, error = run(capsys, camchain, "--to", "kalibr", "--out", camchain)
    assert code == 2
    assert "would overwrite SOURCE" in error
    assert camchain.read_bytes() == before
    code, _, error = run(capsys, camchain, "--to", "mrcal", "--out", camchain)
    assert code == 2
    assert "expected a folder" in error


def test_uncertainty_goes_from_ours_to_ours(o10: CameraRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_rig(o10, tmp_path / "a.yaml", RigCovariance(torch.full((10, 15), 0.5, dtype=torch.float64)))
    assert run(capsys, tmp_path / "a.yaml", "--out", tmp_path / "b.yaml")[0] == 0
    assert load_rig_covariance(tmp_path / "b.yaml") is not None
    code, out, _ = run(capsys, tmp_path / "a.yaml", "--out", tmp_path / "c", "--to", "mrcal")
    assert code == 0
    assert "standard deviations are left out" in out
    assert len(list((tmp_path / "c").iterdir())) == 10


def test_the_posterior_goes_along_unless_the_rig_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = read_rig("T4")
    save_rig(rig, tmp_path / "a.yaml", posterior=posterior_for(rig))
    assert run(capsys, tmp_path / "a.yaml", "--out", tmp_path / "b.yaml")[0] == 0
    kept = read_rig(tmp_path / "b.yaml")
    assert kept.posterior is not None and kept.posterior().belongs_to(rig)
    assert run(capsys, tmp_path / "a.yaml", "--out", tmp_path / "two.yaml", "--cameras", "cam02", "cam01")[0] == 0
    chosen = read_rig(tmp_path / "two.yaml")
    assert chosen.posterior is not None and chosen.posterior().belongs_to(rig.select([1, 0]))
    code, out, _ = run(capsys, tmp_path / "a.yaml", "--out", tmp_path / "c.yaml", "--hold-distortion")
    assert code == 0 and "note: the posterior of the calibration is left out" in out
    assert read_rig(tmp_path / "c.yaml").posterior is None


def test_one_s_file_to_another_s(camchain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "calib.toml"
    assert run(capsys, camchain, "--to", "pose2sim", "--out", out)[0] == 0
    assert run(capsys, out, "--to", "kalibr", "--out", tmp_path / "again.yaml")[0] == 0
    one, two = (yaml.safe_load(path.read_text()) for path in (camchain, tmp_path / "again.yaml"))
    assert one["cam3"]["intrinsics"] == two["cam3"]["intrinsics"]
    for row, same in zip(one["cam3"]["T_cn_cnm1"], two["cam3"]["T_cn_cnm1"], strict=True):
        assert row == pytest.approx(same, abs=1e-9)


def test_sizes_may_be_stated_of_cameras_that_are_not_kept(
    camchain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sizes = [f"cam{number}=2048x1088" for number in range(4)]
    out = ["--out", tmp_path / "rig.yaml", "--cameras", "cam2", "cam0"]
    assert run(capsys, camchain, *out, "--image-size", *sizes)[0] == 0
    assert read_rig(tmp_path / "rig.yaml").camera_names == ("cam2", "cam0")
    code, _, err = run(capsys, camchain, *out, "--image-size", "cam7=2048x1088")
    assert code == 2 and "found camera cam7, expected" in err

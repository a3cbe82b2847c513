from dataclasses import replace
from pathlib import Path

import pytest
import torch

from imgcal import calibrate
from imgcal.cli.main import main
from imgcal.io import load_object, read_rig, save_rig
from imgcal.synthesis import PhysicalDrift, simulate_volume, true_detections
from tests.imgcal.formats import originals
from tests.imgcal.formats.rigs import brown, rig_of


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["convert", *map(str, arguments)])
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.fixture
def recalibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[Path, Path]:
    """A Qualisys calibration, and the rig that it became."""
    original, rig = tmp_path / "original.qca.txt", tmp_path / "rig.yaml"
    lens = brown(-0.05, 0.02, 1e-4, -2e-4, 0.003)
    original.write_bytes(originals.qualisys(rig_of(lens, lens, lens)))
    assert run(capsys, original, "--out", rig)[0] == 0
    factory = read_rig(rig)
    save_rig(factory.retract(torch.full((3, 15), 1e-3, dtype=torch.float64)), rig)
    return rig, original


def test_the_success_line(recalibrated: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, original = recalibrated
    before = original.read_bytes()
    code, out, err = run(capsys, rig, "--into", original, "--out", tmp_path / "new.qca.txt")
    assert (code, err) == (0, "")
    assert "Qualisys calibration: 3 cameras replaced" in out
    assert "; re-read: worst difference " in out.splitlines()[-1] and out.splitlines()[-1].startswith("wrote ")
    assert original.read_bytes() == before
    assert (tmp_path / "new.qca.txt").read_bytes() != before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--into", "original.qca.txt", "--out", "original.qca.txt"], "would overwrite --into, expected another path"),
        (["--into", "rig.yaml", "--out", "new.xml"], "expected"),
        (["--into", "missing.xcp", "--out", "new.xcp"], "missing.xcp: no such file"),
        (["--into", "original.qca.txt", "--to", "imgcal", "--out", "new.xcp"], "--to: found imgcal"),
        (["--into", "original.qca.txt", "--to", "vicon", "--out", "new.xcp"], "this is not a Vicon calibration"),
        (["--into", "original.qca.txt", "--fit-limit", "0", "--out", "new.xcp"], "--fit-limit"),
        (["--into", "original.qca.txt", "--out-unit", "parsec", "--out", "new.xcp"], "--out-unit: found 'parsec'"),
    ],
)
def test_what_is_refused(
    recalibrated: tuple[Path, Path],
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    code, _, error = run(capsys, "rig.yaml", *arguments)
    assert (code, error.count("\n")) == (2, 1), error
    assert said in error
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_calibration_that_holds_the_distortion_goes_back_where_another_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    original, held, free = tmp_path / "original.xcp", tmp_path / "held.yaml", tmp_path / "free.yaml"
    lens = brown(-0.05, 0.02)
    original.write_bytes(originals.vicon(rig_of(lens, lens, lens, lens, names=("1", "2", "3", "4"))))
    assert run(capsys, original, "--hold-distortion", "--out", held)[0] == 0
    assert run(capsys, original, "--out", free)[0] == 0
    outcomes = []
    for path in (held, free):
        factory = read_rig(path)
        generator = torch.Generator().manual_seed(0)
        truth = simulate_volume(
            factory, load_object("asymmetric8"), 12, generator, PhysicalDrift(0.1, 1.0, 1e-3, 0.5, 0)
        )
        seen = true_detections(truth)
        noise = 0.2 * torch.randn(seen.uv.shape, generator=generator, dtype=torch.float64).numpy()
        found = calibrate(replace(seen, uv=seen.uv + noise), factory, load_object("asymmetric8")).rig
        save_rig(found, path)
        outcomes.append(run(capsys, path, "--into", original, "--out", tmp_path / f"{path.stem}.xcp"))
    assert (outcomes[0][0], outcomes[1][0]) == (0, 3)
    assert "or convert the file with --hold-distortion and calibrate again" in outcomes[1][2]
    for more in (["--into", original, "--out", tmp_path / "x.xcp"], ["--to", "kalibr", "--out", tmp_path / "x.yaml"]):
        code, _, err = run(capsys, held, "--hold-distortion", *more)
        assert code == 2 and "--hold-distortion: needs an imgcal rig file as output" in err


def test_into_without_a_file_or_into_a_rig_file_of_ours_is_told(tmp_path, capsys):
    rig = tmp_path / "rig.yaml"
    save_rig(read_rig("T4"), rig)
    assert main(["convert", str(rig), "--into", "--out", str(tmp_path / "new")]) == 2
    assert "--into: found no value, expected one or more" in capsys.readouterr().err
    assert main(["convert", str(rig), "--into", str(rig), "--out", str(tmp_path / "new.yaml")]) == 2
    said = f"imgcal: {rig}: found a rig file of imgcal, expected the calibration of another tool\n"
    assert capsys.readouterr().err == said and not (tmp_path / "new.yaml").exists()

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.cli.main import main
from imgcal.errors import InputError
from imgcal.estimation import relative_difference
from imgcal.geometry import vector_from_rotation
from imgcal.io import (
    load_detections,
    load_object,
    load_rig_covariance,
    read_frame,
    read_rig,
    save_detections,
    write_frame,
)
from imgcal.synthesis import PhysicalDrift, RelativeDrift, simulate_truth, true_detections
from imgcal.types import Detections
from tests.imgcal.cli.calibrating import calibrate, one_line

KEYS = {
    "version", "status", "reason", "identity", "rms_px_before", "rms_px_after", "chi2_per_dof", "snapshots_used",
    "snapshots_rejected", "per_camera", "predicted_error", "motion", "knowledge", "seconds",
}  # fmt: skip


def test_frames_to_recalibrated_rig(workplace, tmp_path, capsys):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out) == 0
    result = json.loads((out / "result.json").read_text())
    assert set(result) >= KEYS
    assert result["status"] == "ok"
    assert result["identity"] == "unique"
    assert result["snapshots_used"] == 3
    assert result["rms_px_after"] < 0.05 < result["rms_px_before"]
    assert (out / "report.html").stat().st_size > 100_000
    printed = capsys.readouterr().out
    predicted = result["predicted_error"]
    assert 0 < predicted["median_px"] < predicted["p95_px"] and 0 < predicted["median_mm"] < predicted["p95_mm"]
    assert f"in the working volume {predicted['median_mm']:.2g} mm (95 %: {predicted['p95_mm']:.2g})" in printed
    moved = result["motion"]["cameras_moved"]
    assert result["motion"]["relative_to"] == "most cameras" and f"{len(moved)} of 4 cameras moved" in printed
    assert set(result["motion"]["per_camera"]) == set(result["knowledge"]["coverage"]) == set(result["per_camera"])
    assert (
        "Not determined by these data (factory values kept)" in printed
        and "move the object along the rig's axes" in printed
    )
    assert f"before {result['rms_px_before']:.3f} px" in printed and str(out / "report.html") in printed

    truth, factory = read_rig(workplace.capture / "truth" / "rig.yaml"), read_rig(workplace.rig)
    found = read_rig(out / "rig.yaml")
    std = load_rig_covariance(out / "rig.yaml").std
    error = relative_difference(found, truth)
    assert found.prior == factory.prior
    # Focal lengths: nearer to the truth than the factory's, and within 4.5 predicted standard deviations.
    focal = error[:, 6:8]
    assert focal.abs().mean() < relative_difference(factory, truth)[:, 6:8].abs().mean() / 2
    assert (focal / std[:, 6:8]).abs().max() < 4.5


def test_a_chosen_range_of_snapshots(workplace, tmp_path):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out, "--snapshots", "1:3", "--no-report") == 0
    assert json.loads((out / "result.json").read_text())["snapshots_used"] == 2
    assert not (out / "report.html").exists()


def test_coded_detections(workplace, tmp_path):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture / "truth" / "detections.csv", out, "--no-report") == 0
    result = json.loads((out / "result.json").read_text())
    assert result["identity"] == "coded"
    assert result["rms_px_after"] < 0.02


def test_blobs_found_by_detect_give_the_same_rig(workplace, tmp_path):
    table = tmp_path / "blobs.csv.gz"
    assert main(["detect", str(workplace.capture), "--out", str(table), "--rig", str(workplace.rig)]) == 0
    assert calibrate(workplace, table, tmp_path / "a", "--no-report") == 0
    assert calibrate(workplace, workplace.capture, tmp_path / "b", "--no-report") == 0
    first, second = read_rig(tmp_path / "a" / "rig.yaml"), read_rig(tmp_path / "b" / "rig.yaml")
    assert first.local(second).abs().max() < 1e-6


def test_a_camera_that_sees_nothing_is_refused_unless_allowed(workplace, tmp_path, capsys):
    blobs = load_detections(workplace.capture / "truth" / "detections.csv")
    table = tmp_path / "blobs.csv"
    save_detections(blobs.select(blobs.camera != 1), table)
    out = tmp_path / "out"
    (out).mkdir()
    (out / "rig.yaml").write_text("of an earlier run")
    assert calibrate(workplace, table, out) == 3
    line = one_line(capsys)
    assert "cam02" in line and "--blind-cameras" in line and "PipelineOptions" not in line
    result = json.loads((out / "result.json").read_text())
    assert result["status"] == "refused" and "cam02" in result["reason"] and "--without" in result["reason"]
    assert not (out / "rig.yaml").exists()
    assert (out / "report.html").exists()
    assert calibrate(workplace, table, out, "--blind-cameras", "--no-report") == 0
    factory, found = read_rig(workplace.rig), read_rig(out / "rig.yaml")
    assert np.allclose(found.focal_length[1], factory.focal_length[1])
    assert calibrate(workplace, table, tmp_path / "less", "--without", "cam02", "--no-report") == 0
    assert read_rig(tmp_path / "less" / "rig.yaml").camera_names == ("cam01", "cam03", "cam04")


def test_too_few_fiducials_are_refused(workplace, tmp_path, capsys):
    blobs = load_detections(workplace.capture / "truth" / "detections.csv")
    table = tmp_path / "blobs.csv"
    save_detections(blobs.select(blobs.fiducial < 3), table)
    assert calibrate(workplace, table, tmp_path / "out", "--no-report") == 3
    assert re.search("too few fiducials: found 3, expected at least 4", one_line(capsys))


def test_residuals_that_do_not_fit_are_refused(workplace, tmp_path, capsys):
    blobs = load_detections(workplace.capture / "truth" / "detections.csv")
    noise = np.random.default_rng(0).normal(scale=6.0, size=blobs.uv.shape)
    table = tmp_path / "blobs.csv"
    blobs.uv[:] += noise
    save_detections(blobs, table)
    assert calibrate(workplace, table, tmp_path / "out", "--no-report") == 3
    assert re.search(
        r"misses the blobs by 7.\d+ px \(RMS\), of which 5.\d+ px are not noise of the blobs", one_line(capsys)
    )


@pytest.fixture
def broken(workplace, tmp_path):
    """A copy of the capture to damage."""
    copy = tmp_path / "capture"
    shutil.copytree(workplace.capture, copy)
    return copy


def test_empty_frames_are_refused(workplace, broken, tmp_path, capsys):
    for path in broken.glob("frames/*/*.png"):
        write_frame(path, np.full_like(read_frame(path), 15))
    assert calibrate(workplace, broken, tmp_path / "out") == 3
    assert "blobs" in one_line(capsys)
    assert not (tmp_path / "out" / "rig.yaml").exists()


def test_a_missing_camera_is_named(workplace, broken, tmp_path, capsys):
    shutil.rmtree(broken / "frames" / "cam03")
    assert calibrate(workplace, broken, tmp_path / "out", "--no-report") == 2
    assert f"{broken / 'frames'}: found no frames of cam03, expected some" in one_line(capsys)


def test_a_missing_frame_is_no_problem(workplace, broken, tmp_path):
    (broken / "frames" / "cam03" / "00001.png").unlink()
    assert calibrate(workplace, broken, tmp_path / "out", "--no-report") == 0


BAD_INPUT = {
    "truncated frame": (
        lambda c: (c / "frames/cam02/00001.png").write_bytes((c / "frames/cam02/00001.png").read_bytes()[:-200]),
        "cam02/00001.png",
    ),
    "wrong camera name": (lambda c: (c / "frames/cam02").rename(c / "frames/kamera2"), "kamera2"),
    "wrong size": (lambda c: write_frame(c / "frames/cam01/00000.png", np.zeros((100, 100), np.uint8)), "512"),
    "a deep frame in a shallow capture": (
        lambda c: write_frame(c / "frames/cam01/00001.png", np.zeros((272, 512), np.uint16)),
        "8",
    ),
    "a 16-bit capture saved as 8 bit": (
        lambda c: (c / "capture.yaml").write_text("format: imgcal-capture/1\nbit_depth: 16\n"),
        "16-bit frame saved as 8-bit",
    ),
    "no frames": (lambda c: shutil.rmtree(c / "frames"), "frames"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_captures_are_named_in_one_line_and_nothing_is_written(case, workplace, broken, tmp_path, capsys):
    damage, expected = BAD_INPUT[case]
    damage(broken)
    assert calibrate(workplace, broken, tmp_path / "out") == 2
    assert expected in one_line(capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["nowhere", "--rig", "O10", "--object", "cube8"], "nowhere"),
        (["{capture}", "--rig", "O11", "--object", "cube8"], "O10"),
        (["{capture}", "--rig", "{rig}", "--object", "cube9"], "cube8"),
        (["{capture}", "--rig", "{rig}", "--object", "{object}", "--snapshots", "7:9"], "7:9"),
        (["{capture}", "--rig", "{rig}", "--object", "{object}", "--snapshots", "2:1"], "2:1"),
        (["{capture}", "--rig", "{rig}", "--object", "{object}", "--snapshots", "all"], "A:B"),
        (["{capture}", "--rig", "{rig}", "--object", "{object}", "--without", "cam9"], "cam9"),
        (["{capture}", "--rig", "{rig}", "--object", "{object}", "--reference", "cam9"], "cam9"),
        (["{capture}", "--rig", "{object}", "--object", "{object}"], "object.csv"),
        (["{capture}", "--rig", "{rig}", "--object", "{rig}"], "factory.yaml"),
    ],
)
def test_bad_arguments_are_one_line(arguments, expected, workplace, tmp_path, capsys):
    values = {"capture": workplace.capture, "rig": workplace.rig, "object": workplace.object}
    filled = [argument.format(**values) for argument in arguments]
    assert main(["calibrate", *filled, "--out", str(tmp_path / "out")]) == 2
    assert expected in one_line(capsys)
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_a_file(workplace, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert calibrate(workplace, workplace.capture, tmp_path / "out") == 2
    assert "expected a folder" in one_line(capsys)
    assert (tmp_path / "out").read_text() == "mine"


def relabelled(workplace, tmp_path, **columns):
    """The true detections of six snapshots with some columns changed."""
    blobs = load_detections(workplace.capture / "truth" / "detections.csv")
    parts = [replace(blobs, snapshot=blobs.snapshot + 3 * k) for k in range(2)]
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")
    }
    names = tuple(f"{s:05d}" for s in range(6))
    table = Detections(**joined, camera_names=blobs.camera_names, snapshot_names=names)
    table = replace(table, **{name: change(getattr(table, name)) for name, change in columns.items()})
    save_detections(table, tmp_path / "blobs.csv")
    return tmp_path / "blobs.csv"


def exchanged(first, second):
    def change(values):
        return np.where(values == first, second, np.where(values == second, first, values))

    return change


def test_swapped_cameras_are_refused(workplace, tmp_path, capsys):
    table = relabelled(workplace, tmp_path, camera=exchanged(0, 2))
    assert calibrate(workplace, table, tmp_path / "out", "--no-report") == 3
    assert "cameras cam01 and cam03 seem to be exchanged" in one_line(capsys)


def test_swapped_labels_are_refused(workplace, tmp_path, capsys):
    table = relabelled(workplace, tmp_path, fiducial=exchanged(0, 1))
    assert calibrate(workplace, table, tmp_path / "out", "--no-report") == 3
    assert "estimation" in one_line(capsys)


def test_the_untouched_table_is_accepted(workplace, tmp_path):
    assert calibrate(workplace, relabelled(workplace, tmp_path), tmp_path / "out", "--no-report") == 0


def test_a_drift_beyond_the_prior_is_said_and_its_spread_is_honest(workplace, tmp_path, capsys):
    truth = simulate_truth(
        read_rig(workplace.rig),
        load_object(workplace.object),
        6,
        torch.Generator().manual_seed(0),
        RelativeDrift(0.1, 0.1),
    )
    table = true_detections(truth)
    table.uv[:] += 0.1 * np.random.default_rng(0).standard_normal(table.uv.shape)
    save_detections(table, tmp_path / "blobs.csv")
    assert calibrate(workplace, tmp_path / "blobs.csv", tmp_path / "out", "--no-report") == 0
    assert "than the rig's prior" in capsys.readouterr().err.replace("as far as", "than")
    assert json.loads((tmp_path / "out" / "result.json").read_text())["prior_too_narrow"]
    found, std = read_rig(tmp_path / "out" / "rig.yaml"), load_rig_covariance(tmp_path / "out" / "rig.yaml").std
    error = relative_difference(found, truth.rig)[:, 6:10] / std[:, 6:10]
    assert error.square().mean().sqrt() < 1.6


def test_a_start_pose_says_which_way_round_a_cube_is(o10, tmp_path, workplace):
    cube = load_object("cube8")
    truth = simulate_truth(o10, cube, 1, torch.Generator().manual_seed(0), PhysicalDrift())
    blobs = true_detections(truth)
    save_detections(replace(blobs, fiducial=np.full(len(blobs), -1)), tmp_path / "blobs.csv")
    pose = truth.rig_from_object[0]
    numbers = [f"{x:.6f}" for x in (*vector_from_rotation(pose.rotation).tolist(), *pose.translation.tolist())]

    def identity(*more):
        arguments = [str(tmp_path / "blobs.csv"), "--rig", "O10", "--object", "cube8", "--out", str(tmp_path / "out")]
        assert main(["calibrate", *arguments, "--no-report", *more]) == 0
        result = json.loads((tmp_path / "out" / "result.json").read_text())
        return result["identity"], result["identity_alternatives"]

    assert identity() == ("ambiguous", 24)
    assert identity("--start-pose", *numbers) == ("by_prior", 1)


def test_a_start_pose_that_is_no_number_is_explained(workplace, tmp_path, capsys):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out, "--start-pose", *"00000", "nan") == 2
    assert "--start-pose: found" in one_line(capsys)


def test_leaving_out_all_cameras_is_one_line(workplace, tmp_path, capsys):
    assert (
        calibrate(workplace, workplace.capture, tmp_path / "out", "--without", *read_rig(workplace.rig).camera_names)
        == 2
    )
    assert "--without: found all 4 cameras" in one_line(capsys)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.fixture
def blind(workplace, tmp_path):
    """Detections that are refused: one camera sees nothing."""
    blobs = load_detections(workplace.capture / "truth" / "detections.csv")
    table = tmp_path / "blind.csv"
    save_detections(blobs.select(blobs.camera != 1), table)
    return table


def test_a_report_that_cannot_be_written_leaves_the_earlier_result(workplace, blind, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out) == 0
    before = contents(out)

    def full(_, path):
        raise InputError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr("imgcal.report.write_report", full)
    for source in (workplace.capture / "truth" / "detections.csv", blind):
        capsys.readouterr()
        assert calibrate(workplace, source, out) == 2
        assert f"{out / 'report.html'}: cannot be written" in one_line(capsys)
        assert contents(out) == before
    assert calibrate(workplace, workplace.capture, tmp_path / "new") == 2
    assert not (tmp_path / "new").exists()


def test_a_refusal_moves_an_earlier_calibration_to_previous(workplace, blind, tmp_path, capsys):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out) == 0
    earlier = contents(out)
    for again in range(2):  # a second refusal must not displace the good calibration by the first one's reason
        capsys.readouterr()
        assert calibrate(workplace, blind, out) == 3
        moved = [line for line in capsys.readouterr().err.splitlines() if str(out / "previous") in line]
        assert len(moved) == (0 if again else 1)
        assert set(contents(out)) == {"report.html", "result.json"}
        assert contents(out / "previous") == earlier
    result = json.loads((out / "result.json").read_text())
    assert result["status"] == "refused" and result["version"] == imgcal.__version__
    assert "cam02" in (out / "report.html").read_text()
    assert calibrate(workplace, workplace.capture, out, "--no-report") == 0
    assert set(contents(out)) == {"rig.yaml", "rig.posterior.safetensors", "result.json"}
    assert contents(out / "previous") == earlier
    assert calibrate(workplace, blind, out, "--no-report") == 3
    assert set(contents(out / "previous")) == {"rig.yaml", "rig.posterior.safetensors", "result.json"}


def test_a_folder_of_somebody_elses_named_previous_is_left_alone(workplace, tmp_path, capsys):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out, "--no-report") == 0
    (out / "previous").mkdir()
    (out / "previous" / "notes.txt").write_text("mine")
    assert calibrate(workplace, workplace.capture, out, "--no-report") == 2
    assert f"{out / 'previous'}: found notes.txt" in one_line(capsys)
    assert contents(out / "previous") == {"notes.txt": b"mine"}


def test_the_previous_rig_may_be_the_one_to_start_from(workplace, blind, tmp_path, capsys):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out, "--no-report") == 0
    assert calibrate(workplace, blind, out, "--no-report") == 3
    arguments = ["--rig", str(out / "previous" / "rig.yaml"), "--object", str(workplace.object), "--no-report"]
    assert main(["calibrate", str(workplace.capture), *arguments, "--out", str(out)]) == 0
    capsys.readouterr()
    assert main(["calibrate", str(workplace.capture), *arguments, "--out", str(out)]) == 2
    assert "previous/rig.yaml is also the input of --rig" in one_line(capsys)


def test_the_rig_to_start_from_is_not_overwritten(workplace, blind, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(workplace.rig, out / "rig.yaml")
    arguments = ["calibrate", str(blind), "--rig", str(out / "rig.yaml"), "--object", str(workplace.object)]
    assert main([*arguments, "--out", str(out)]) == 2
    assert "rig.yaml is also the input of --rig" in one_line(capsys)
    assert (out / "rig.yaml").read_bytes() == workplace.rig.read_bytes()


def test_blobs_that_say_next_to_nothing_are_refused(workplace, tmp_path, capsys):
    detections = load_detections(workplace.capture / "truth" / "detections.csv")
    save_detections(replace(detections, sigma=np.full(len(detections), 1e4)), tmp_path / "d.csv")
    assert calibrate(workplace, tmp_path / "d.csv", tmp_path / "out") == 3
    assert "carry too little information" in one_line(capsys)
    assert json.loads((tmp_path / "out" / "result.json").read_text())["status"] == "refused"
    assert not (tmp_path / "out" / "rig.yaml").exists()


def test_a_matched_filter_looks_at_the_frames_and_needs_them(workplace, tmp_path, capsys):
    out = tmp_path / "out"
    assert calibrate(workplace, workplace.capture, out, "--detector", "matched", "--snapshots", "1:3") == 0
    result = json.loads((out / "result.json").read_text())
    assert result["detector"] == {"matched": 2} and result["rms_px_after"] < 0.5 < result["rms_px_before"]
    blobs = tmp_path / "blobs.csv"
    assert main(["detect", str(workplace.capture), "--out", str(blobs)]) == 0
    capsys.readouterr()
    assert calibrate(workplace, blobs, tmp_path / "other", "--detector", "matched") == 2
    assert "expected a capture with frames" in one_line(capsys)


def test_several_objects_from_simulation_to_result(tmp_path, capsys):
    capture, out = tmp_path / "capture", tmp_path / "out"
    simulated = ["simulate", "--rig", "T4", "--object", "wand4", "asymmetric8", "--out", str(capture)]
    assert main([*simulated, "--snapshots", "3", "--seed", "4"]) == 0
    objects = [str(capture / "objects" / f"{name}.csv") for name in ("wand4", "asymmetric8")]
    table, labelled = capture / "truth" / "detections.csv", tmp_path / "labelled.csv"
    assert table.read_text().splitlines()[0].endswith("object,fiducial")
    options = ["--rig", str(capture / "rig.yaml"), "--object", *objects]
    assert main(["calibrate", str(table), *options, "--out", str(out), "--labelled", str(labelled)]) == 0
    result = json.loads((out / "result.json").read_text())
    assert [entry["name"] for entry in result["object"]] == ["wand4", "asymmetric8"]
    assert all(entry["snapshots_used"] == 3 for entry in result["object"])
    assert result["snapshots_used"] == 3 and result["snapshots_rejected"] == 0 and not result["rejected"]
    blobs = 3 * 4 * 12
    assert sum(camera["blobs"] for camera in result["per_camera"].values()) == blobs
    assert sum(snapshot["blobs"] for snapshot in result["per_snapshot"].values()) == blobs
    assert result["rms_px_after"] < 0.01 < result["rms_px_before"]
    assert len(labelled.read_text().splitlines()) == blobs + 1
    assert (out / "report.html").is_file()
    capsys.readouterr()
    assert main(["score", str(table), "--rig", str(out / "rig.yaml"), "--object", *objects]) == 0
    assert json.loads(capsys.readouterr().out)["snapshots_used"] == 3
    assert main(["calibrate", str(capture), *options, "--detector", "matched", "--out", str(tmp_path / "no")]) == 2
    assert "found 2, expected a single one for detectors" in one_line(capsys)

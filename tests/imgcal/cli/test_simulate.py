import csv
import signal
import subprocess
import sys
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from imgcal.cli.arguments import Level
from imgcal.cli.main import main
from imgcal.io import load_detections, load_object, read_frame, read_rig, save_object
from imgcal.synthesis import DIFFICULTIES


def simulate(out, *more):
    return main(["simulate", "--rig", "T4", "--object", "asymmetric8", "--out", str(out), "--snapshots", "1", *more])


def test_frames_show_the_markers_where_the_truth_says(workplace):
    truth = load_detections(workplace.capture / "truth" / "detections.csv")
    frame = read_frame(workplace.capture / "frames" / "cam01" / "00002.png")
    assert frame.shape == (272, 512)
    rows = (truth.snapshot == 2) & (truth.camera == 0)
    columns, lines = np.rint(truth.uv[rows]).astype(int).T
    assert (frame[lines, columns] > frame.mean() + 50).all()


def test_the_same_seed_gives_the_same_capture(tmp_path):
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert simulate(tmp_path / name, "--seed", seed) == 0
    a, b, c = (read_frame(tmp_path / name / "frames" / "cam01" / "00000.png") for name in "abc")
    assert (a == b).all() and (a != c).any()


def test_twelve_bit_dark_markers(tmp_path):
    assert simulate(tmp_path / "a", "--sensor.bit-depth", "12", "--sensor.polarity", "dark") == 0
    frame = read_frame(tmp_path / "a" / "frames" / "cam01" / "00000.png")
    assert frame.dtype == np.uint16
    assert 1000 < np.median(frame) <= 4095
    assert "bit_depth: 12" in (tmp_path / "a" / "capture.yaml").read_text()


def test_no_drift_keeps_the_factory_rig(tmp_path):
    assert simulate(tmp_path / "a", "--drift", "none") == 0
    truth, factory = read_rig(tmp_path / "a" / "truth" / "rig.yaml"), read_rig("T4")
    assert truth.local(factory).abs().max() < 1e-12


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--kappa", "3"], "kappa"),
        (["--snapshots", "0"], "--snapshots"),
        (["--snapshots", "1000000000"], "--snapshots"),
        (["--seed", "123456789012345678901"], "--seed"),
        (["--seed", "-1"], "--seed"),
        (["--marker-radius", "1e300"], "--marker-radius"),
        (["--theta-deg", "-inf", "inf"], "--theta-deg"),
        (["--theta-deg", "nan", "nan"], "--theta-deg"),
        (["--sensor.background", "nan"], "background"),
        (["--sensor.background", "1e300"], "background"),
        (["--sensor.contrast", "inf"], "contrast"),
        (["--sensor.gradient", "0", "1e308"], "gradient"),
        (["--sensor.blur", "1e9"], "blur"),
        (["--sensor.exposure", "1e308"], "exposure"),
        (["--sensor.read-noise", "1e308"], "read_noise"),
        (["--sensor.hot-pixels", "2"], "hot_pixels"),
        (["--clutter-model.blobs.count", "1000000000"], "count"),
        (["--clutter-model.blobs.radius", "1", "1e9"], "radius"),
        (["--clutter-model.occluded", "nan"], "occluded"),
        (["--kappa", "0.1", "--drift", "physical"], "--kappa"),
        (["--drift", "none", "--physical.rotation-deg", "3"], "--physical.*: found values with a none drift"),
        (["--kappa", "0.1", "--physical.rotation-deg", "3"], "--physical.*: found values with a relative drift"),
        (["--lights", "5"], "--lights: found 5 with an object of known markers"),
        (["--exposure-ms", "5"], "--poses hand-held"),
        (["--exposure-ms", "nan", "--poses", "hand-held"], "--exposure-ms"),
        (["--poses", "volume", "--phi-deg", "0", "10"], "--poses hemisphere"),
        (["--poses", "hand-held", "--speed", "0"], "speed"),
        (["--physical.position", "1e300", "--drift", "physical"], "position"),
        (["--physical.rotation-deg", "-1", "--drift", "physical"], "rotation_deg"),
    ],
)
def test_impossible_values(arguments, expected, tmp_path, capsys):
    try:
        code = simulate(tmp_path / "a", *arguments)
    except SystemExit as stop:  # found while the command line was parsed
        code = stop.code
    assert code == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_an_existing_capture_is_not_overwritten(workplace, capsys):
    assert simulate(workplace.capture) == 2
    assert "expected a new folder" in capsys.readouterr().err


KILLED = """
import os, signal, sys
from imgcal.cli import simulate
from imgcal.cli.main import main
from imgcal.cli.arguments import Level

written = []

def write_frame(path, image, write=simulate.write_frame):
    written.append(path)
    if len(written) == 6:
        os.kill(os.getpid(), signal.SIGKILL)
    write(path, image)

simulate.write_frame = write_frame
main(sys.argv[1:])
"""


def test_a_killed_simulation_is_no_capture(workplace, tmp_path, capsys):
    out = tmp_path / "capture"
    command = ["simulate", "--rig", str(workplace.rig), "--object", str(workplace.object), "--out", str(out)]
    done = subprocess.run([sys.executable, "-c", KILLED, *command, "--snapshots", "3"], check=False)
    assert done.returncode == -signal.SIGKILL
    for command in ("calibrate", "score", "detect", "render"):
        options = [] if command == "detect" else ["--rig", str(workplace.rig), "--object", str(workplace.object)]
        options += [] if command == "score" else ["--out", str(tmp_path / command)]
        assert main([command, str(out), *options]) == 2
        assert f"{out}: found a capture that was not finished" in capsys.readouterr().err
        assert not (tmp_path / command).exists()
    assert simulate(out) == 0
    assert sorted(path.name for path in (out / "frames" / "cam01").iterdir()) == ["00000.png"]


def test_an_interrupted_simulation_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("imgcal.cli.simulate.write_frame", interrupted)
    assert simulate(tmp_path / "a") == 130
    assert not (tmp_path / "a").exists()


def test_a_named_difficulty(tmp_path):
    """The levels of the command are those of the library; what is hidden is written beside the truth."""
    assert get_args(Level) == tuple(DIFFICULTIES)
    assert simulate(tmp_path / "a", "--difficulty", "clutter") == 0
    lines = (tmp_path / "a" / "truth" / "seen.csv").read_text().splitlines()
    assert lines[0] == "snapshot,camera,fiducial,seen"
    assert len(lines) == 1 + 4 * 8
    shares = [float(line.rpartition(",")[2]) for line in lines[1:]]
    assert 0 <= min(shares) < 0.1 and max(shares) > 0.9


def test_what_is_seen_of_several_objects_is_called_as_in_the_table_of_blobs(tmp_path):
    arguments = ["simulate", "--rig", "T4", "--object", "asymmetric8", "cube8", "--snapshots", "1"]
    assert main([*arguments, "--difficulty", "clutter", "--out", str(tmp_path / "a")]) == 0
    seen, blobs = (
        list(csv.DictReader((tmp_path / "a" / "truth" / f"{name}.csv").read_text().splitlines()))
        for name in ("seen", "detections")
    )
    assert list(seen[0]) == ["snapshot", "camera", "object", "fiducial", "seen"]
    names = lambda rows: {(row["camera"], row["object"], row["fiducial"]) for row in rows}  # noqa: E731
    assert len(names(seen)) == 4 * 16 and names(blobs) <= names(seen)


def test_kappa_alone_is_the_papers_drift(tmp_path):
    assert simulate(tmp_path / "a", "--kappa", "0.01") == 0
    truth, factory = read_rig(tmp_path / "a" / "truth" / "rig.yaml"), read_rig("T4")
    change = (truth.focal_length / factory.focal_length - 1).abs()
    assert 0.001 < change.max() <= 0.01


def test_a_rig_without_working_distance_is_simulated_in_its_volume(tmp_path):
    assert (
        main(["rig", "look-at", "--cameras", "3", "--image-size", "160", "128", "--out", str(tmp_path / "r.yaml")]) == 0
    )
    arguments = ["simulate", "--rig", str(tmp_path / "r.yaml"), "--object", "wand4", "--snapshots", "3"]
    assert main([*arguments, "--out", str(tmp_path / "a")]) == 0
    poses = np.loadtxt(tmp_path / "a" / "truth" / "rig_from_object.csv", delimiter=",", skiprows=1)
    volume = read_rig(tmp_path / "r.yaml").volume
    assert volume.contains(poses[:, 4:] + 0.0).sum() >= 2  # the object's origin is not far from its centroid
    held = ["--poses", "hand-held", "--exposure-ms", "8", "--no-clutter", "--sensor.read-noise", "0"]
    assert main([*arguments, *held, "--out", str(tmp_path / "b")]) == 0
    assert main([*arguments, *held, "--exposure-ms", "0", "--out", str(tmp_path / "c")]) == 0
    smeared, sharp = (read_frame(tmp_path / name / "frames" / "cam01" / "00001.png").max() for name in "bc")
    assert smeared <= sharp


def test_the_truth_calls_fiducials_as_the_object_does(tmp_path):
    obj = replace(load_object("asymmetric8"), labels=(17, 16, 15, 14, 13, 12, 11, 10))
    save_object(obj, tmp_path / "lab.csv")
    out = tmp_path / "a"
    arguments = ["--rig", "T4", "--object", str(tmp_path / "lab.csv"), "--out", str(out), "--snapshots", "3"]
    assert main(["simulate", *arguments]) == 0
    seen = {line.split(",")[2] for line in (out / "truth" / "seen.csv").read_text().splitlines()[1:]}
    assert seen == set(map(str, obj.labels))
    arguments = ["--rig", "T4", "--object", str(out / "object.csv"), "--out", str(tmp_path / "out"), "--no-report"]
    labelled = tmp_path / "labelled.csv"
    for blobs, more in ((out / "truth" / "detections.csv", ["--labelled", str(labelled)]), (labelled, [])):
        assert load_detections(blobs, fiducials=obj.rows).fiducial.max() == 7
        assert main(["calibrate", str(blobs), *arguments, *more]) == 0

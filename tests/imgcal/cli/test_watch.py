import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from imgcal.cli.main import main
from imgcal.cli.watch import _object_difference
from imgcal.geometry import RigidTransform
from imgcal.io import load_object, read_rig, save_detections, save_object, save_rig, write_frame
from imgcal.online import RigKeeper
from imgcal.synthesis import Truth, simulate_volume, true_detections
from imgcal.types import CalibrationObject, CameraRig, Detections, DriftRate, RigPrior
from imgcal.watch import Progress, RefusalCauses, put_aside
from tests.imgcal.streams import Stream
from tests.imgcal.watch.test_marker_files import points_of

SNAPSHOTS, BUMPED_AT = 60, 30


@pytest.fixture(scope="module")
def stream():
    return Stream("T4", "asymmetric8", SNAPSHOTS, seed=3)


@pytest.fixture(scope="module")
def blobs(stream):
    """Blobs of all snapshots; the second camera is turned by 0.3 degrees on the way."""
    bumped = stream.bumped([1], turn_deg=0.3)
    parts = [stream.blobs(s, bumped if s >= BUMPED_AT else stream.true)[0] for s in range(SNAPSHOTS)]
    return replace(Detections.join(parts), snapshot_names=tuple(f"{s:03d}" for s in range(SNAPSHOTS)))


def lines(blobs):
    """The same as lines of JSON."""
    found = []
    for s in range(SNAPSHOTS):
        for camera, name in enumerate(blobs.camera_names):
            uv = blobs.uv[(blobs.snapshot == s) & (blobs.camera == camera)].tolist()
            found.append(json.dumps({"camera": name, "time": s / 60, "uv": uv, "sigma": 0.07}) + "\n")
    return found


def watch(source, out, *more):
    return main(["watch", str(source), "--rig", "T4", "--object", "asymmetric8", "--out", str(out), *more])


def events(out):
    return [json.loads(line) for line in (out / "events.jsonl").read_text().split("\n")[:-1]]


def test_a_table_of_blobs_is_watched_once(blobs, stream, tmp_path, capsys):
    save_detections(blobs, tmp_path / "blobs.csv.gz")
    out = tmp_path / "out"
    assert watch(tmp_path / "blobs.csv.gz", out, "--rate", "60", "--hook", "true", "--metrics", "0") == 0
    said = capsys.readouterr()
    assert f"60 snapshots, {len(events(out))} events: {out}/rig.yaml" in said.out and "moved: cam02" in said.out
    moved = [event for event in events(out) if event["event"] == "moved"]
    assert {event["camera"] for event in moved} == {"cam02"}
    assert moved[0]["since"] == "1970-01-01T00:00:00.500+00:00"
    found = read_rig(out / "rig.yaml")
    truth = stream.bumped([1])  # of no size
    off = torch.rad2deg(found.local(truth)[:, :3].norm(dim=1))
    assert off.max() < 1.0 and (out / "state.json").is_file() and list(out.glob("history/*/*.yaml"))
    known = (out / "rig.yaml").read_bytes()
    assert watch(tmp_path / "blobs.csv.gz", out, "--rate", "60") == 0
    said = capsys.readouterr()
    read = f"all 60 snapshots of {tmp_path}/blobs.csv.gz had been read before; --fresh starts from the factory rig"
    assert said.out.endswith(f"{read} | 0 snapshots, 1 event: {out}/rig.yaml\n")
    assert not said.err and (out / "rig.yaml").read_bytes() == known
    assert watch(tmp_path / "blobs.csv.gz", out, "--rate", "60", "--fresh") == 0


def test_an_assumed_rate_is_stated(blobs, tmp_path, capsys):
    save_detections(blobs, tmp_path / "blobs.csv")
    assert watch(tmp_path / "blobs.csv", tmp_path / "out", "--rate", "60") == 0
    assert "snapshots a second" not in capsys.readouterr().err
    assert watch(tmp_path / "blobs.csv", tmp_path / "other") == 0
    assert "note: 30 snapshots a second are assumed; --rate says otherwise\n" in capsys.readouterr().err


def test_lines_on_standard_input_and_garbage_among_them(blobs, tmp_path, monkeypatch, capsys):
    given = lines(blobs)[: 4 * 20]
    given[10:10] = ["junk\n", '{"camera": "cam09", "time": 0.1, "uv": []}\n']
    (tmp_path / "lines").write_text("".join(given))
    with open(tmp_path / "lines") as file:
        monkeypatch.setattr(sys, "stdin", file)
        assert watch("-", tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "20 snapshots" in said and " | 2 unreadable | latest unreadable input: " in said and "cam09" in said
    assert json.loads((tmp_path / "out" / "state.json").read_text())["progress"]["time"] == pytest.approx(19 / 60)


def test_a_reader_of_its_output_that_goes_away_is_no_success(blobs, tmp_path):
    (tmp_path / "lines").write_text("".join(lines(blobs)))
    command = [sys.executable, "-m", "imgcal", "watch", "-", "--rig", "T4", "--object", "asymmetric8"]
    read, write = os.pipe()
    os.close(read)
    with open(tmp_path / "lines") as given, os.fdopen(write, "w") as nobody:
        found = subprocess.run(
            [*command, "--out", str(tmp_path / "out")], stdin=given, stdout=nobody, stderr=subprocess.PIPE, text=True,
            env=os.environ | {"PYTHONPATH": str(Path.cwd())},
        )  # fmt: skip
    assert found.returncode == 2 and (tmp_path / "out" / "state.json").is_file()
    assert found.stderr.splitlines()[-1].startswith("imgcal: watch: whatever read the standard output is gone")


def test_what_comes_on_standard_input_is_known_by_its_content(blobs, tmp_path, monkeypatch, capsys):
    def read(first, last, *more):
        (tmp_path / "lines").write_text("".join(lines(blobs)[4 * first : 4 * last]))
        with open(tmp_path / "lines") as file:
            monkeypatch.setattr(sys, "stdin", file)
            return watch("-", tmp_path / "out", *more), "".join(capsys.readouterr())

    assert read(0, 10)[0] == 0
    code, said = read(0, 12)
    assert code == 0 and "2 snapshots" in said and "10 had been read before" in said
    code, said = read(20, 30)
    assert code == 0 and "10 snapshots" in said and "before" not in said
    code, said = read(5, 15)
    assert code == 2 and "found a different recording that begins at" in said


def test_a_killed_process_goes_on_and_ctrl_c_ends_it_cleanly(blobs, tmp_path):
    zmq = pytest.importorskip("zmq")
    given, out, address = lines(blobs)[: 4 * BUMPED_AT], tmp_path / "out", f"ipc://{tmp_path}/blobs"
    command = [sys.executable, "-m", "imgcal", "watch", address, "--rig", "T4", "--object", "asymmetric8"]
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.linger = 0
        socket.bind(address)
        number = 0

        def started():
            return subprocess.Popen(
                [*command, "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                env=os.environ | {"PYTHONPATH": str(Path.cwd())},
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )  # fmt: skip

        def sent_until(condition):
            nonlocal number
            ends = time.monotonic() + 120
            while not condition():
                assert time.monotonic() < ends
                for line in given[4 * (number % BUMPED_AT) :][:4]:
                    socket.send_string(json.dumps({**json.loads(line), "time": 1.7e9 + number / 60}))
                number += 1
                time.sleep(1 / 60)

        process = started()
        sent_until(lambda: (out / "state.json").is_file())
        process.kill()
        process.communicate()
        saved = Progress.load(out)
        process = started()
        sent_until(lambda: Progress.load(out) != saved)
        process.send_signal(signal.SIGINT)
        said, complaint = process.communicate(timeout=30)
    assert process.returncode == 130
    (line,) = [text for text in complaint.splitlines() if "for this machine" not in text]
    assert line.startswith("imgcal: interrupted after ") and line.endswith("the same command resumes from there")
    assert [event["event"] for event in events(out)].count("restart") == 1 and "restart: resumed" in said
    assert read_rig(out / "rig.yaml").num_cameras == 4


def test_a_missing_source_is_reported_before_any_note(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stick.csv").write_text("x,y,z\n0,0,0\n100,0,0\n")
    arguments = ["watch", "absent", "--rig", "T4", "--object", "stick.csv", "--out", "out"]
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("imgcal: absent: no such file or folder")
    (tmp_path / "empty" / "frames" / "cam01").mkdir(parents=True)
    assert main([*arguments[:1], "empty", *arguments[2:], "--until-idle", "0.1"]) == 3
    assert "note: markers of stick are followed one by one" in capsys.readouterr().err


def test_a_stick_of_another_length_does_not_go_on_with_what_is_known(tmp_path):
    stick, longer, both = (
        CalibrationObject.of_several([
            CalibrationObject(torch.tensor([[0.0, 0, 0], [length, 0, 0]]).double(), torch.ones(2, 3).double())
            for length in lengths
        ]).as_unknown()
        for lengths in ((100.0,), (101.0,), (100.0, 100.0))
    )  # fmt: skip
    assert _object_difference(stick, stick) is None
    assert "fiducial 2" in str(_object_difference(longer, stick))
    assert "found 20 fiducials, expected 18" in str(_object_difference(both, stick))


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["absent"], 2, "absent: no such file or folder"),
        (["tcp://nowhere"], 2, "expected an address tcp://host:port"),
        (["absent.mcap"], 2, "absent.mcap: no such file"),
        (["absent.csv", "--rate", "0"], 2, "--rate: found 0"),
        (["-", "--tolerance", "-1"], 2, "tolerance: found -1"),
        (["-", "--hook", "no-such-program"], 2, "--hook: found 'no-such-program'"),
        (["-", "--metrics", "nowhere", "--poses", "poses.csv"], 2, "--metrics: found 'nowhere', expected [HOST:]PORT"),
        (["-", "--serve", "1:2:3", "--poses", "poses.csv"], 2, "--serve: found '1:2:3', expected [HOST:]PORT"),
        (["absent", "--until-idle", "5"], 2, "absent: "),
        (["bag.mcap", "--topic", "cam01"], 2, "--topic: found 'cam01', expected CAMERA=TOPIC"),
        (["bag.mcap", "--topic", "a=/x", "a=/y"], 2, "--topic: found camera a twice, expected one topic per camera"),
        (["empty", "--rate", "0"], 2, "--rate: needs a table of blobs, found a folder of frames (empty)"),
        (["empty", "--topic", "a=b"], 2, "--topic: needs a recording, found a folder of frames (empty)"),
        (["-", "--until-idle", "3"], 2, "--until-idle: needs a folder of frames, found standard input (-)"),
        (
            ["here.csv", "--remove"],
            2,
            "--remove: needs a folder of frames, found a table of blobs (here.csv)",
        ),
        (
            ["tcp://a:1", "--videos-differ"],
            2,
            "--videos-differ: needs a folder of videos, found an address (tcp://a:1)",
        ),
        (["empty", "--until-idle", "0.1"], 3, "watch: no snapshot came: empty: found no folder frames in it"),
        (["typing", "--until-idle", "0.1"], 3, "nearest: cam01"),
    ],
)
def test_mistakes(arguments, code, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "typing" / "frames" / "cam1").mkdir(parents=True)
    (tmp_path / "here.csv").write_text("")
    (tmp_path / "nothing").write_text("")
    with open(tmp_path / "nothing") as file:
        monkeypatch.setattr(sys, "stdin", file)
        assert watch(arguments[0], "out", *arguments[1:]) == code
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "poses.csv").exists()


def upside_down(blobs, rig):
    height = float(rig.image_size[0, 1])
    return replace(blobs, uv=np.stack((blobs.uv[:, 0], height - 1 - blobs.uv[:, 1]), 1))


UPSIDE_DOWN = "all images seem to be mirrored top to bottom (as if v were counted from the bottom)"


def test_images_in_another_convention_are_named(blobs, stream, tmp_path, capsys):
    save_detections(upside_down(blobs, stream.rig).of_snapshots(0, 6), tmp_path / "blobs.csv")
    assert watch(tmp_path / "blobs.csv", tmp_path / "out") == 3
    assert f"nothing could be learned from any snapshot: {UPSIDE_DOWN}" in capsys.readouterr().err


def test_the_cause_of_the_first_refusals_is_told_once_and_again_after_something_was_learned(blobs, stream):
    refusals, table = RefusalCauses(stream.rig, stream.obj), upside_down(blobs, stream.rig)
    states = [SimpleNamespace(refused="no", detections=table.of_snapshots(s, s + 1)) for s in range(30)]
    told = [refusals.add(state) for state in states for _ in range(2)]
    while (cause := refusals.add(None)) is None:
        time.sleep(0.01)
    assert not any(told) and cause.startswith(UPSIDE_DOWN)
    assert refusals.add(None) is None and refusals.find_cause() == cause
    for _ in range(2):
        assert refusals.add(SimpleNamespace(refused=None, detections=blobs.of_snapshots(0, 1))) is None
    assert refusals.find_cause() is None
    for state in states[:5]:
        refusals.add(state)
    assert (refusals.find_cause() or "").startswith(UPSIDE_DOWN)


def test_normalized_centres_are_told_as_such(blobs, stream):
    refusals, size = RefusalCauses(stream.rig, stream.obj), stream.rig.image_size.double().numpy()[blobs.camera]
    table = replace(blobs, uv=(blobs.uv + 0.5) / size)
    for s in range(5):
        refusals.add(SimpleNamespace(refused="no", detections=table.of_snapshots(s, s + 1)))
    assert "normalized by the images' width and height" in refusals.find_cause()


def test_a_folder_that_has_been_read_to_its_end_is_said_to_be_known(stream, tmp_path, capsys):
    frames = tmp_path / "capture" / "frames"
    for camera, (width, height) in zip(stream.rig.camera_names, stream.rig.image_size.tolist(), strict=True):
        (frames / camera).mkdir(parents=True)
        for name in ("8", "9", "10"):
            write_frame(frames / camera / f"{name}.png", np.zeros((height, width), np.uint8))
    out = tmp_path / "out"
    out.mkdir()
    with RigKeeper(stream.rig, stream.obj) as keeper:
        keeper.update(stream.blobs(0)[0], 9.0)
        keeper.saved({"time": 9.0, "name": "10"}).write(out / "state.json")
    assert watch(tmp_path / "capture", out, "--until-idle", "0.3") == 0
    said = capsys.readouterr()
    assert "all 3 snapshots of" in said.out and not said.err


@pytest.fixture(scope="module")
def known(blobs, tmp_path_factory):
    """What a run has left of T4 and asymmetric8."""
    folder = tmp_path_factory.mktemp("known")
    save_detections(blobs.of_snapshots(0, 5), folder / "blobs.csv")
    assert watch(folder / "blobs.csv", folder / "out") == 0
    return folder


RIG, OBJECT = read_rig("T4"), load_object("asymmetric8")
RATIONAL = replace(RIG, lens_model="rational", distortion=torch.nn.functional.pad(RIG.distortion, (0, 3)))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (RIG.select([0, 1]), "cameras: found cam01, cam02, expected cam01, cam02, cam03, cam04"),
        (replace(RIG, focal_length=RIG.focal_length * 1.3), "focal length of cam01: found"),
        (replace(RIG, image_size=RIG.image_size * 2), "image size of cam01: found 4096, 2176, expected 2048, 1088"),
        (RATIONAL, "lens model of cam01: found rational, expected brown_conrady"),
        (replace(RIG, prior=RigPrior(position=1.0)), "(prior)"),
        (replace(RIG, drift_rate=DriftRate(position=1.0)), "(drift rate)"),
        (load_object("cube8"), "fiducial 1: found"),
        (replace(OBJECT, radius=torch.full((8,), 3.0).double()), "fiducial 1: found x, y, z, radius"),
        (replace(OBJECT, tolerance=torch.full((8,), 0.5).double()), "(tolerance)"),
    ],
)
def test_what_is_known_of_another_rig_or_object_is_not_gone_on_with(given, message, known, tmp_path, capsys):
    option, path = ("--rig", tmp_path / "a.yaml") if isinstance(given, CameraRig) else ("--object", tmp_path / "a.csv")
    save_rig(given, path) if isinstance(given, CameraRig) else save_object(given, path)
    words = [word for pair in ({"--rig": "T4", "--object": "asymmetric8"} | {option: path}).items() for word in pair]
    assert main(["watch", str(known), *map(str, words), "--out", str(known / "out")]) == 2
    error = capsys.readouterr().err
    assert f"does not belong to {option} {path} (" in error and message in error
    assert error.endswith("; --fresh starts over\n") and error.count("\n") == 1


def test_a_recording_is_gone_on_with_by_its_names_and_rate_and_another_one_is_not_taken_for_it(blobs, tmp_path, capsys):
    save_detections(blobs.of_snapshots(0, 4), tmp_path / "first.csv")
    save_detections(blobs.of_snapshots(0, 6), tmp_path / "second.csv")
    out = tmp_path / "out"
    assert watch(tmp_path / "first.csv", out) == 0
    progress = json.loads((out / "state.json").read_text())["progress"]
    expected = {"time": 0.1, "name": "003", "source": str(tmp_path / "first.csv"), "rate": 30.0, "files": {}}
    expected |= {"logged": 0, "tables": {}, "snapshot": 3, "era": 0, "first": progress["first"]}
    assert progress == expected and progress["first"] is not None
    (tmp_path / "second.csv").replace(tmp_path / "first.csv")  # it has grown
    capsys.readouterr()
    assert watch(tmp_path / "first.csv", out, "--rate", "60") == 2
    assert f"--rate: found 60, expected 30 as in {out}/state.json; --fresh" in capsys.readouterr().err
    assert watch(tmp_path / "first.csv", out) == 0
    assert "2 snapshots, 1 event:" in (said := capsys.readouterr().out) and "| 4 had been read before" in said
    (tmp_path / "first.csv").replace(tmp_path / "moved.csv")
    assert watch(tmp_path / "moved.csv", out) == 0 and "all 6 snapshots" in capsys.readouterr().out
    save_detections(blobs.of_snapshots(6, 12), tmp_path / "first.csv")
    known = events(out)
    assert watch(tmp_path / "first.csv", out) == 2
    assert "found a different recording that begins at 0 s, expected one after" in capsys.readouterr().err
    assert events(out) == known


def test_a_rig_that_was_accepted_as_factory_is_gone_on_with_by_the_file_it_began_with(known, tmp_path, capsys):
    with RigKeeper.restore(known / "out" / "state.json") as keeper:
        keeper.accept_as_factory()
        keeper.saved({"time": 0.0, "name": "000"}).write(tmp_path / "state.json")
    assert watch(known / "blobs.csv", tmp_path) == 0
    assert "4 snapshots" in capsys.readouterr().out


def test_what_was_left_and_cannot_be_used_is_told_with_the_way_out(tmp_path, monkeypatch, capsys):
    name = "state.json"
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("[]")
    with open(tmp_path / "out" / name) as file:
        monkeypatch.setattr(sys, "stdin", file)
        assert watch("-", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert name in error and error.endswith("; --fresh starts over\n") and error.count("\n") == 1


def test_the_state_of_another_version_is_told_and_nothing_is_lost(blobs, tmp_path, capsys):
    save_detections(blobs.of_snapshots(0, 5), tmp_path / "blobs.csv")
    out = tmp_path / "out"
    assert watch(tmp_path / "blobs.csv", out) == 0
    state = out / "state.json"
    state.write_text(state.read_text().replace("imgcal-keeper/10", "imgcal-keeper/9", 1))
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    capsys.readouterr()
    assert watch(tmp_path / "blobs.csv", out) == 2
    error = capsys.readouterr().err
    assert (
        "state files from earlier versions cannot be resumed" in error
        and error.endswith("; --fresh starts over\n")
        and error.count("\n") == 1
    )
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert watch(tmp_path / "blobs.csv", out, "--fresh") == 0


@pytest.mark.parametrize(
    ("given", "message"),
    [("tcp://127.0.0.1:99999", "expected an address"), ("absent.mcap", "no such file"), ("absent", "no such file")],
)
def test_a_source_that_cannot_be_opened_leaves_what_is_there_as_it_was(given, message, blobs, tmp_path, capsys):
    save_detections(blobs.of_snapshots(0, 5), tmp_path / "blobs.csv")
    out = tmp_path / "out"
    assert watch(tmp_path / "blobs.csv", out) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert watch(given, out) == 2
    assert message in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert watch(given, tmp_path / "fresh") == 2
    assert not (tmp_path / "fresh").exists()


@pytest.mark.parametrize("option", ["--serve", "--metrics"])
def test_a_port_that_is_taken_is_told_in_one_line(option, tmp_path, monkeypatch, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken, open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        port = taken.getsockname()[1]
        assert watch("-", tmp_path / "out", option, str(port)) == 2
        assert not (tmp_path / "out").exists()
    error = capsys.readouterr().err
    assert f"127.0.0.1:{port}" in error and "Errno" not in error and error.count("\n") == 1


def test_a_rig_that_cannot_be_written_is_told_at_once_and_is_no_success(blobs, tmp_path, capsys):
    save_detections(blobs.of_snapshots(0, 3), tmp_path / "blobs.csv")
    (tmp_path / "out" / "rig.yaml").mkdir(parents=True)
    assert watch(tmp_path / "blobs.csv", tmp_path / "out") == 2
    said = capsys.readouterr()
    (note,) = [line for line in said.out.splitlines() if line.startswith("note: ")]
    assert "rig.yaml" in note
    assert f"watch: 3 snapshots, 0 events: {tmp_path}/out/rig.yaml | not written: " in said.err
    assert (tmp_path / "out" / "state.json").is_file()


def test_fresh_leaves_nothing_to_go_on_from_even_before_it_has_learnt(blobs, tmp_path, monkeypatch, capsys):
    save_detections(blobs.of_snapshots(0, 4), tmp_path / "blobs.csv")
    out = tmp_path / "out"
    assert watch(tmp_path / "blobs.csv", out) == 0
    known = (out / "rig.yaml").read_bytes()
    kept = set(out.glob("history/*/*.yaml"))
    (tmp_path / "nothing").write_text("")
    with open(tmp_path / "nothing") as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        assert watch("-", out, "--fresh") == 3
    assert not (out / "state.json").exists() and not (out / "rig.yaml").exists()
    (aside,) = set(out.glob("history/*/*.yaml")) - kept
    assert aside.read_bytes() == known
    assert [event["message"] for event in events(out)] == ["started anew from the factory calibration"]
    assert "restart: started anew from the factory calibration" in capsys.readouterr().out
    assert watch(tmp_path / "blobs.csv", out) == 0
    assert "4 snapshots" in capsys.readouterr().out  # all of them, once more


def test_events_of_an_earlier_recording_survive_a_start_that_was_killed_before_it_saved(blobs, tmp_path):
    save_detections(blobs.of_snapshots(0, 4), tmp_path / "blobs.csv")
    out = tmp_path / "out"
    for more in ((), ("--fresh",)):
        assert watch(tmp_path / "blobs.csv", out, *more) == 0
    known = events(out)
    put_aside(out)  # all that the killed start did
    assert watch(tmp_path / "blobs.csv", out) == 0
    assert len(known) == 1 and events(out) == known


def test_an_address_of_qtm_is_no_address_of_zeromq(tmp_path, capsys):
    assert watch("qtm://host:0", tmp_path / "out") == 2
    assert "expected an address qtm://HOST[:PORT]" in capsys.readouterr().err


def test_poses_of_a_recording_go_into_files(blobs, tmp_path, capsys):
    save_detections(blobs.of_snapshots(0, 5), tmp_path / "blobs.csv")
    table, lines_ = tmp_path / "poses.csv", tmp_path / "poses.jsonl"
    more = ("--rate", "60", "--poses", str(table), str(lines_), "igtl://0")
    assert watch(tmp_path / "blobs.csv", tmp_path / "out", *more) == 0
    rows = [row.split(",")[:5] for row in table.read_text().splitlines()]
    assert rows[0] == ["time", "snapshot", "status", "markers", "cameras"] and len(rows) == 6
    found = [json.loads(line) for line in lines_.read_text().splitlines()]
    assert [entry["time"] for entry in found] == [number / 60 for number in range(5)] == [float(r[0]) for r in rows[1:]]
    assert {entry["status"] for entry in found} == {"ok"} and "not written" not in capsys.readouterr().out
    more = ("--rate", "60", "--fresh", "--poses")
    for name, said in (("x.txt", "--poses: found 'x.txt', expected FILE.csv"), ("ftp://x", "--poses: found 'ftp://x'")):
        assert watch(tmp_path / "blobs.csv", tmp_path / "out", *more, name) == 2
        assert said in capsys.readouterr().err


def light_blobs(snapshots):
    """Four markers that move evenly through a room of ten cameras, blobs without labels; where they are (S, 4, 3)."""
    rig, wand = read_rig("room10"), load_object("wand4")
    start = simulate_volume(rig, wand, 1, torch.Generator().manual_seed(4), None)
    steps = torch.arange(snapshots)[:, None] * torch.tensor([8.0, 5.0, -3.0]).double()
    poses = RigidTransform(
        start.rig_from_object.rotation.expand(snapshots, 3, 3), start.rig_from_object.translation + steps
    )
    points = poses.apply(wand.points)
    image = rig.to(torch.float64).expand(snapshots).project(points)
    truth = true_detections(Truth(rig, poses, image.uv, image.visible))
    noise = 0.05 * np.random.default_rng(0).normal(size=truth.uv.shape)
    return replace(truth, uv=truth.uv + noise, sigma=np.full(len(truth), 0.05)), points.numpy()


@pytest.mark.parametrize("names", [("stick.csv",), ("stick.csv", "wand4")])
def test_sticks_and_several_objects_keep_a_rig_calibrated(tmp_path, capsys, monkeypatch, names):
    monkeypatch.chdir(tmp_path)
    blobs, _ = light_blobs(30)
    save_detections(replace(blobs, fiducial=np.full(len(blobs), -1)), "blobs.csv")
    Path("stick.csv").write_text("x,y,z\n0,0,0\n500,0,0\n")
    command = ["watch", "blobs.csv", "--rig", "room10", "--object", *names, "--out", "out"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert "30 snapshots" in said.out and "one by one" in said.err
    assert Path("out/events.jsonl").read_text() == ""


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
def test_lights_become_points_in_a_file(tmp_path, capsys, suffix):
    """The third is hidden for three snapshots, the second for a second, the last one comes later."""
    blobs, truth = light_blobs(120)
    second, third = (blobs.snapshot >= 20) & (blobs.snapshot < 80), (blobs.snapshot >= 40) & (blobs.snapshot < 43)
    gone = (
        (blobs.fiducial == 1) & second | (blobs.fiducial == 2) & third | (blobs.fiducial == 3) & (blobs.snapshot < 60)
    )
    kept = blobs.select(~gone)
    save_detections(replace(kept, fiducial=np.full(len(kept), -1)), tmp_path / "lights.csv")
    path, prior = tmp_path / f"trial{suffix}", RigPrior(2e-4, 0.3, 1e-4, 1e-4, 0.3)
    save_rig(replace(read_rig("room10"), prior=prior), tmp_path / "rig.yaml")  # as good as calibrated
    given = (
        str(tmp_path / "lights.csv"),
        "--rig",
        str(tmp_path / "rig.yaml"),
        "--object",
        "lights",
        "--out",
        str(tmp_path / "out"),
    )
    assert main(["watch", *given, "--rate", "60", "--poses", str(path)]) == 0
    assert "not written" not in capsys.readouterr().out
    rate, points = points_of(path)
    assert rate == 60.0 and points.shape == (120, 5, 3)
    there = np.full((120, 5, 3), np.nan)
    order = np.linalg.norm(points[0, :3, None] - truth[0, :3], axis=-1).argmin(1)  # which light has which column
    for column, light in enumerate(order):
        there[:, column] = truth[:, light]
    column = {light: column for column, light in enumerate(order)}
    there[20:, column[1]], there[40:43, column[2]] = np.nan, np.nan
    there[60:, 3], there[80:, 4] = truth[60:, 3], truth[80:, 1]  # back after a second: another light
    assert (np.isnan(points) == np.isnan(there)).all()
    seen = ~np.isnan(there)
    assert np.sqrt(np.square(points[seen] - there[seen]).mean()) < 0.3


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["poses.csv"], "--poses: found 'poses.csv' with lights, which has no pose, expected FILE.c3d or FILE.trc"),
        (["igtl://0"], "--poses: found 'igtl://0' with lights, which has no pose"),
        (["a.c3d", "a.c3d"], "--poses: found a.c3d twice"),
        (["a.c4d"], "--poses: found 'a.c4d', expected FILE.csv"),
        (["nowhere/a.c3d"], "--poses: nowhere/a.c3d: found no folder nowhere"),
        (["folder.c3d"], "--poses: folder.c3d: found a folder, expected a file"),
        (["old.c3d"], "old.c3d: already exists, expected a new file"),
    ],
)
def test_what_lights_cannot_be_written_to_is_one_line_and_leaves_nothing(tmp_path, capsys, monkeypatch, given, said):
    monkeypatch.chdir(tmp_path)
    blobs, _ = light_blobs(2)
    save_detections(blobs, "lights.csv")
    Path("folder.c3d").mkdir()
    Path("old.c3d").write_text("somebody's")
    before = sorted(Path().iterdir())
    command = ["watch", "lights.csv", "--rig", "room10", "--object", "lights", "--out", "out", "--poses", *given]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert sorted(Path().iterdir()) == before and Path("old.c3d").read_text() == "somebody's"


def test_a_wrong_output_beside_a_right_one_leaves_nothing(blobs, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_detections(blobs.of_snapshots(0, 2), "blobs.csv")
    assert watch("blobs.csv", "out", "--poses", "a.csv", "nowhere/b.csv") == 2
    assert "found no folder nowhere" in capsys.readouterr().err and [p.name for p in Path().iterdir()] == ["blobs.csv"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tcp://", "tcp://: expected tcp://HOST:PORT"),
        ("tcp://127.0.0.1:99999", "tcp://127.0.0.1:99999: expected tcp://HOST:PORT"),
        ("ipc:///nowhere/at/all", "ipc:///nowhere/at/all"),
        ("igtl://x:99999", "igtl://x:99999: expected igtl://[HOST:]PORT"),
        ("table.csv", "table.csv: found 'a,b', expected a new file or the columns of poses"),
        ("file/poses.c3d", "found no folder file"),
    ],
)
def test_an_output_of_poses_that_cannot_be_is_one_line(blobs, tmp_path, capsys, monkeypatch, name, said):
    monkeypatch.chdir(tmp_path)
    save_detections(blobs.of_snapshots(0, 2), "blobs.csv")
    Path("table.csv").write_text("a,b\n1,2\n")
    Path("file").write_text("no folder")
    before = {path.name: path.read_bytes() for path in Path().iterdir()}
    assert watch("blobs.csv", "out", "--poses", name, "poses.csv") == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "internal" not in error
    assert {path.name: path.read_bytes() for path in Path().iterdir()} == before


def test_a_folder_that_is_not_ours_to_write_to_is_told_before_anything_is_written(blobs, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_detections(blobs.of_snapshots(0, 2), "blobs.csv")
    Path("locked").mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked")
    for name in ("locked/poses.c3d", "locked/poses.csv"):
        assert watch("blobs.csv", "out", "--poses", name) == 2
        assert f"--poses: {name}: no permission to write to locked" in capsys.readouterr().err
    assert not Path("out").exists() and not list(Path("locked").iterdir())


def test_a_calibration_is_no_folder_to_watch_into(blobs, tmp_path, capsys):
    """Its rig.yaml would be lost, and with it the posterior that a running rig starts from."""
    result, table = tmp_path / "result", tmp_path / "blobs.csv"
    save_detections(blobs, table)
    begun = ["calibrate", str(table), "--snapshots", "0:20", "--rig", "T4", "--object", "asymmetric8", "--no-report"]
    assert main([*begun, "--out", str(result)]) == 0
    rig, before = result / "rig.yaml", sorted((path.name, path.read_bytes()) for path in result.iterdir())
    capsys.readouterr()
    common = ["watch", str(table), "--object", "asymmetric8", "--out", str(result)]
    assert main([*common, "--rig", str(rig)]) == 2
    assert capsys.readouterr().err == (f"imgcal: --out: {rig} is also the input of --rig, expected another folder\n")
    assert main([*common, "--rig", "T4"]) == 2
    assert (
        capsys.readouterr().err
        == f"imgcal: --out: {result} holds a calibration (result.json), expected another folder\n"
    )
    assert sorted((path.name, path.read_bytes()) for path in result.iterdir()) == before
    out = tmp_path / "out"
    assert main([*common[:-1], str(out), "--rig", str(rig)]) == 0
    capsys.readouterr()
    assert main([*begun, "--out", str(out)]) == 2
    assert "belongs to imgcal watch (state.json), expected another folder" in capsys.readouterr().err

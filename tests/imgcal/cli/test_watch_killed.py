"""A recording is watched, the process killed in the midst, the same command given again: nothing is lost or doubled."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from imgcal.cli.main import main
from imgcal.io import read_rig, save_rig
from imgcal.watch import Progress
from tests.imgcal.streams import Stream

SNAPSHOTS, BUMPED_AT = 48, 20
EXACT = 1e-11
"""The libraries round by the place of an array in memory; one snapshot more or less changes 1e-6 and more."""
CLOSE = 1e-8
"""The same for the figures of events, whose covariances are differences of large numbers."""

WATCHES = """
import json, os, signal, subprocess, sys
from imgcal.cli import watch  # once, for all processes that are forked here
from imgcal.cli.main import run
from imgcal.io import atomic
from imgcal.watch import event_log, loop, rig_files

def passed():
    left[0] -= 1
    if not left[0]:
        os.kill(os.getpid(), signal.SIGKILL)

def before(owner, name, counts):
    whole = getattr(owner, name)
    def dying(*given, **named):
        if counts(*given):
            passed()
        return whole(*given, **named)
    setattr(owner, name, dying)

def after(owner, name, counts):
    whole = getattr(owner, name)
    def dying(*given, **named):
        result = whole(*given, **named)
        if counts(*given):
            passed()
        return result
    setattr(owner, name, dying)

def die_at(moment):
    loop.SAVED_EVERY = 0.0
    if moment == "learnt":  # the state of a while ago is what is there
        loop.SAVED_EVERY = 0.3
        after(loop.Watch, "process", lambda self, snapshot: True)
    elif moment == "told":
        after(event_log.EventLog, "_append", lambda self, line: b'"moved"' in line)
    elif moment == "saving":  # the new state is written beside the old one, and has not taken its place
        # Each save is written before the next snapshot: the thread leaves out those that it has no time for.
        rig_files.RigFiles.write = lambda self, state, *, keep=False, also=None, then=None: self._write(
            also, then, state, [state] if keep else []
        )
        before(atomic.os, "replace", lambda source, target: str(target).endswith("state.json"))

for line in sys.stdin:
    job = json.loads(line)
    child = os.fork()
    if not child:
        written = os.open(job["said"], os.O_WRONLY | os.O_CREAT)
        os.dup2(written, 1)
        os.dup2(written, 2)
        if job["piped"]:
            given = subprocess.Popen(["cat", job["stdin"]], stdout=subprocess.PIPE).stdout.fileno()
        else:
            given = os.open(job["stdin"], os.O_RDONLY)
        os.dup2(given, 0)
        sys.stdin = open(0)
        if job["killed"]:
            moment, number = job["killed"].split(":")
            left = [int(number)]
            die_at(moment)
        sys.argv[1:] = job["arguments"]
        run()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def watches() -> Iterator[subprocess.Popen[str]]:
    """A process that has imported the command, and forks a process for each job."""
    with subprocess.Popen(
        [sys.executable, "-c", WATCHES], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
    ) as process:  # fmt: skip
        yield process
        process.stdin.close()


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    """Lines of JSON of all snapshots; the second camera is turned by 0.3 degrees on the way."""
    stream = Stream("T4", "asymmetric8", SNAPSHOTS, seed=3)
    bumped = stream.bumped([1], turn_deg=0.3)
    path = tmp_path_factory.mktemp("blobs") / "blobs.ndjson"
    with open(path, "w") as file:
        for s in range(SNAPSHOTS):
            found, _ = stream.blobs(s, bumped if s >= BUMPED_AT else stream.true)
            for camera, name in enumerate(stream.rig.camera_names):
                uv = found.uv[found.camera == camera].tolist()
                line = {"camera": name, "time": 1e9 + s / 60, "uv": uv, "sigma": 0.07}
                file.write(json.dumps(line) + "\n")
    return "-", path, ("--rig", "T4", "--object", "asymmetric8")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Frames of a capture in a folder, whose time stamps are those of the files."""
    folder = tmp_path_factory.mktemp("frames")
    save_rig(read_rig("T4").resized(torch.tensor([512, 272])), folder / "rig.yaml")
    known = ["--rig", str(folder / "rig.yaml"), "--object", "asymmetric8"]
    made = [*known, "--out", str(folder / "capture"), "--snapshots", "8", "--kappa", "0.002", "--no-clutter"]
    assert main(["simulate", *made]) == 0
    for path in (folder / "capture" / "frames").glob("*/*"):
        os.utime(path, (1e9 + int(path.stem) / 5,) * 2)
    return str(folder / "capture"), None, [*known, "--until-idle", "0.5"]


@pytest.fixture
def watch(watches, tmp_path):
    """Return a function that runs the command in a process of its own."""

    def run(given, out, *, killed=None, piped=False):
        source, stdin, options = given
        job = {
            "arguments": ["watch", source, *options, "--out", str(out), *(["--keep-all"] if piped else [])],
            "stdin": os.devnull if stdin is None else str(stdin),
            "piped": piped,
            "killed": killed,
            "said": str(tmp_path / f"said{len(list(tmp_path.glob('said*')))}.txt"),
        }
        watches.stdin.write(json.dumps(job) + "\n")
        watches.stdin.flush()
        code, said = int(watches.stdout.readline()), Path(job["said"]).read_text()
        assert code == (0 if killed is None else -signal.SIGKILL), said
        return said

    return run


def events(out):
    told = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    return [event for event in told if "resumed" not in event["message"]]


def assert_same(out, whole, snapshots):
    state = json.loads((out / "state.json").read_text())
    assert int(state["snapshot"]) == snapshots - 1
    for event, expected in zip(events(out), events(whole), strict=True):
        numbers = {name: pytest.approx(v, rel=CLOSE) for name, v in expected.items() if isinstance(v, float)}
        assert event == expected | numbers
    found, expected = read_rig(str(out / "rig.yaml")), read_rig(str(whole / "rig.yaml"))
    for name in ("focal_length", "principal_point", "distortion"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=EXACT, atol=EXACT)
    for name in ("rotation", "translation"):
        pose, other = found.cam_from_rig, expected.cam_from_rig
        torch.testing.assert_close(getattr(pose, name), getattr(other, name), rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("piped", [False, True], ids=["file", "pipe"])
def test_blobs_in_lines(watch, blobs, piped, tmp_path):
    watch(blobs, tmp_path / "whole", piped=piped)
    assert {event["camera"] for event in events(tmp_path / "whole") if event["event"] == "moved"} == {"cam02"}
    out, table = tmp_path / "out", tmp_path / "poses.csv"
    blobs = (*blobs[:2], (*blobs[2], "--poses", str(table)))
    for moment in ("learnt:7", "told:1", "saving:2"):
        watch(blobs, out, killed=moment, piped=piped)
    assert Progress.load(out).time < 1e9 + (SNAPSHOTS - 2) / 60
    assert f"{SNAPSHOTS} snapshots" not in watch(blobs, out, piped=piped)  # it went on
    assert_same(out, tmp_path / "whole", SNAPSHOTS)
    numbers = [int(row.split(",")[1]) for row in table.read_text().splitlines()[1:]]
    assert numbers == sorted(set(numbers)) and numbers[-1] == SNAPSHOTS - 1  # no row twice


def test_frames_in_a_folder(watch, frames, tmp_path):
    watch(frames, tmp_path / "whole")
    for moment in ("learnt:3", "saving:2"):
        watch(frames, tmp_path / "out", killed=moment)
    watch(frames, tmp_path / "out")
    assert_same(tmp_path / "out", tmp_path / "whole", 8)
    assert "all 8 snapshots" in watch(frames, tmp_path / "out")
    moved = shutil.copytree(frames[0], tmp_path / "moved")
    assert "all 8 snapshots" in watch((str(moved), *frames[1:]), tmp_path / "out")

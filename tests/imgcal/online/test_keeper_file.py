"""A keeper resumes exactly from its file; modified files are refused in one line."""

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import InputError
from imgcal.online import RigKeeper, RigState
from imgcal.types import Board, CalibrationObject, CameraRig, ConvexVolume, DriftRate, RigPrior
from scripts.benchmarks.rig_streams import Bump, Stream

CHILD = """
import sys
import imgcal
from scripts.benchmarks.rig_streams import Stream
made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 3)
with imgcal.RigKeeper(made.factory, made.obj) as keeper:
    for time, blobs in made.snapshots(10**6):
        keeper.update(blobs, time)
        if keeper.belief is not None and round(time * 60) % 3 == 2:
            keeper.save(sys.argv[1])
            print(round(time * 60), flush=True)
"""


def stream() -> Stream:
    bumps = [Bump(11, 1, "rotation", math.radians(0.5))]
    return Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 3, bumps=bumps, absent=[(14, 15)])


def alike(first: RigState, second: RigState) -> bool:
    beliefs = first.belief, second.belief
    return (
        first.sentence == second.sentence
        and first.cameras == second.cameras
        and first.refused == second.refused
        and first.events == second.events
        and all(torch.equal(getattr(*pair), getattr(beliefs[1], pair[1])) for pair in [(beliefs[0], "factor")])
        and torch.equal(beliefs[0].rig.focal_length, beliefs[1].rig.focal_length)
        and torch.equal(beliefs[0].rig.cam_from_rig.rotation, beliefs[1].rig.cam_from_rig.rotation)
        and np.array_equal(first.residual, second.residual, equal_nan=True)
        and np.array_equal(first.clock_offset, second.clock_offset, equal_nan=True)
    )


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory):
    """States of a rig, and the file that was saved while a camera was being learnt again."""
    made, path, states = stream(), tmp_path_factory.mktemp("keeper") / "state.json", []
    with RigKeeper(made.factory, made.obj) as keeper:
        for number, (seconds, blobs) in enumerate(made.snapshots(22)):
            states.append((seconds, blobs, keeper.update(blobs, seconds)))
            if number == 15:
                keeper.save(path)
    return path, states


def test_the_same_snapshots_give_the_same_states(saved, tmp_path: Path) -> None:
    path, states = saved
    assert states[15][2].cameras["cam02"] == "relearning"
    with RigKeeper.restore(path) as keeper:
        for seconds, blobs, state in states[16:]:
            assert alike(keeper.update(blobs, seconds), state)
        keeper.save(tmp_path / "again.json")
    assert [path.name for path in tmp_path.iterdir()] == ["again.json"]


def test_what_a_rig_file_may_hold_beside_its_cameras_is_gone_on_with(tmp_path: Path) -> None:
    made = stream()
    volume = ConvexVolume.box((-100.0, -100.0, 700.0), (100.0, 100.0, 900.0))
    rig = replace(made.factory, volume=volume, prior=RigPrior(position=3.0), drift_rate=DriftRate(position=0.1))
    with RigKeeper(rig, made.obj) as keeper:
        for seconds, blobs in made.snapshots(3):
            keeper.update(blobs, seconds)
        keeper.save(tmp_path / "state.json")
    with RigKeeper.restore(tmp_path / "state.json") as keeper:
        assert keeper.given.volume == volume == keeper.factory.volume
        assert (keeper.given.prior, keeper.given.drift_rate) == (rig.prior, rig.drift_rate)
    corners = [[x, y, 700.0] for x in (-100.0, 100.0) for y in (-100.0, 100.0)]
    change_state(tmp_path / "state.json", lambda state: state["memory"]["prior"]["volume"].update(points=corners))
    with pytest.raises(InputError, match="points that all lie in"):
        RigKeeper.restore(tmp_path / "state.json")


def test_people_can_read_it(saved) -> None:
    content = json.loads(saved[0].read_text())
    assert content["format"] == "imgcal-keeper/10"
    assert content["sentence"].startswith("cam02 moved")
    assert content["snapshot"] == "00015"
    assert content["cameras"]["cam01"] == "ok"
    assert content["rig"][0] == "format: imgcal-rig/1"
    assert saved[0].read_text().index('"state"') < 20_000


MUTATIONS = {
    "no memory": lambda state: state.pop("memory"),
    "no state of a test": lambda state: state["tests"].update(clock={}),
    "no labelling": lambda state: state["labelling"].clear(),
    "another value": lambda state: state["memory"].update(factory=7),
    "one value more": lambda state: state["memory"]["monitor"]["filter"].update(system="rm"),
    "one value less": lambda state: state["memory"]["monitor"]["recent"].pop("border"),
    "a kind of object that there is not": lambda state: state["memory"]["obj"].update(kind="subprocess:Popen"),
    "an array that there is not": lambda state: state["memory"]["looks"].update(array=10**6),
    "a negative array": lambda state: state["memory"]["looks"].update(array=-1),
    "another array": lambda state: state["memory"]["looks"].update(state["memory"]["monitor"]["recent"]["carried"]),
    "a belief that there is not": lambda state: state["memory"]["before"].update(belief=10**6),
    "a number that is text": lambda state: state["memory"].update(count="3"),
    "a queue without end": lambda state: state["memory"]["usual"].update(most=None),
    "a long queue": lambda state: state["memory"]["monitor"]["recent"]["seen"].update(most=2**40),
    "no tables": lambda state: state.update(arrays=3),
    "an array of another size": lambda state: state["arrays"][0][1].append(2),
    "an array of another type": lambda state: state["arrays"][0].__setitem__(0, "object"),
    "an array that is no base64": lambda state: state["arrays"][0].__setitem__(2, "?"),
    "no positive information": lambda state: state["beliefs"][0]["factor"].update(state["beliefs"][0]["object_offset"]),
}


def change_state(path: Path, change: Callable[[dict], object], sign: bool = True) -> Path:
    """Change the state in a file, as somebody would who knows how it is signed."""
    content = json.loads(path.read_text())
    change(content["state"])
    if sign:
        content["sha256"] = hashlib.sha256(json.dumps(content["state"]).encode()).hexdigest()
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("sign", [True, False])
@pytest.mark.parametrize("change", MUTATIONS)
def test_files_that_were_changed_are_refused_in_one_line(saved, tmp_path: Path, change: str, sign: bool) -> None:
    path = tmp_path / "state.json"
    path.write_text(saved[0].read_text())
    change_state(path, MUTATIONS[change], sign)
    with pytest.raises(InputError) as told:
        RigKeeper.restore(path)
    assert str(told.value).startswith(str(path))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(("version", "age"), [(1, "earlier"), (9, "earlier"), (11, "later")])
def test_the_state_of_another_version_is_refused_with_what_can_be_done(saved, tmp_path, version, age) -> None:
    path, content = tmp_path / "state.json", json.loads(saved[0].read_text())
    content["format"] = f"imgcal-keeper/{version}"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"state files from {age} versions cannot be resumed") as told:
        RigKeeper.restore(path)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "imgcal-rig/1"}', "[" * 100_000, "\xff\x00"])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"state\.json"):
        RigKeeper.restore(path)
    with pytest.raises(InputError, match="no such file"):
        RigKeeper.restore(tmp_path / "nothing.json")


def test_a_single_digit_that_was_changed_is_noticed(saved, tmp_path: Path) -> None:
    content = saved[0].read_text()
    begin = content.index('"state"')
    digits = [place for place in range(begin, len(content)) if content[place] in "12345678"]
    for place in np.random.default_rng(1).choice(digits, 6, replace=False):
        path = tmp_path / "state.json"
        path.write_text(f"{content[:place]}9{content[place + 1 :]}")
        with pytest.raises(InputError, match="changed since it was written"):
            RigKeeper.restore(path)


def test_a_process_that_is_killed_leaves_a_file_to_go_on_from(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    reached = [int(child.stdout.readline()) for _ in range(2)]
    time.sleep(0.05)
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 3)
    with RigKeeper.restore(path) as keeper:
        count = keeper.saved().snapshot + 1
        assert count > reached[-1]
        shots = list(made.snapshots(count + 2))
        for seconds, blobs in shots[count:]:
            state = keeper.update(blobs, seconds)
    with RigKeeper(made.factory, made.obj) as steady:
        for seconds, blobs in shots:
            expected = steady.update(blobs, seconds)
    # Within one process the same bits, see above; two that compile at the same time may differ in the last.
    assert (state.sentence, state.cameras, state.refused) == (expected.sentence, expected.cameras, expected.refused)
    scale = float(expected.belief.factor.abs().max())
    torch.testing.assert_close(state.belief.factor, expected.belief.factor, rtol=0, atol=1e-9 * scale)
    torch.testing.assert_close(state.belief.rig.focal_length, expected.belief.rig.focal_length, rtol=1e-9, atol=0)


def rational(rig: CameraRig) -> CameraRig:
    """The same rig with lenses of eight coefficients."""
    zeros = rig.distortion.new_zeros(rig.num_cameras, 3)
    return replace(rig, distortion=torch.cat((rig.distortion, zeros), dim=-1), lens_model="rational")


def of_kind(kind: str) -> Stream:
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    if kind == "tolerances":
        obj = replace(obj, tolerance=torch.full((8,), 0.05, dtype=torch.float64), scale_tolerance=1e-3)
    if kind == "board":
        obj = CalibrationObject.of_board(Board("charuco", 6, 6, 40.0, 30.0, "DICT_4X4_50"))
    return Stream(rational(rig) if kind == "rational" else rig, obj, 5)


@pytest.mark.parametrize("kind", ["tolerances", "rational", "bent", "board"])
def test_every_kind_of_rig_and_object_goes_on_from_its_file(kind: str, tmp_path: Path) -> None:
    made, path = of_kind(kind), tmp_path / "state.json"
    bent = made.obj.points.clone()
    bent[2] += torch.tensor([0.6, -0.5, 0.6])
    saved_at, shots, told = 12, [], []
    with RigKeeper(made.factory, made.obj) as keeper:
        for number in range(160):
            if kind == "bent" and number == 36:
                made.obj = replace(made.obj, points=bent)
            blobs = made.snapshot(number)
            state = keeper.update(blobs, number / 60)
            told += [event.kind for event in state.events]
            if kind == "bent" and number < saved_at + 4 and "object_bent" not in told:
                saved_at = number + 2
            if number == saved_at:
                keeper.save(path)
            if number > saved_at:
                shots.append((number, blobs, state))
            if number == saved_at + 4:
                break
    assert state.refused is None and all(health == "ok" for health in state.cameras.values())
    assert float(np.nanmax(state.residual)) < 0.5
    assert told == (["object_bent"] if kind == "bent" else [])
    assert state.rig.num_parameters == (18 if kind == "rational" else 15)
    if kind == "bent":
        off = state.belief.points_object - bent
        assert float((off - off.mean(0)).norm(dim=-1).max()) < 0.5
    with RigKeeper.restore(path) as keeper:
        for number, blobs, before in shots:
            assert alike(keeper.update(blobs, number / 60), before)

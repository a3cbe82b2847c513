"""Which functions are compiled ahead of time, and for which rigs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from imgcal.io import data_path
from imgcal.online import warm_up
from imgcal.online.warmup import replace_lenses
from imgcal.types import CameraRig
from tests.imgcal.compile_listener import LISTEN

ROOT = Path(__file__).parents[3]


def test_other_lenses_are_warmed_up_where_that_is_asked_for(monkeypatch: pytest.MonkeyPatch, o10: CameraRig) -> None:
    warmed: list[CameraRig] = []
    monkeypatch.setattr("imgcal.online.warmup._warm_up", warmed.append)
    warm_up()
    warm_up(all_lenses=True)
    assert [rig.lens_model for rig in warmed] == ["brown_conrady", "rational", "brown_conrady"]
    points = torch.tensor([[10.0, 20.0, 860.0]], dtype=torch.float64)
    images = [rig.project(points).uv for rig in (o10, replace_lenses(o10))]
    torch.testing.assert_close(*images)  # the same lens in other words


WATCHED = (
    LISTEN
    + """
import inspect, json, sys
from numba.core.dispatcher import Dispatcher

{work}

def called(function):
    "Compiled functions that a function names."
    names = function.__code__.co_names
    values = [function.__globals__.get(name) for name in names]
    values += [cell.cell_contents for cell in function.__closure__ or ()]
    values += [getattr(value, name, None) for value in values if inspect.ismodule(value) for name in names]
    values += [part for value in values if isinstance(value, tuple) for part in value]
    return {{value for value in values if isinstance(value, Dispatcher)}}

ours = {{
    value: f"{{value.py_func.__module__}}.{{value.py_func.__qualname__}}"
    for name, module in list(sys.modules.items())
    if name.startswith(("imgcal", "renderers"))
    for value in vars(module).values()
    if isinstance(value, Dispatcher)
}}
used = {{value for value in ours if value.overloads}}
reached, new = set(used), used
while new:
    new = set().union(*(called(value.py_func) for value in new)) - reached
    reached |= new
print(json.dumps({{
    "compiled": Compiled.names,
    "used": [f"{{name}}{{types}}" for value, name in ours.items() for types in value.overloads],
    "left": [value.py_func.__qualname__ for value in ours
             if value not in reached and value.targetoptions.get("inline") != "always"],
}}))
"""
)
COMMANDS = """
from imgcal import RigKeeper, load_object, load_rig
from imgcal.io import open_capture

sample, *networks = sys.argv[1:]
given = ["--rig", sample + "/rig.yaml", "--object", sample + "/object.csv"]
for guess in ("none", *networks):
    assert main(["calibrate", sample, *given, "--out", "result", "--first-guess", guess]) == 0
assert main(["detect", sample, "--out", "blobs.csv"]) == 0
assert main(["score", "blobs.csv", *given]) == 0
assert main(["render", sample, *given, "--out", "coded"]) == 0
deep = ["--sensor.bit-depth", "12", "--sensor.polarity", "dark", "--kappa", "0.005"]
cube = ["--rig", "O6", "--object", "cube8"]
assert main(["simulate", *cube, "--out", "deep", "--snapshots", "2", *deep]) == 0
assert main(["calibrate", "deep", *cube, "--out", "cube", "--polarity", "dark"]) == 0
rig, obj = load_rig(given[1]), load_object(given[3])
with RigKeeper(rig, obj, horizon=2) as keeper:
    for number, (_, frames) in enumerate(open_capture(sample, rig).snapshots()):
        keeper.update(frames, number / 60)
"""
NETWORKS = [ROOT / "data" / "models" / f"{name}-O10-asymmetric8.safetensors" for name in ("points", "vit")]
OF_A_LENS = "<locals>"  # called through numba's overloads, which a function does not name
UNUSED = {"_gradients", "_through_profile"}  # training


def run_watched(folder: Path, work: str, *arguments: object) -> dict[str, list[str]]:
    """What a process compiles, which compiled functions it calls and for which types, and which it cannot reach."""
    command = [sys.executable, "-c", WATCHED.format(work=work), *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, list[str]] = json.loads(done.stdout.splitlines()[-1])
    return found


def compiled_twice(signatures: list[str]) -> list[str]:
    """Signatures that differ from another in nothing but literals or the order of an array's axes in memory."""
    seen, twice = set[str](), []
    for signature in signatures:
        plain = re.sub(r"Literal\[int\]\(-?\d+\)|uint64", "int64", signature)
        plain = re.sub(r"Literal\[bool\]\(\w+\)", "bool", re.sub(r"'[AF]', (False|True)", "'C', False", plain))
        if plain in seen:
            twice.append(signature)
        seen.add(plain)
    return twice


@pytest.mark.slow
def test_commands_call_nothing_else_than_is_compiled_ahead(tmp_path: Path) -> None:
    """The two processes share the compiled code of all tests: what was compiled before counts as called only."""
    warm = run_watched(tmp_path, 'assert main(["warmup"]) == 0')
    used = run_watched(tmp_path, COMMANDS, data_path("samples", "O10"), *NETWORKS)
    assert not set(used["used"]) - set(warm["used"])
    assert not used["compiled"]
    assert {name for name in warm["left"] if OF_A_LENS not in name} == UNUSED
    assert not compiled_twice(used["used"])

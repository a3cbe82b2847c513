"""One process compiles everything ahead of time, and another then compiles nothing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from imgcal.online.warmup import replace_lenses, warm_up
from imgcal.types import CameraRig

COUNT = """
import json, sys
from numba.core import event
from numba.core.dispatcher import Dispatcher

class Compiled(event.Listener):
    names = []
    def on_start(self, happening):
        self.names.append(happening.data["dispatcher"].py_func.__qualname__)
    def on_end(self, happening):
        pass

event.register("numba:compile", Compiled())
"""

WARM = """
from imgcal.cli.main import main
assert main(["warmup"]) == 0
ours = [
    value
    for name, module in list(sys.modules.items())
    if name.startswith(("imgcal", "renderers"))
    for value in vars(module).values()
    if isinstance(value, Dispatcher) and value.targetoptions.get("inline") != "always"  # compiled where it is used
]
print(json.dumps(sorted({f.py_func.__qualname__ for f in ours if not f.nopython_signatures})))
"""

USE = """
from imgcal import RigKeeper, load_detections, load_object, load_rig
from imgcal.cli.main import main
from imgcal.io import open_capture

sample, out = sys.argv[1:]
given = ["--rig", sample + "/rig.yaml", "--object", sample + "/object.csv"]
for guess in ("none", "points", "vit"):
    assert main(["calibrate", sample, *given, "--out", out + "/result", "--first-guess", guess]) == 0
assert main(["detect", sample, "--out", out + "/blobs.csv"]) == 0
assert main(["score", out + "/blobs.csv", *given]) == 0
assert main(["render", sample, *given, "--out", out + "/coded"]) == 0
deep = ["--sensor.bit-depth", "12", "--sensor.polarity", "dark", "--kappa", "0.005"]
cube = ["--rig", "O6", "--object", "cube8"]
assert main(["simulate", *cube, "--out", out + "/deep", "--snapshots", "2", *deep]) == 0
assert main(["calibrate", out + "/deep", *cube, "--out", out + "/cube", "--polarity", "dark"]) == 0
rig, obj = load_rig(given[1]), load_object(given[3])
with RigKeeper(rig, obj, horizon=2) as keeper:
    for number, (_, frames) in enumerate(open_capture(sample, rig).snapshots()):
        keeper.update(frames, number / 60)
print(json.dumps(Compiled.names))
"""

UNUSED = {"_minimize_all", "_pair", "_gradients", "_through_profile"}  # many rigs at once, and training
OTHER_LENSES = "_chosen.<locals>"  # compiled where a rig has one


def test_other_lenses_are_warmed_up_where_that_is_asked_for(monkeypatch: pytest.MonkeyPatch, o10: CameraRig) -> None:
    warmed: list[CameraRig] = []
    monkeypatch.setattr("imgcal.online.warmup._warm_up", warmed.append)
    warm_up()
    warm_up(all_lenses=True)
    assert [rig.lens_model for rig in warmed] == ["brown_conrady", "brown_conrady", "rational"]
    points = torch.tensor([[10.0, 20.0, 860.0]], dtype=torch.float64)
    images = [rig.project(points).uv for rig in (o10, replace_lenses(o10))]
    torch.testing.assert_close(*images)  # the same lens in other words


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("compiled")


def run(script: str, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)}
    command = [sys.executable, "-c", COUNT + script, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done


def test_all_is_compiled_ahead_and_nothing_later(compiled: Path, tmp_path: Path) -> None:
    first = run(WARM, compiled)
    left = {name for name in json.loads(first.stdout.splitlines()[-1]) if not name.startswith(OTHER_LENSES)}
    assert left == UNUSED
    assert first.stderr.splitlines()[0] == "imgcal: compiling, which takes a while"
    assert "functions compiled in" in first.stderr and f"kept in {compiled}" in first.stderr
    second = run(USE, compiled, "data/samples/O10", str(tmp_path))
    assert json.loads(second.stdout.splitlines()[-1]) == []
    assert "compiling" not in second.stderr

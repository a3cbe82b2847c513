"""The campaign with a bounded budget; `python -m scripts.fuzz` is the long one."""

import json
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from imgcal.cli.compiling import WAIT
from scripts.fuzz import cases, verdict
from scripts.fuzz.__main__ import MOST_MEMORY
from scripts.fuzz.cases import Case, case, prepare
from scripts.fuzz.verdict import run

SEED, COUNT = 9, 50
SLOW = ("experiment", "setting")  # they train, which the tests of training do


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz") / "sound"
    prepare(folder)
    return folder


def test_damaged_input_ends_in_one_line(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in SLOW:
        monkeypatch.delitem(cases.KINDS, kind)
    faults = []
    for number in range(COUNT):
        shutil.rmtree(tmp_path / "case", ignore_errors=True)
        made = case(sound, tmp_path / "case", SEED, number)
        if fault := run(made):
            faults.append(f"case {number}: {made.damage} {made.arguments[0]}: {fault}")
    assert not faults, "\n".join(faults)


def test_a_case_is_the_same_again(sound: Path, tmp_path: Path) -> None:
    for number in range(30):
        twice = [case(sound, tmp_path / f"{number} {again}", 3, number) for again in (0, 1)]
        contents = [sorted((p.name, p.read_bytes()) for p in made.folder.rglob("*") if p.is_file()) for made in twice]
        assert contents[0] == contents[1]
        assert twice[0].damage == twice[1].damage


def fails(error: Exception):
    def command(arguments: list[str]) -> int:
        raise error

    return command


def says(code: int, *lines: str, written: str = ""):
    def command(arguments: list[str]) -> int:
        for line in lines:
            print(line, file=sys.stderr)
        if written:
            Path(written).parent.mkdir(parents=True, exist_ok=True)
            Path(written).write_text("{}")
        return code

    return command


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        (fails(ZeroDivisionError("x")), "ZeroDivisionError"),
        (says(1, "imgcal: x"), "exit code 1"),
        (says(2), "0 lines"),
        (says(2, "imgcal: x", "imgcal: y"), "2 lines"),
        (says(2, "imgcal: x", "y"), "not the last"),
        (says(2, "imgcal: " + "x" * 5000), "too long"),
        (says(2, "Traceback", "imgcal: x"), "noise"),
        (says(2, "imgcal: internal error: x"), "noise"),
        (says(2, "libpng error: x", "imgcal: x"), "noise"),
        (says(0, "imgcal: x"), "1 lines"),
        (says(0), "cannot be read"),
        (says(0, f"imgcal: {WAIT}"), "cannot be read"),  # a notice
        (says(2, "imgcal: x", written="beside"), "left behind"),
        (says(2, "imgcal: x", written="out/result.json"), "but written"),
        (says(3, "imgcal: x", written="out/result.json"), "status"),
    ],
)
def test_faults_are_seen(command, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verdict, "main", command)
    monkeypatch.chdir(tmp_path)
    if "status" in fault:
        monkeypatch.setattr(json, "loads", lambda *_, **__: {"status": "ok"})
    found = run(Case(tmp_path, ["calibrate", "x", "--out", str(tmp_path / "out")], "none"))
    assert fault in found


BOMBS = """
import gzip, struct, sys, time
from pathlib import Path
from scripts.fuzz.cases import Case
from scripts.fuzz.verdict import run

folder, sound = Path(sys.argv[1]), Path(sys.argv[2])
rig, obj = str(sound / "rig.yaml"), str(sound / "object.csv")
levels = "\\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))
maps = "\\n".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12))
model = (sound / "model.safetensors").read_bytes()
texts = {
    "brackets.yaml": "[" * 100_000,
    "aliases.yaml": "a0: &a0 [x]\\n" + levels,
    "merges.yaml": "a0: &a0 {x: 1}\\n" + maps,
    "cameras.yaml": "prior: &c {name: x}\\nformat: imgcal-rig/1\\ncameras:\\n" + "- *c\\n" * 200_000,
}
for name, text in texts.items():
    (folder / name).write_text(text)
header = gzip.compress(b"snapshot,camera,u,v\\n")
(folder / "rows.csv.gz").write_bytes(header + gzip.compress(b"0,cam01,1.5,2.5\\n" * 1_000_000, 1) * 30)
(folder / "blank.csv.gz").write_bytes(header + gzip.compress(b"\\n" * 10_000_000, 1) * 50)
(folder / "line.csv.gz").write_bytes(header + gzip.compress(b"1" * 10_000_000, 1) * 50)
(folder / "deep.safetensors").write_bytes(model.replace(b'\\\\"steps\\\\": 1,', b'\\\\"steps\\\\": ' + b"[" * 5 + b","))
(folder / "wide.safetensors").write_bytes(model.replace(b'\\\\"width\\\\": 16,', b'\\\\"width\\\\": 10000000,'))
worst = []
commands = [["score", obj, "--rig", str(folder / name), "--object", obj] for name in texts]
tables = ("rows.csv.gz", "blank.csv.gz", "line.csv.gz")
commands += [["score", str(folder / name), "--rig", rig, "--object", obj] for name in tables]
commands += [["evaluate", str(folder / name), "--count", "1"] for name in ("deep.safetensors", "wide.safetensors")]
for command in commands:
    began = time.monotonic()
    fault = run(Case(folder, command, ""))
    print(command[1], command[3], fault, f"{time.monotonic() - began:.1f} s", flush=True)
    assert not fault, fault
# Not resource.getrusage: its maximum is also that of the process which this one was forked from.
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(status["VmHWM"].split()[0])
"""


def test_bombs_do_not_go_off(sound: Path, tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY, MOST_MEMORY))

    done = subprocess.run(
        [sys.executable, "-c", BOMBS, str(tmp_path), str(sound)],
        capture_output=True, text=True, timeout=300, preexec_fn=limit, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert int(done.stdout.split()[-1]) < 1_500_000  # kB

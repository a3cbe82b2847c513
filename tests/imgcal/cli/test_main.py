import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import imgcal
from imgcal.cli import main as module
from imgcal.cli.main import main
from imgcal.errors import InputError


def one_line(capsys):
    output = capsys.readouterr()
    assert "Traceback" not in output.err
    (line,) = output.err.splitlines()
    return line


def failing(error):
    class Failing:
        def run(self):
            raise error

    return lambda arguments, stack: Failing()


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (ZeroDivisionError("division by zero"), "internal error (test_main.py:"),
        (AssertionError(), "internal error"),
        (RecursionError("too deep"), "too deep"),
        (MemoryError(), "not enough memory"),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates not allowed"), "surrogates"),
        (ValueError("x" * 100_000 + "\n" * 10), "..."),
        (InputError("a.csv: found \x1b[31m\nred\udcff"), "\\x1b[31m red\\udcff"),
        (OSError(28, "No space left on device", "a.csv"), "a.csv"),
    ],
)
def test_whatever_is_left_is_one_line(error, expected, monkeypatch, capsys):
    monkeypatch.setattr(module, "parse", failing(error))
    assert main(["score"]) == 2
    line = one_line(capsys)
    assert line.startswith("imgcal: ") and expected in line and len(line) < 1100


def test_debug_shows_the_traceback_before_the_line(monkeypatch, capsys):
    monkeypatch.setattr(module, "parse", failing(ZeroDivisionError("nothing to divide by")))
    assert main(["--debug", "score"]) == 2
    error = capsys.readouterr().err
    assert "Traceback" in error and "ZeroDivisionError" in error.splitlines()[-1]


def test_debug_may_stand_anywhere_and_is_no_argument_of_the_command(tmp_path, capsys):
    assert main(["score", "--debug", str(tmp_path / "absent"), "--rig", "O10", "--object", "cube8"]) == 2
    assert "no such file or folder" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "no command given, expected one of simulate, rig, "),
        (["score", "a\0b", "--rig", "O10", "--object", "cube8"], "zero byte"),
        (["score", "y" * 5000, "--rig", "O10", "--object", "cube8"], "y...: File name too long"),
        (["frobnicate"], "frobnicate"),
        (["simulate"], "--rig"),
        (["simulate", "--rig"], "--rig"),
        (["simulate", "--rig", "O10", "--objekt", "cube8", "--out", "x"], "--objekt"),
        (["simulate", "--rig", "O10", "--object", "cube8", "--out", "x", "--snapshots", "many"], "found many"),
        (
            ["simulate", "--rig", "O10", "--object", "cube8", "--out", "x", "--sensor.bit-depth", "9"],
            "found 9, expected 8, 12 or 16",
        ),
        (["simulate", "--rig", "O10", "--object", "cube8", "--out", "x", "--sensor.blur", "-1"], "blur"),
    ],
)
def test_a_command_line_that_cannot_be_read_is_one_line(arguments, expected, capsys):
    assert main(arguments) == 2
    line = one_line(capsys)
    assert line.startswith("imgcal: ") and expected in line and ("--help" in line or "score" in arguments)
    assert len(line) < 600 and not set(line) & set("│╭╰─") and "dummy" not in line


def test_the_version_is_that_of_the_package(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"imgcal {imgcal.__version__}\n"


def test_help_is_no_failure(capsys):
    assert main(["--help"]) == 0
    assert "--debug" in capsys.readouterr().out


SLOW = [
    ("tyro", ["--help"]),
    ("pydantic", ["score", "--help"]),
    ("torch", ["score", "blobs.csv", "--rig", "T4", "--object", "cube8"]),
]


@pytest.mark.parametrize(("slow", "arguments"), SLOW)
def test_an_interruption_during_start_up_is_one_line(slow, arguments, tmp_path):
    # The module sleeps on import: however long it really takes, the signal meets it.
    (tmp_path / "sitecustomize.py").write_text(
        "import sys, importlib.abc\n"
        "class Slow(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        f"        if name == '{slow}':\n"
        "            print('importing', flush=True)\n"
        "            import time; time.sleep(5)\n"
        "sys.meta_path.insert(0, Slow())\n"
    )
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path.cwd()}"}
    command = [sys.executable, "-m", "imgcal", *arguments]
    # A suite that runs in the background has SIGINT ignored, and so would its children.
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "importing\n"
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (130, "imgcal: interrupted\n")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["kalibrate", "x"], "unknown command `kalibrate`; did you mean `calibrate`?"),
        (["calibrate", "x", "--rig", "T4", "--object", "cube8", "--out", "o", "--snapshot", "1:2"],
         "unknown option `--snapshot`; did you mean `--snapshots`? See imgcal calibrate --help"),
        (["calibrate", "x", "--object", "cube8", "--out", "o", "--start-pose", "1", "2", "3"],
         "--start-pose: found 3 values, expected 6; see imgcal calibrate --help"),
        (["calibrate", "x", "--object", "cube8", "--out", "o", "--start-pose", *"abcdef"],
         "--start-pose: found a b c d e f, expected 6 numbers; see imgcal calibrate --help"),
        (["calibrate", "x", "--objct", "cube8", "--out", "o"],
         "unknown option `--objct`; did you mean `--object`? See imgcal calibrate --help"),
        (["simulate", "--rig", "T4", "--object", "cube8", "--out", "o", "--snapshots", "2x"],
         "--snapshots: found 2x, expected an integer; see imgcal simulate --help"),
        (["calibrate"],
         "missing INPUT (capture folder, detections file, or a shipped sample (sample:O10)), --object, --out, "
         "--rig or --cameras; see imgcal calibrate --help"),
        (["calibrate", "x", "--object", "cube8", "--cameras=c.yaml"], "missing --out; see imgcal calibrate --help"),
        (["export", "m", "--out", "m.onnx", "--to", "onx"],
         "--to: found onx, expected onnx or pt2; did you mean onnx? See imgcal export --help"),
        (["describe", "me"], "found me, expected experiments; see imgcal describe --help"),
        (["describe", "ir-cnn"], "found ir-cnn, expected experiments; see imgcal describe --help"),
        (["rig", "lookat"], "unknown `imgcal rig lookat`; did you mean `look-at`? See imgcal rig --help"),
        (["rig", "round"], "unknown `imgcal rig round`, expected look-at or cameras; see imgcal rig --help"),
        (["rig"], "expected look-at or cameras after `imgcal rig`; see imgcal rig --help"),
        (["simulate", "--rig", "T4", "--object", "cube8", "--out", "o", "--phi-deg", "9"],
         "--phi-deg: found too few values, expected 2; see imgcal simulate --help"),
        (["compare"], "compare: found no models, expected two or more (or, with --captures, one or more detectors); "
         "see imgcal compare --help"),
    ],
)  # fmt: skip
def test_a_mistyped_command_line_is_answered_briefly(arguments, expected, capsys):
    assert main(arguments) == 2
    assert one_line(capsys) == f"imgcal: {expected}"


@pytest.mark.parametrize(
    ("arguments", "objects"),
    [
        ("calibrate in --object a b --rig r --out o", ("a", "b")),
        ("calibrate in --rig r --out o --object a b c", ("a", "b", "c")),
        ("calibrate in --rig r --out o --object a --object b", ("a", "b")),
        ("calibrate --rig r --out o --object a in", ("a",)),
        ("simulate --rig r --object a b --out o", ("a", "b")),
        ("score in --rig r --object a", ("a",)),
    ],
)
def test_an_object_may_be_several(arguments, objects):
    assert module.parse(arguments.split()).object == objects


@pytest.mark.parametrize("option", ["--poses", "--topic"])
def test_an_option_without_its_value_is_told(option, tmp_path, capsys):
    given = ["watch", "blobs.csv", "--rig", "T4", "--object", "cube8", "--out", str(tmp_path / "out"), option]
    assert main(given) == 2
    assert capsys.readouterr().err == f"imgcal: {option}: found no value, expected one or more\n"

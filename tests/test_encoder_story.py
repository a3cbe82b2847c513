"""The example of docs/train.md, An encoder of yours, runs as it is printed."""

import doctest
import re
import shlex
from pathlib import Path

import pytest

from imgcal.cli.main import main
from imgcal.errors import InputError
from imgcal.io import load_object, read_rig
from imgcal.pipeline import load_initializer

PAGE = (Path(__file__).parents[1] / "docs" / "train.md").read_text("utf-8")
STORY = PAGE.partition("## An encoder of yours\n")[2].partition("\n## ")[0]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


@pytest.mark.usefixtures("few_timings")
def test_it_is_trained_refused_and_evaluated_once_it_is_trusted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = FENCE.findall(STORY)
    for kind, text in blocks[:-1]:
        name, _, content = text.removeprefix("# ").partition("\n")
        assert name == {"python": "mine.py", "yaml": "mine.yaml"}[kind]
        Path(name).write_text(content)
    kind, text = blocks[-1]
    assert kind == "console" and text.startswith("$ export PYTHONPATH=.\n")
    monkeypatch.syspath_prepend(".")
    tried = 0
    for line, expected in re.findall(r"^\$ imgcal (.*)\n((?:(?!\$ ).*\n)*)", text, re.MULTILINE):
        code = main(shlex.split(line))
        said = capsys.readouterr()
        refused = expected.startswith("imgcal: ")
        assert code == (2 if refused else 0), said.err
        found = said.err if refused else said.out
        options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
        assert doctest.OutputChecker().check_output(expected, found, options), found
        tried += 1
    assert tried == 3
    _others_that_load_it(capsys)


def _others_that_load_it(capsys):
    few = ["--count", "2", "--trials", "1"]
    for trust, code in (([], 2), (["--trust", "mine:Encoder"], 0)):
        assert main(["compare", "out/mine", "out/mine/model.safetensors", *few, *trust]) == 2  # the same one twice
        Path("again").mkdir(exist_ok=True)
        Path("again/model.safetensors").write_bytes(Path("out/mine/model.safetensors").read_bytes())
        assert main(["compare", "out/mine", "again", *few, *trust]) == code
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    with pytest.raises(InputError, match="found the encoder mine:Encoder, whose code would run"):
        load_initializer("out/mine", rig, obj)
    assert load_initializer("out/mine", rig, obj, trusted=("mine:Encoder",)).name == "mine"
    capsys.readouterr()
    known = ["--rig", "T4", "--object", "asymmetric8", "--out", "cal"]
    simulated = ["simulate", *known[:4], "--snapshots", "2", "--kappa", "0.002", "--no-clutter", "--out", "capture"]
    assert main(simulated) == 0
    blobs = "capture/truth/detections.csv"
    assert main(["calibrate", blobs, *known, "--first-guess", "out/mine"]) == 2
    assert "--trust mine:Encoder" in capsys.readouterr().err
    assert main(["calibrate", blobs, *known, "--trust", "mine:Encoder"]) == 2
    assert "--trust: found mine:Encoder without --first-guess" in capsys.readouterr().err
    assert main(["calibrate", blobs, *known, "--first-guess", "out/mine", "--trust", "mine"]) == 2
    assert "expected a class as package.module:Class" in capsys.readouterr().err
    assert main(["calibrate", blobs, *known, "--first-guess", "out/mine", "--trust", "mine:Encoder"]) in (0, 3)

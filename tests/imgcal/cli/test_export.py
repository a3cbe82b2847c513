import pytest

from imgcal.cli import export as module
from imgcal.cli.main import main


@pytest.fixture
def export(tmp_path):
    return lambda *more, out="x.onnx": main(["export", "measurer-cnn", "--out", str(tmp_path / out), *more])


def test_a_shipped_network_is_written_and_described(export, tmp_path, capsys):
    pytest.importorskip("onnxruntime", reason="no onnxruntime (extra onnx)")
    assert export("--count", "3") == 0
    said = capsys.readouterr().out
    assert " in: patches: float32 (3, 24, 24)" in said and "out: kind: " in said and "measurer, opset 18" in said
    assert (tmp_path / "x.onnx").stat().st_size > 300_000


@pytest.mark.parametrize(
    ("more", "out", "said"),
    [
        ((), "x.pt2", "expected a name that ends in .onnx"),
        (("--count", "0"), "x.onnx", "--count: found 0"),
        (("--fiducials", "5000"), "x.onnx", "--fiducials: found 5000"),
    ],
)
def test_what_cannot_be_done_is_one_line(export, capsys, more, out, said, tmp_path):
    assert export(*more, out=out) == 2
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_nothing_is_written_that_says_something_else(export, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(module, "save_exported", lambda program, path: 0.1)
    assert export("--to", "pt2", out="x.pt2") == 2
    assert "gives different numbers (by 1.0e-01" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_library_that_is_missing_is_named(export, capsys, monkeypatch):
    monkeypatch.setattr(module, "missing", lambda *libraries: "onnx")
    assert export() == 2
    assert 'needs onnx: pip install ".[onnx]" in the clone' in capsys.readouterr().err

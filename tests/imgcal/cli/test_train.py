import signal

import pytest

from imgcal.cli.main import main
from imgcal.io import holding, load_object, read_metrics, read_rig, save_rig
from imgcal.networks import load_network
from imgcal.training import engine
from tests.imgcal.lensed import lensed
from tests.imgcal.training.toy import EXPERIMENT, Toy


@pytest.fixture
def experiment(tmp_path, monkeypatch):
    monkeypatch.setattr("imgcal.networks.factory.build", Toy)
    path = tmp_path / "toy.yaml"
    path.write_text(EXPERIMENT)
    return path


def train(experiment, out, *more):
    return main(["train", str(experiment), "--out", str(out), *more])


def test_a_network_comes_out(experiment, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    assert train(experiment, out, "--set", "training.steps=30", "optimizer.lr=1e-3", "--set", "training.steps=20") == 0
    load_network(out / "model.safetensors", read_rig("T4"), load_object("asymmetric8"))
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "step 20  RE " in printed.err and "validation RE" in printed.err
    assert printed.err.endswith(f"s: {out / 'model.safetensors'}\n")
    assert "lr: 0.001" in (out / "resolved.yaml").read_text()
    # What was resolved can be run itself, and a folder is not trained in twice.
    assert train(out / "resolved.yaml", tmp_path / "again") == 0
    assert train(experiment, out) == 2
    assert "found a training there already, expected a new folder, or --resume" in capsys.readouterr().err


LENSES = """
format: imgcal-experiment/1
name: lenses
rig: {rig}
object: asymmetric8
poses: {{theta_deg: [0, 0], phi_deg: [0, 20]}}
drift: {{kappa_intrinsics: 0.01, kappa_extrinsics: 0.01}}
network: {network}
training: {{steps: 2, batch_size: 8, validation_rigs: 8, device: cpu, threads: 1}}
"""
POINTS = "{preset: points, change: {trunk: {width: 16, depth: 1, later_depth: 1, heads: 2}}}"
PAPER = "{preset: paper-points, change: {width: 16, depth: 1, heads: 2}}"
IMAGES = "{preset: hue-centroids, change: {trunk: {width: 16, depth: 1, later_depth: 1, heads: 2}}}"


@pytest.mark.usefixtures("few_timings")
def test_a_rig_of_other_lenses_is_trained_for_compared_and_calibrated(tmp_path, capsys):
    """From an experiment file to a first guess; OpenCV's methods, which know one lens, are left out."""
    rig = tmp_path / "rig.yaml"
    save_rig(lensed(read_rig("T4"), "mixed"), rig)
    runs = []
    for number, network in enumerate((POINTS, PAPER, IMAGES)):
        path = tmp_path / f"{number}.yaml"
        path.write_text(LENSES.format(rig=rig, network=network))
        runs.append(str(tmp_path / str(number)))
        assert train(path, runs[-1]) == 0
    few = ["--count", "4", "--trials", "1"]
    capsys.readouterr()
    assert main(["compare", *runs, *few, "--baselines"]) == 0
    printed = capsys.readouterr()
    assert (
        "note: left out PnP per camera, factory intrinsics and OpenCV calibrateCamera per camera: no sup" in printed.err
    )
    assert all(name in printed.out for name in ("| 0 ", "| 1 ", "| 2 ", "MAP from PnP", "scipy bundle adjustment"))
    capture, known = tmp_path / "capture", ["--rig", str(rig), "--object", "asymmetric8"]
    how = ["--snapshots", "3", "--seed", "2", "--kappa", "0.002", "--no-clutter"]
    assert main(["simulate", *known, "--out", str(capture), *how]) == 0
    blobs = str(capture / "truth" / "detections.csv")
    assert main(["calibrate", blobs, *known, "--out", str(tmp_path / "out"), "--first-guess", runs[0]]) == 0
    # Trained for these lenses, and for no others.
    other = ["--rig", "T4", "--object", "asymmetric8"]
    capsys.readouterr()
    assert main(["calibrate", blobs, *other, "--out", str(tmp_path / "no"), "--first-guess", runs[0]]) == 2
    found = capsys.readouterr().err
    assert "lens model of cam01: found brown_conrady, expected" in found and found.count("\n") == 1


def test_minutes_end_the_training(experiment, tmp_path):
    out = tmp_path / "out"
    assert train(experiment, out, "--minutes", "0.005", "--set", "training.steps=null") == 0
    assert read_metrics(out / "metrics.jsonl")[-1]["step"] >= 1
    assert "minutes: 0.005" in (out / "resolved.yaml").read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_training_is_saved_and_says_how_to_resume(experiment, tmp_path, capsys, monkeypatch, number):
    step = engine.train_step

    def interrupted_at_seven(run):
        step(run)
        if run.step == 7:
            signal.raise_signal(number)

    monkeypatch.setattr(engine, "train_step", interrupted_at_seven)
    handler = signal.getsignal(number)
    assert train(experiment, tmp_path / "out") == 130
    assert signal.getsignal(number) == handler
    error = capsys.readouterr().err
    assert "interrupted and saved at step 7; to continue, repeat the command with --resume" in error
    load_network(tmp_path / "out" / "model.safetensors")
    assert train(experiment, tmp_path / "out", "--resume") == 0
    assert "from step 7 on" in capsys.readouterr().err


def test_a_second_training_in_a_folder_is_refused_and_harms_nothing(experiment, tmp_path, capsys):
    out = tmp_path / "out"
    assert train(experiment, out) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    capsys.readouterr()
    with holding(out):
        assert train(experiment, out, "--resume", "--set", "training.steps=40") == 2
    error = capsys.readouterr().err
    assert f"{out}: another imgcal is using this folder" in error and error.count("\n") == 1
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert train(experiment, out, "--resume", "--set", "training.steps=40") == 0
    capsys.readouterr()
    assert train(experiment, out, "--resume", "--set", "training.steps=40") == 0
    assert "complete already after 60 steps" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--set", "drift.kappa_intrinsics=3.0"], "kappa_intrinsics: found 3.0, expected less than 1"),
        (["--set", "training.stepz=1"], "unknown key `stepz`, nearest: steps"),
        (["--set", "optimizer.learning_rates.head=0.1"], "unknown group head, nearest: heads"),
        (["--set", "rig=O1"], "O1: no such file, nor one of the shipped rigs"),
        (["--set", "training.init_from=nothing.safetensors"], "nothing.safetensors: cannot be read"),
        (["--minutes", "-1"], "imgcal: --minutes: found -1, expected more than 0"),
        (["--minutes", "nan"], "imgcal: --minutes: found nan, expected more than 0"),
        (["--resume"], "found no state.safetensors there"),
    ],
)
def test_unusable_input_is_one_line(experiment, tmp_path, capsys, arguments, expected):
    assert train(experiment, tmp_path / "out", *arguments) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_error_names_only_what_the_user_typed(tmp_path, capsys):
    given = ["train", "measurer-cnn", "--from", "ds", "--out", str(tmp_path / "out"), "--set", "training.batch_size=-1"]
    assert main(given) == 2
    assert capsys.readouterr().err.startswith("imgcal: --set training.batch_size=-1: training: batch_size: found -1")


def test_a_rig_without_cameras(experiment, tmp_path, capsys):
    rig = tmp_path / "empty.yaml"
    rig.write_text("format: imgcal-rig/1\nname: empty\ncameras: []\n")
    assert train(experiment, tmp_path / "out", "--set", f"rig={rig}") == 2
    assert "cameras: found 0 values, expected 1 or more" in capsys.readouterr().err

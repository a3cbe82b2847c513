import math

import pytest

from imgcal.errors import InputError
from imgcal.io import read_rig, save_rig
from imgcal.synthesis import ImageOptions, PhysicalDrift, PoseRange, RelativeDrift
from imgcal.synthesis.rigs import make_drift
from imgcal.training import change_experiment, load_experiment, save_experiment
from tests.imgcal.training.toy import EXPERIMENT


def test_what_is_not_given_has_a_default(experiment):
    made = experiment()
    assert made.training.steps == 60
    assert made.training.minutes is None
    assert made.loss.kind == "robust"
    assert made.poses == PoseRange.overhead()
    assert made.drift == RelativeDrift(0.01, 0.01)
    assert made.load_rig().num_cameras == 4
    assert made.load_object().num_fiducials == 8


def test_a_resolved_experiment_is_the_same(experiment, tmp_path):
    made = experiment(
        "optimizer.clip=null", "optimizer.learning_rates.trunk=1e-4", "corruption={noise: 0.1, false: 0.2}"
    )
    save_experiment(made, tmp_path / "resolved.yaml")
    assert load_experiment(tmp_path / "resolved.yaml") == made
    assert made.optimizer.clip is None
    assert made.optimizer.learning_rates == {"trunk": 1e-4}
    assert made.corruption.false == 0.2


def test_files_are_looked_for_beside_the_experiment(experiment, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    save_rig(read_rig("O6"), tmp_path / "mine.yaml")
    (tmp_path / "T4").mkdir()  # no file: the shipped rig is meant
    (tmp_path / "toy2.yaml").write_text(EXPERIMENT.replace("rig: T4", "rig: mine.yaml"))
    made = load_experiment(tmp_path / "toy2.yaml")
    assert made.load_rig().num_cameras == 6 and experiment().load_rig().num_cameras == 4
    save_rig(read_rig("U7"), tmp_path / "here" / "mine.yaml")  # the current folder comes first, as ever
    assert load_experiment(tmp_path / "toy2.yaml").load_rig().num_cameras == 7


def test_a_group_that_is_none_is_told_its_keys(experiment):
    for change in ("corruption=null", "corruption=3"):
        with pytest.raises(
            InputError, match=r"corruption: found .*, expected a group of keys: noise, missing, swapped"
        ):
            experiment(change)
    with pytest.raises(InputError, match="training: found 1, expected a group of keys: steps, minutes, batch_size"):
        experiment("training=1")


def test_physical_drift(experiment):
    made = experiment("drift={rotation_deg: 0.5, position: 2}")
    assert made.drift == PhysicalDrift(0.5, 2.0, 0.0, 0.0, 0.0)
    assert experiment("drift={kappa_intrinsics: 0.1}").drift == RelativeDrift(0.1, 0.0)


def test_degrees_become_radians(experiment):
    poses = experiment("poses={phi_deg: [10, 45]}").poses
    theta, phi, alpha = poses.radians
    assert phi == (math.radians(10), math.radians(45))
    assert theta == alpha == (0.0, 2 * math.pi)


def test_blocks_may_say_nothing(experiment):
    made = experiment("poses={}", "corruption={}", "drift={}", "images={}")
    assert made.poses == PoseRange() and made.corruption.nothing
    assert made.drift == RelativeDrift(0.0, 0.0)
    assert made.images == ImageOptions()


def test_drift_as_older_files_have_it():
    values = {"kappa_intrinsics": 0.05, "kappa_extrinsics": 0.01, "rotation_deg": None, "position": None}
    assert make_drift(values) == RelativeDrift(0.05, 0.01)


def test_changes_are_applied_in_order(experiment):
    made = change_experiment(experiment(), "training.steps=7", "training.steps=8")
    assert made.training.steps == 8
    assert made.training.batch_size == 12
    assert change_experiment(made, "paper={table: '1', row: 3}").paper.row == 3
    assert change_experiment(made, "images.size=32").images.size == 32


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("drift={kappa_intrinsics: 3.0}", "drift: kappa_intrinsics: found 3.0, expected less than 1"),
        ("drift.position=3", "found kappa_extrinsics and position, expected kappas or physical units, not both"),
        ("training.stepz=1", "training: unknown key `stepz`, nearest: steps"),
        ("training={batch_size: 3}", "training: found neither `steps` nor `minutes`"),
        ("training.batch_size=0", "batch_size: found 0, expected greater than or equal to 1"),
        ("training.steps=0", "steps: found 0"),
        ("poses.phi_deg=[90, 0]", "poses: phi_deg: found [90, 0], expected the smaller angle first"),
        ("poses.phi_deg=[90]", "phi_deg: found 1 values"),
        ("corruption.noise=.inf", "corruption: noise: found inf"),
        ("corruption.noize=1", "corruption: unknown key `noize`, nearest: noise"),
        ("drift={positon: 1}", "drift: unknown key `positon`, nearest: position"),
        ("drift={kapa_intrinsics: 0.1}", "drift: unknown key `kapa_intrinsics`, nearest: kappa_intrinsics"),
        ("drift=3", "drift: found 3"),
        ("images={size: 2}", "images: size: found 2, expected greater than or equal to 8"),
        ("images={size: 20, dot: 30.0}", "images: dot: found 30.0, expected less than the 20 pixels"),
        ("poses={phi_deg: [0, 400]}", "poses: phi_deg[1]: found 400, expected less than or equal to 360"),
        ("loss.kind=best", "loss: kind: found 'best'"),
        ("training.steps", "found no key and value"),
        ("=3", "found no key and value"),
        ("rig={", "expected a value in YAML"),
        ("name.x=3", "found the value 'toy' at `name`, expected a group of keys"),
    ],
)
def test_impossible_values_are_one_clear_line(experiment, change, expected):
    with pytest.raises(InputError) as caught:
        experiment(change)
    message = str(caught.value)
    assert message.startswith(f"--set {change}: ")
    assert expected in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("name: toy", "nome: toy", "unknown key `nome`, nearest: name"),
        ("imgcal-experiment/1", "imgcal-experiment/9", "expected `format: imgcal-experiment/1`"),
        ("kappa_extrinsics: 0.01", "kappa_extrinsics: -1", "kappa_extrinsics: found -1"),
        ("object: asymmetric8\n", "", "key `object` is missing"),
    ],
)
def test_a_bad_file_is_named(tmp_path, before, after, expected):
    path = tmp_path / "bad.yaml"
    path.write_text(EXPERIMENT.replace(before, after))
    with pytest.raises(InputError) as caught:
        load_experiment(path)
    assert str(path) in str(caught.value)
    assert expected in str(caught.value)


def test_an_unknown_experiment(tmp_path):
    with pytest.raises(InputError, match="no such file, nor one of the shipped experiments"):
        load_experiment(tmp_path / "nothing.yaml")

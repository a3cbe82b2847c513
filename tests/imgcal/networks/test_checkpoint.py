import json
import pickle
import re
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save
from torch import nn

from imgcal.errors import InputError
from imgcal.io import load_object, read_rig, read_tensors, write_tensors
from imgcal.networks import Checkpoint, build_network, load_checkpoint, load_network, save_checkpoint, warm_start
from imgcal.networks.checkpoint import FORMAT
from imgcal.training import checkpoint_experiment
from imgcal.types import Views
from tests.imgcal.training.toy import Toy, experiments


@pytest.fixture(autouse=True)
def toy(monkeypatch):
    """Every network that is built is the toy."""
    monkeypatch.setattr("imgcal.networks.factory.build", Toy)


@pytest.fixture
def experiment(tmp_path):
    return experiments(tmp_path)


class Normalized(Toy):
    """Has running means of batches, as many encoders of timm."""

    def make_layers(self, factory, obj):
        super().make_layers(factory, obj)
        self.trunk.append(nn.BatchNorm1d(self.width))


def built(setup):
    return build_network(setup, setup.load_rig(), setup.load_object(), torch.Generator().manual_seed(3))


def save_network(path, network, setup, metrics, dtype=torch.float32):
    save_checkpoint(path, Checkpoint(network, setup.load_rig(), setup.load_object(), setup, metrics), dtype)


@pytest.fixture
def made(experiment):
    setup = experiment()
    network = built(setup)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return setup, network.eval()


@pytest.fixture
def path(made, tmp_path):
    experiment, network = made
    save_network(tmp_path / "model.safetensors", network, experiment, {"re_px": 1.5})
    return tmp_path / "model.safetensors"


def test_a_network_comes_back(made, path):
    experiment, network = made
    found = load_checkpoint(path, read_rig("T4"), load_object("asymmetric8"))
    views = Views(uv=1000 * torch.rand(3, 4, 8, 2), seen=torch.ones(3, 4, 8, dtype=torch.bool))
    expected, again = network(views)[-1], found.network(views)[-1]
    assert torch.equal(again.rig.focal_length, expected.rig.focal_length)
    assert torch.equal(again.rig_from_object.rotation, expected.rig_from_object.rotation)
    assert not found.network.training
    assert found.metrics == {"re_px": 1.5}
    assert checkpoint_experiment(found.experiment) == experiment
    assert found.experiment.drift == experiment.drift and found.experiment.poses == experiment.poses
    assert found.obj.name == "asymmetric8"
    torch.testing.assert_close(found.drift_std, experiment.drift.std(read_rig("T4")), rtol=1e-9, atol=1e-12)


DEEP = '{"a":' * 200 + "1" + "}" * 200


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("experiment", "[" * 100_000, "no readable experiment"),
        ("experiment", DEEP, "no readable experiment"),
        ("experiment", "[]", "no readable experiment"),
        ("experiment", "7" * 5000, "no readable experiment"),
        ("metrics", DEEP, "no readable experiment"),
        ("metrics", "1", "no readable experiment"),
        ("rig", "[" * 100_000, "no readable rig"),
        ("rig", "", "no readable rig"),
        ("object", "x,y,z\n0,0,1e200\n" * 4, "no readable rig and object"),
        ("format", "imgcal-network/2", "expected imgcal-network/1"),
    ],
)
def test_damaged_texts_are_one_line(path, key, text, message):
    tensors, texts = read_tensors(path, FORMAT)
    path.write_bytes(save(tensors, {**texts, key: text}))
    with pytest.raises(InputError, match=message) as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused(path, value):
    tensors, texts = read_tensors(path, FORMAT)
    name = next(name for name, tensor in tensors.items() if tensor.is_floating_point())
    tensors[name].view(-1)[0] = value
    write_tensors(path, tensors, FORMAT, texts)
    with pytest.raises(InputError, match=f"weights that are not finite .{name}"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    "change",
    [
        {"preset": "vit", "change": {"options": {"checkpoint_path": "/tmp/evil.pth"}}},
        {"preset": "vit", "change": {"backbone": "local-dir:/tmp/evil"}},
        {"preset": "points", "change": {"trunk": {"depth": 10**7}}},
        {"preset": "points", "change": {"trunk": {"width": 10**7}}},
    ],
)
def test_a_model_file_asks_for_nothing_but_its_own_network(path, change, monkeypatch):
    tensors, texts = read_tensors(path, FORMAT)
    experiment = json.loads(texts["experiment"])
    experiment["network"] = change
    experiment["training"]["init_from"] = "/tmp/evil.pth"
    path.write_bytes(save(tensors, {**texts, "experiment": json.dumps(experiment)}))
    monkeypatch.undo()  # the real networks
    monkeypatch.setattr("timm.create_model", None)
    with pytest.raises(InputError, match=r"model\.safetensors: experiment: network|expected a timm model"):
        load_checkpoint(path)


def test_published_weights_are_not_asked_for_where_trained_ones_replace_them(experiment, tmp_path, monkeypatch):
    setup, asked = experiment("network={preset: vit, change: {pretrained: true}}"), []

    def build(config, *given):
        asked.append(config.variant().pretrained)
        return Toy(config, *given)

    monkeypatch.setattr("imgcal.networks.factory.build", build)
    network = built(setup)
    save_network(tmp_path / "a.safetensors", network, setup, {})
    assert checkpoint_experiment(load_checkpoint(tmp_path / "a.safetensors").experiment) == setup
    assert asked == [True, False]


def test_a_rig_in_single_precision_is_the_same(made, tmp_path):
    experiment, network = made
    checkpoint = Checkpoint(network, network.factory, network.obj, experiment, {})
    save_checkpoint(tmp_path / "a.safetensors", checkpoint)
    load_network(tmp_path / "a.safetensors", read_rig("T4"), load_object("asymmetric8"))


def test_bfloat16_is_for_parameters_only(experiment, tmp_path, monkeypatch):
    monkeypatch.setattr("imgcal.networks.factory.build", Normalized)
    setup, path = experiment(), tmp_path / "small.safetensors"
    network = built(setup)
    network.trunk[3].running_mean.fill_(1 / 3)
    save_network(path, network, setup, {}, dtype=torch.bfloat16)
    tensors, _ = read_tensors(path, FORMAT)
    assert tensors["trunk.0.weight"].dtype == torch.bfloat16
    assert torch.equal(tensors["trunk.3.running_mean"], network.trunk[3].running_mean)
    found = load_network(path)
    assert {tensor.dtype for tensor in found.parameters()} == {torch.float32}
    torch.testing.assert_close(found.trunk[0].weight, network.trunk[0].weight, rtol=2**-8, atol=0.0)


@pytest.mark.parametrize(
    ("rig", "obj", "expected"),
    [
        ("O10", "asymmetric8", "trained for another rig than O10 (T4): cameras: found cam01, cam02"),
        ("T4", "cube8", "trained for another object than cube8 (asymmetric8): fiducial 1"),
        ("T4", "sphere64", "found 64 fiducials, expected 8"),
    ],
)
def test_another_rig_or_object_is_refused(path, rig, obj, expected):
    with pytest.raises(InputError, match=re.escape(expected)):
        load_network(path, read_rig(rig), load_object(obj))


def test_another_factory_value_is_refused_by_camera(path):
    rig = read_rig("T4")
    principal_point = rig.principal_point.clone()
    principal_point[2, 1] += 0.1
    with pytest.raises(InputError, match=r"principal point of cam03: found 1024, 544\.1, expected 1024, 544"):
        load_network(path, replace(rig, principal_point=principal_point))
    step = torch.zeros(4, 15, dtype=torch.float64)
    step[1, 4] = 0.5
    with pytest.raises(InputError, match="position of cam02"):
        load_network(path, rig.retract(step))
    step[1, 4], step[3, 0] = 0.0, 1e-4
    with pytest.raises(InputError, match="rotation of cam04"):
        load_network(path, rig.retract(step))
    load_network(path, replace(rig, name="another name"))


def test_spheres_are_not_points(path):
    obj = load_object("asymmetric8")
    with pytest.raises(InputError, match="radius"):
        load_network(path, obj=replace(obj, radius=torch.full((8,), 5.0, dtype=torch.float64)))


class Malicious:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was loaded",))


def test_pickles_are_never_loaded(tmp_path):
    for name, write in (
        ("a.safetensors", lambda path: path.write_bytes(pickle.dumps(Malicious()))),
        ("b.safetensors", lambda path: torch.save({"weight": Malicious()}, path)),
        ("c.safetensors", lambda path: torch.save(Malicious(), path, _use_new_zipfile_serialization=False)),
    ):
        write(tmp_path / name)
        with pytest.raises(InputError, match="found a pickle, which is never loaded"):
            load_network(tmp_path / name)


def test_damaged_files_are_refused(path, tmp_path):
    content = path.read_bytes()
    middle = bytearray(content)
    middle[-100] ^= 1
    for damaged, expected in (
        (content[:-100], "damaged"),
        (content[:50], "damaged"),
        (b"", "damaged"),
        (b"\xff" * 100, "damaged"),
        (bytes(middle), "does not match its checksum"),
    ):
        bad = tmp_path / "bad.safetensors"
        bad.write_bytes(damaged)
        with pytest.raises(InputError, match=expected) as caught:
            load_network(bad)
        assert str(bad) in str(caught.value)


def test_other_versions_and_kinds_are_refused(path, tmp_path):
    tensors, texts = read_tensors(path, FORMAT)
    other = tmp_path / "other.safetensors"
    write_tensors(other, tensors, "imgcal-network/9", texts)
    with pytest.raises(InputError, match="found format imgcal-network/9, expected imgcal-network/1"):
        load_network(other)
    write_tensors(other, {"weight": torch.ones(2)}, FORMAT, texts)
    with pytest.raises(InputError, match="found other weights than its network has"):
        load_network(other)
    write_tensors(other, tensors, FORMAT, texts | {"experiment": "{"})
    with pytest.raises(InputError, match="no readable experiment"):
        load_network(other)
    write_tensors(other, tensors, FORMAT, texts | {"rig": "format: nothing"})
    with pytest.raises(InputError, match="no readable rig and object"):
        load_network(other)
    with pytest.raises(InputError, match="cannot be read"):
        load_network(tmp_path / "missing.safetensors")


def test_warm_start_takes_what_fits(made, path, experiment):
    wider = experiment("rig=O10")
    network = built(wider)
    prior_std, trunk = network.prior_std.clone(), network.trunk[0].weight.clone()
    assert warm_start(path, network) == ("trunk.0.weight", "head.weight", "head.bias")
    assert torch.equal(network.trunk[0].bias, made[1].trunk[0].bias)
    assert torch.equal(network.trunk[0].weight, trunk)
    assert torch.equal(network.prior_std, prior_std)  # buffers belong to the new rig and drift
    with pytest.raises(InputError, match="no weights that match"):
        warm_start(path, torch.nn.Linear(3, 4))


def test_a_model_file_imports_nothing_of_somebodys_unless_it_is_trusted(path, monkeypatch):
    mine = "tests.imgcal.networks.test_feature_maps:Mine"
    tensors, texts = read_tensors(path, FORMAT)
    experiment = json.loads(texts["experiment"])
    experiment["network"] = {"preset": "vit", "change": {"backbone": mine}}
    path.write_bytes(save(tensors, {**texts, "experiment": json.dumps(experiment)}))
    monkeypatch.undo()  # the real networks
    with monkeypatch.context() as watched:
        watched.setattr("importlib.import_module", None)
        with pytest.raises(InputError, match="whose code would run; expected"):
            load_checkpoint(path)
    with pytest.raises(InputError, match="other weights than its network has"):  # it was imported, and is not the toy
        load_checkpoint(path, trusted=(mine,))


def test_image_networks_that_read_hues_are_refused_by_that_name(path):
    tensors, texts = read_tensors(path, FORMAT)
    write_tensors(path, {**tensors, "belief.weight": torch.zeros(1)}, FORMAT, texts)
    with pytest.raises(InputError, match="reads positions by hue, from an earlier version"):
        load_checkpoint(path)


def test_of_several_starts_the_last_one_wins(made, tmp_path):
    setup, network = made
    files = []
    for value in (1.0, 2.0):
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.fill_(value)
        files.append(tmp_path / f"{value}.safetensors")
        save_network(files[-1], network, setup, {})
    other = built(setup)
    assert warm_start([*files], other) == () and all(bool((p == 2.0).all()) for p in other.parameters())


def test_warm_start_takes_running_means_over_and_says_which_it_does_not_find(experiment, tmp_path, monkeypatch):
    monkeypatch.setattr("imgcal.networks.factory.build", Normalized)
    setup = experiment()
    trained, network, wide = built(setup), built(setup), built(setup)
    trained.trunk[3].running_mean.fill_(0.5)
    trained.trunk[3].num_batches_tracked.fill_(7)
    save_network(tmp_path / "a.safetensors", trained, setup, {})
    assert warm_start(tmp_path / "a.safetensors", network) == ()
    assert all(torch.equal(tensor, trained.state_dict()[name]) for name, tensor in network.state_dict().items())
    wide.trunk[3] = nn.BatchNorm1d(2 * Toy.width)
    names = [f"trunk.3.{name}" for name in ("weight", "bias", "running_mean", "running_var")]
    assert warm_start(tmp_path / "a.safetensors", wide) == tuple(names)


def test_warm_start_converts_what_it_takes_to_the_new_drift_and_nothing_else(experiment, tmp_path, monkeypatch):
    """Offsets are in units of the drift, here three times as wide."""
    monkeypatch.undo()  # the real networks
    trunk = "network={{preset: points, change: {{trunk: {{width: 16, depth: 1, later_depth: 1, passes: {}}}}}}}"
    generator = torch.Generator().manual_seed(0)
    for passes in (1, 2):
        setup = experiment(trunk.format(passes))
        trained = built(setup)
        with torch.no_grad():
            for parameter in trained.parameters():
                parameter.copy_(torch.rand(parameter.shape, generator=generator) + 0.1)
        save_network(tmp_path / f"{passes}.safetensors", trained, setup, {})
    wide = "drift={kappa_intrinsics: 0.03, kappa_extrinsics: 0.03}"
    network = built(experiment(trunk.format(2), wide, "object=cube27"))
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    left = warm_start([tmp_path / "2.safetensors", tmp_path / "1.safetensors"], network)
    assert "trunk.later.embed.0.weight" in left  # its inputs are fiducials and offsets
    assert all(torch.equal(network.state_dict()[name], before[name]) for name in left)
    head = network.trunk.later.camera_head[-1].weight  # only the first file has it
    ratio = head[-2:].detach() / trained.trunk.later.camera_head[-1].weight[-2:].detach()
    torch.testing.assert_close(ratio, torch.full_like(ratio, 1 / 3))

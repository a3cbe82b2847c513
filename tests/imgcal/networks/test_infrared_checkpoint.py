import re
from pathlib import Path

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import model_file, read_tensors, write_tensors
from imgcal.networks import (
    InfraredCheckpoint,
    InfraredConfig,
    InfraredNetwork,
    load_infrared,
    load_measurer,
    warm_start,
)
from imgcal.networks.infrared_checkpoint import EARLIER, INFRARED, MEASURER

SMALL = InfraredConfig(crop=48, channels=4, window=6, blocks=1)


def saved(folder: Path) -> tuple[InfraredNetwork, Path]:
    network, path = InfraredNetwork(SMALL), folder / "model.safetensors"
    InfraredCheckpoint(network, {"steps": 3}).save(path)
    return network, path


def test_there_and_back(tmp_path: Path) -> None:
    network, path = saved(tmp_path)
    state = torch.get_rng_state()
    read = load_infrared(path)
    assert torch.equal(torch.get_rng_state(), state)  # reading draws no random numbers of others
    assert read.metrics == {"steps": 3}
    assert read.network.config == SMALL
    assert not read.network.training
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(read.network.state_dict()[name], tensor, atol=1e-4, rtol=1e-2)


def test_neither_rig_nor_object_is_in_it(tmp_path: Path) -> None:
    _, path = saved(tmp_path)
    assert set(read_tensors(path, INFRARED)[1]) == {"config", "metrics", "format", "checksum"}


@pytest.mark.parametrize(
    ("name", "tag", "load"), [("ir-cnn", INFRARED, load_infrared), ("measurer-cnn", MEASURER, load_measurer)]
)
def test_the_shipped_ones_are_read_bit_for_bit(name: str, tag: str, load) -> None:
    tensors, _ = read_tensors(model_file(name), tag)
    read = load(model_file(name)).network.state_dict()
    assert read.keys() == tensors.keys() and all(torch.equal(read[key], tensors[key].float()) for key in read)


def test_networks_with_earlier_names_are_read_bit_for_bit(tmp_path: Path) -> None:
    network, path = InfraredNetwork(SMALL.model_copy(update={"encoder": "vit"})), tmp_path / "model.safetensors"
    InfraredCheckpoint(network, {}).save(path)
    earlier = {now: before for before, now in EARLIER.items()}
    tensors, texts = read_tensors(path, INFRARED)
    renamed = {".".join(earlier.get(part, part) for part in name.split(".")): each for name, each in tensors.items()}
    assert "encoder.blocks.0.to_qkv.weight" in renamed and renamed.keys() != tensors.keys()
    kept = {name: text for name, text in texts.items() if name not in ("format", "checksum")}
    write_tensors(tmp_path / "earlier.safetensors", renamed, INFRARED, kept)
    read = load_infrared(tmp_path / "earlier.safetensors").network.state_dict()
    assert all(torch.equal(read[name], tensor.float()) for name, tensor in tensors.items())
    assert warm_start(tmp_path / "earlier.safetensors", InfraredNetwork(network.config)) == ()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda tensors, texts: tensors.pop("head.0.bias"), "other weights"),
        (lambda tensors, texts: tensors["head.0.bias"].fill_(torch.nan), "not finite"),
        (lambda tensors, texts: texts.update(config="[]"), "readable configuration"),
        (lambda tensors, texts: texts.update(config='{"window": 7}'), "config: window"),
    ],
)
def test_damaged_files_say_so(tmp_path: Path, damage, message: str) -> None:
    _, path = saved(tmp_path)
    tensors, texts = read_tensors(path, INFRARED)
    kept = {name: text for name, text in texts.items() if name not in ("format", "checksum")}
    damage(tensors, kept)
    write_tensors(path, tensors, INFRARED, kept)
    with pytest.raises(InputError, match=f"{re.escape(str(path))}.*{message}"):
        load_infrared(path)

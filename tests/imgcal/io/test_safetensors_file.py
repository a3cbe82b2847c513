import os

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import read_tensors, read_texts, write_tensors

FORMAT = "imgcal-test/1"


def test_tensors_of_every_kind_come_back(tmp_path):
    weight = torch.randn(2, 3)
    tensors = {
        "weight": weight,
        "tied": weight,  # shares its memory
        "turned": weight.mT,  # not contiguous
        "part": weight[:, 1],
        "number": torch.tensor(3.5),
        "nothing": torch.empty(0, 4),
        "half": torch.randn(3).bfloat16(),
        "flags": torch.tensor([True, False]),
        "count": torch.tensor(2**40),
    }
    write_tensors(tmp_path / "a.safetensors", tensors, FORMAT, {"note": "a\nb ü"})
    found, texts = read_tensors(tmp_path / "a.safetensors", FORMAT)
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor)
    assert texts["note"] == read_texts(tmp_path / "a.safetensors", FORMAT)["note"] == "a\nb ü"


def test_a_changed_bit_is_noticed(tmp_path):
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"weight": torch.ones(4)}, FORMAT, {})
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="the file is damaged"):
        read_tensors(path, FORMAT)


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_tensors(tmp_path / "missing" / "a.safetensors", {"weight": torch.ones(4)}, FORMAT, {})
    with pytest.raises(InputError, match="found a folder or device"):
        write_tensors(tmp_path, {"weight": torch.ones(4)}, FORMAT, {})


def test_foreign_safetensors_have_no_format(tmp_path):
    from safetensors.torch import save_file

    save_file({"weight": torch.ones(4)}, tmp_path / "a.safetensors")
    with pytest.raises(InputError, match="found no format version, expected imgcal-test/1"):
        read_tensors(tmp_path / "a.safetensors", FORMAT)


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "model.safetensors")
    with pytest.raises(InputError, match="found a folder, device or pipe"):
        read_texts(tmp_path / "model.safetensors", "x/1")


@pytest.mark.parametrize("rigs", [True, False])
def test_a_name_that_no_shipped_network_has_is_answered_with_those_that_exist(rigs, tmp_path, monkeypatch):
    (tmp_path / "data" / "models").mkdir(parents=True)
    for name in ("ir-cnn", "points-O10-cube8")[: 1 + rigs]:
        (tmp_path / "data" / "models" / f"{name}.safetensors").write_bytes(b"")
    monkeypatch.setattr("imgcal.io.names.__file__", str(tmp_path / "imgcal" / "io" / "names.py"))
    with pytest.raises(
        InputError, match=r"points-U7: no file or shipped network has this name; .* one of ir-cnn"
    ) as caught:
        read_tensors("points-U7", "imgcal-network/1")
    assert ("imgcal-models" in str(caught.value)) is not rigs
    assert ("points-O10-cube8" in str(caught.value)) is rigs

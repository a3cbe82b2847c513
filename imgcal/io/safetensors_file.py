"""Tensors in files: safetensors with a format version and a checksum; pickles are recognized and never loaded."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from imgcal.errors import InputError
from imgcal.io.atomic import write_bytes
from imgcal.io.names import check_regular, shipped_networks

# First bytes of what torch.save and pickle.dump write.
PICKLES = (b"PK\x03\x04", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")


def write_tensors(path: str | Path, tensors: Mapping[str, Tensor], file_format: str, texts: Mapping[str, str]) -> None:
    """Write tensors and texts in one step: a full disk leaves the previous file as it was.

    Arguments as for `tensor_bytes`, and the file to write.

    Raises:
        InputError: the file cannot be written.
    """
    write_bytes(path, tensor_bytes(tensors, file_format, texts))


def tensor_bytes(tensors: Mapping[str, Tensor], file_format: str, texts: Mapping[str, str]) -> bytes:
    """Make the content that `write_tensors` writes.

    Args:
        tensors: any dtype, on any device.
        file_format: such as "imgcal-network/1"; what `read_tensors` must be asked for.
        texts: what else belongs to them; the keys `format` and `checksum` are taken.
    """
    # Copies: safetensors refuses tensors that share memory, such as tied weights.
    stored = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()
    }
    return save(stored, {**texts, "format": file_format, "checksum": _checksum(stored)})


def read_tensors(path: str | Path, file_format: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read what `write_tensors` wrote.

    Returns:
        Tensors on the CPU, and texts.

    Raises:
        InputError: no such file, a pickle, another kind or version of file, or content that has changed since.
    """
    path = Path(path)
    texts = read_texts(path, file_format)
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if _checksum(tensors) != texts.get("checksum"):
        raise InputError(f"{path}: found content that does not match its checksum: the file is damaged")
    return tensors, texts


def read_texts(path: str | Path, file_format: str) -> dict[str, str]:
    """Read only the texts of a file that `write_tensors` wrote; damaged tensors go unnoticed.

    Raises:
        InputError: as for `read_tensors`.
    """
    path = Path(path)
    check_regular(path)
    if not path.exists() and path == Path(path.stem):
        raise InputError(f"{path}: no file or shipped network has this name; expected {shipped_networks()}")
    try:
        with open(path, "rb") as raw:
            start = raw.read(4)
        if start.startswith(PICKLES):
            raise InputError(f"{path}: found a pickle, which is never loaded: expected safetensors, {file_format}")
        with safe_open(path, framework="pt") as file:
            texts: dict[str, str] = file.metadata() or {}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except SafetensorError as error:
        raise InputError(f"{path}: damaged, or not a safetensors file ({error}); expected {file_format}") from error
    if texts.get("format") != file_format:
        found = f"format {texts['format']}" if "format" in texts else "no format version"
        raise InputError(f"{path}: found {found}, expected {file_format}")
    return texts


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """CRC-32 of names, types, shapes and values."""
    checksum = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        checksum = zlib.crc32(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode(), checksum)
        checksum = zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy().data, checksum)
    return f"{checksum:08x}"

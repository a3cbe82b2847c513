"""Crops of your own frames with known marker positions, for training networks: one file per split."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.io import read_tensors, shipped_names, write_tensors
from imgcal.networks import Queries
from imgcal.synthesis import Patches
from imgcal.types import PATCH_SIZE, BlobKind

TRAIN, HELD_OUT, CARD = "train.safetensors", "held_out.safetensors", "README.md"
TRAIN_PATCHES, HELD_OUT_PATCHES = "train_patches.safetensors", "held_out_patches.safetensors"
ADAPTATION = (
    "training.steps=400",
    "training.validate_every=50",
    "training.save_every=100",
    "training.validation_rigs=96",
    "training.patience=4",
    "optimizer.lr=1.0e-3",
    "optimizer.ema=0.98",
)
"""A short training that ends when held-out frames improve no further: some minutes on one core."""
LARGEST_SHIFT = 14.0
"""Crop pixels, each axis: largest shift of a camera that has drifted; a window of the network reaches 22."""
NARROW = 3.0
"""Crop pixels, standard deviation of the shift of most cameras."""


class Samples:
    """Tensors with one row for each sample, in a file of their own."""

    FORMAT: ClassVar[str]
    NOUN: ClassVar[str]

    @classmethod
    def names(cls) -> list[str]:
        """Names of the tensors; the first has the number of samples."""
        return [field.name for field in fields(cls)]  # type: ignore[arg-type]

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Expected shapes of the tensors that are not (M,)."""
        raise NotImplementedError

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {name: getattr(self, name) for name in self.names()}

    def __len__(self) -> int:
        return len(getattr(self, self.names()[0]))

    def select(self, rows: Tensor) -> Self:
        """Select samples by row."""
        return type(self)(*(tensor[rows] for tensor in self.tensors().values()))

    def save(self, path: str | Path, about: Mapping[str, Any]) -> None:
        """Write a file in one step; `about` has plain values that describe the origin of the samples."""
        write_tensors(path, self.tensors(), self.FORMAT, {"about": json.dumps(about)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load what `save` wrote.

        Raises:
            InputError: no such file, another kind of file, or inconsistent tensors.
        """
        tensors, _ = read_tensors(path, cls.FORMAT)
        if set(tensors) != set(cls.names()):
            found = ", ".join(sorted(tensors))
            raise InputError(f"{path}: found tensors {found}, expected {', '.join(cls.names())}")
        samples = cls(**tensors)
        shapes = dict.fromkeys(tensors, (len(samples),)) | samples.shapes()
        for name in cls.names():
            if tuple(tensors[name].shape) != shapes[name]:
                raise InputError(f"{path}: {name}: found shape {tuple(tensors[name].shape)}, expected {shapes[name]}")
        if not len(samples):
            raise InputError(f"{path}: found no {cls.NOUN}, expected some")
        return samples


@dataclass(frozen=True)
class FrameDataset(Samples):
    """Crops of frames with the projections of an object's fiducials: M crops, up to N fiducials each.

    Brightness is relative to the background of a crop, in units of its markers: the background is about 0, a marker
    about 1.
    """

    FORMAT, NOUN = "imgcal-frames/1", "crops"

    crops: Tensor  # (M, S, S) float16, NaN outside the image
    place: Tensor  # (M, N, 2) float32, crop pixels: fiducials projected with the calibrated rig
    sigma: Tensor  # (M, N) float32, crop pixels: standard deviation of each axis of `place`
    radius: Tensor  # (M, N) float32, crop pixels, of the markers' images
    depth: Tensor  # (M, N) float32, distance from the camera's plane over the mean of all fiducials, minus 1
    asked: Tensor  # (M, N) bool: a fiducial in the crop; otherwise only padding
    seen: Tensor  # (M, N) bool: the frame shows the marker
    camera: Tensor  # (M,) int64, index in the rig
    snapshot: Tensor  # (M,) int64, index in the capture

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """See `Samples.shapes`."""
        each = len(self), self.place.shape[1]
        found = dict.fromkeys(("sigma", "radius", "depth", "asked", "seen"), each)
        return found | {"crops": (len(self), *self.crops.shape[1:2] * 2), "place": (*each, 2)}

    def to(self, device: torch.device) -> FrameDataset:
        """Move to a device."""
        return FrameDataset(*(tensor.to(device) for tensor in self.tensors().values()))


@dataclass(frozen=True)
class PatchDataset(Samples):
    """Patches at full scale around the markers of frames, for the measurer: M of them.

    Light is measured as in `FrameDataset`, in units of the patch's own marker.
    """

    FORMAT, NOUN = "imgcal-patches/1", "patches"

    light: Tensor  # (M, 24, 24) float16
    radius: Tensor  # (M,) float32, patch pixels, of the marker's image
    offset: Tensor  # (M, 2) float32, patch pixels, from the middle of the patch to where the calibrated rig has it
    camera: Tensor  # (M,) int64, index in the rig
    snapshot: Tensor  # (M,) int64, index in the capture

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """See `Samples.shapes`."""
        return {"light": (len(self), PATCH_SIZE, PATCH_SIZE), "offset": (len(self), 2)}

    def as_patches(self) -> Patches:
        """Give the patches as rendered ones are given: whole markers."""
        kind = torch.full((len(self),), int(BlobKind.WHOLE), device=self.light.device)
        return Patches(self.light.float(), self.radius, self.offset, kind)


def load_patches(folder: str | Path) -> tuple[PatchDataset, PatchDataset]:
    """Load the patches of a dataset of `imgcal harvest`: for training, and held out.

    Raises:
        InputError: see `Samples.load`.
    """
    return PatchDataset.load(Path(folder) / TRAIN_PATCHES), PatchDataset.load(Path(folder) / HELD_OUT_PATCHES)


def load_splits(folder: str | Path) -> tuple[FrameDataset, FrameDataset]:
    """Load a dataset of `imgcal harvest`: the training crops and the held-out crops.

    Raises:
        InputError: see `Samples.load`; or crops of different sizes.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a dataset of `imgcal harvest`")
    train, held_out = FrameDataset.load(folder / TRAIN), FrameDataset.load(folder / HELD_OUT)
    if train.crops.shape[1:] != held_out.crops.shape[1:]:
        raise InputError(f"{folder}: found crops of different sizes in {TRAIN} and {HELD_OUT}")
    return train, held_out


def turn(crops: FrameDataset, generator: torch.Generator) -> FrameDataset:
    """Rotate and mirror all crops together, by a random multiple of 90 degrees: markers look the same either way."""
    quarters, mirrored = (int(n) for n in torch.randint(0, 4, (2,), generator=generator, device=generator.device))
    light, place, last = crops.crops, crops.place, crops.crops.shape[-1] - 1
    if mirrored % 2:
        light, place = light.flip(-1), torch.stack((last - place[..., 0], place[..., 1]), -1)
    for _ in range(quarters):  # counterclockwise: columns become rows
        light, place = light.rot90(1, (-2, -1)), torch.stack((place[..., 1], last - place[..., 0]), -1)
    return replace(crops, crops=light, place=place)


def thin(crops: FrameDataset, most: int, generator: torch.Generator) -> FrameDataset:
    """Keep `most` fiducials a crop, those nearest to one that is drawn: as many as a tile has, in a tile's time."""
    if crops.place.shape[1] <= most:
        return crops
    drawn = torch.multinomial(crops.asked.float() + 1e-9, 1, generator=generator)
    middle = crops.place.gather(1, drawn[..., None].expand(-1, 1, 2))
    far = (crops.place - middle).norm(dim=-1).masked_fill(~crops.asked, torch.inf)
    kept = far.argsort(1)[:, :most]
    values = {name: getattr(crops, name).gather(1, kept) for name in ("sigma", "radius", "depth", "asked", "seen")}
    place = crops.place.gather(1, kept[..., None].expand(-1, -1, 2))
    return replace(crops, place=place, **values)


def expect_elsewhere(crops: FrameDataset, generator: torch.Generator, near: bool) -> Queries:
    """Build queries for the fiducials at the positions that a drifted rig would predict.

    Args:
        crops: M crops.
        generator: source of randomness.
        near: smaller errors, as of a rig that was fitted to a first look.
    """
    count, device = len(crops), crops.place.device

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, device=device)

    def unit(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, device=device)

    asked = crops.asked[..., None].to(crops.place)
    centre = (crops.place * asked).sum(1, keepdim=True) / asked.sum(1, keepdim=True).clamp(min=1)
    spread = torch.where(unit(count, 1, 1) < 0.3, 0.15, 0.02)  # rotated or tilted a lot, or a little
    strain = spread * normal(count, 2, 2) * (0.2 if near else 1.0)
    wide = unit(count, 1, 1) < 0.5
    shift = torch.where(wide, LARGEST_SHIFT * (2 * unit(count, 1, 2) - 1), NARROW * normal(count, 1, 2))
    shift = 0.8 * normal(count, 1, 2) if near else shift.clamp(-LARGEST_SHIFT, LARGEST_SHIFT)
    expected = crops.place + (crops.place - centre) @ strain + shift
    size = crops.crops.shape[-1]
    inside = ((expected > -0.5) & (expected < size - 0.5)).all(-1)
    radius = crops.radius * (1 + 0.1 * normal(count, 1))
    return Queries(expected, radius.clamp(min=0.05), crops.depth, crops.asked & inside)


def adaptation(name: str, folder: str | Path) -> list[str]:
    """Return changes to an experiment that train its shipped network further on your own frames.

    Args:
        name: name of the experiment.
        folder: a dataset of `imgcal harvest`.

    Examples:
        >>> adaptation("ir-cnn", "dataset")[:2]
        ['frames="dataset"', 'training.init_from="ir-cnn"']
    """
    starts = [f"training.init_from={json.dumps(name)}"] if name in shipped_names("models", ".safetensors") else []
    return [f"frames={json.dumps(str(folder))}", *starts, *ADAPTATION]

"""Crops of your own frames with known marker positions, for training networks: one file per split."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from imgcal.errors import InputError
from imgcal.io import read_tensors, shipped_names, write_tensors
from imgcal.networks import Queries
from imgcal.synthesis import Patches
from imgcal.types import PATCH_SIZE, BlobKind

FORMAT = "imgcal-frames/1"
TRAIN, HELD_OUT, CARD = "train.safetensors", "held_out.safetensors", "README.md"
PATCHES_FORMAT = "imgcal-patches/1"
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


@dataclass(frozen=True)
class FrameDataset:
    """Crops of frames with the projections of an object's fiducials: M crops, up to N fiducials each.

    Brightness is relative to the background of a crop, in units of its markers: the background is about 0, a marker
    about 1.
    """

    crops: Tensor  # (M, S, S) float16, NaN outside the image
    place: Tensor  # (M, N, 2) float32, crop pixels: fiducials projected with the calibrated rig
    sigma: Tensor  # (M, N) float32, crop pixels: standard deviation of each axis of `place`
    radius: Tensor  # (M, N) float32, crop pixels, of the markers' images
    depth: Tensor  # (M, N) float32, distance from the camera's plane over the mean of all fiducials, minus 1
    asked: Tensor  # (M, N) bool: a fiducial in the crop; otherwise only padding
    seen: Tensor  # (M, N) bool: the frame shows the marker
    camera: Tensor  # (M,) int64, index in the rig
    snapshot: Tensor  # (M,) int64, index in the capture

    def __len__(self) -> int:
        return len(self.crops)

    @classmethod
    def cat(cls, parts: Sequence[FrameDataset]) -> FrameDataset:
        """Concatenate crops, padded to the largest number of fiducials."""
        most = max((part.place.shape[1] for part in parts), default=0)

        def pad(values: Tensor) -> Tensor:
            if values.ndim < 2 or values.dtype == torch.float16:
                return values
            rest = [0, 0] * (values.ndim - 2)
            return functional.pad(values, [*rest, 0, most - values.shape[1]])

        return cls(*(torch.cat([pad(getattr(part, field.name)) for part in parts]) for field in fields(cls)))

    def select(self, rows: Tensor) -> FrameDataset:
        """Select crops by row."""
        return FrameDataset(*(getattr(self, field.name)[rows] for field in fields(self)))

    def to(self, device: torch.device) -> FrameDataset:
        """Move to a device."""
        return FrameDataset(*(getattr(self, field.name).to(device) for field in fields(self)))

    def save(self, path: str | Path, about: Mapping[str, Any]) -> None:
        """Write a file in one step; `about` has plain values that describe the origin of the crops."""
        tensors = {field.name: getattr(self, field.name) for field in fields(self)}
        write_tensors(path, tensors, FORMAT, {"about": json.dumps(about)})


@dataclass(frozen=True)
class PatchDataset:
    """Patches at full scale around the markers of frames, for the measurer: M of them.

    Light is measured as in `FrameDataset`, in units of the patch's own marker.
    """

    light: Tensor  # (M, 24, 24) float16
    radius: Tensor  # (M,) float32, patch pixels, of the marker's image
    offset: Tensor  # (M, 2) float32, patch pixels, from the middle of the patch to where the calibrated rig has it
    camera: Tensor  # (M,) int64, number in the rig
    snapshot: Tensor  # (M,) int64, number in the capture

    def __len__(self) -> int:
        return len(self.light)

    @classmethod
    def cat(cls, parts: Sequence[PatchDataset]) -> PatchDataset:
        """Concatenate patches."""
        return cls(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def select(self, rows: Tensor) -> PatchDataset:
        """Keep the patches of these rows."""
        return PatchDataset(*(getattr(self, field.name)[rows] for field in fields(self)))

    def as_patches(self) -> Patches:
        """Give the patches as rendered ones are given: whole markers."""
        kind = torch.full((len(self),), int(BlobKind.WHOLE), device=self.light.device)
        return Patches(self.light.float(), self.radius, self.offset, kind)

    def save(self, path: str | Path, about: Mapping[str, Any]) -> None:
        """Write a file in one step; see `FrameDataset.save`."""
        tensors = {field.name: getattr(self, field.name) for field in fields(self)}
        write_tensors(path, tensors, PATCHES_FORMAT, {"about": json.dumps(about)})


def load_patches(folder: str | Path) -> tuple[PatchDataset, PatchDataset]:
    """Read the patches of a dataset of `imgcal harvest`: to learn from, and held out.

    Raises:
        InputError: no such files, or something else in them.
    """
    found = []
    for name in (TRAIN_PATCHES, HELD_OUT_PATCHES):
        path = Path(folder) / name
        tensors, _ = read_tensors(path, PATCHES_FORMAT)
        names = [field.name for field in fields(PatchDataset)]
        if set(tensors) != set(names):
            raise InputError(f"{path}: found tensors {', '.join(sorted(tensors))}, expected {', '.join(names)}")
        part, count = PatchDataset(**tensors), len(tensors["light"])
        shapes = {"light": (count, PATCH_SIZE, PATCH_SIZE), "offset": (count, 2)}
        for each in names:
            expected = shapes.get(each, (count,))
            if tuple(tensors[each].shape) != expected:
                raise InputError(f"{path}: {each}: found shape {tuple(tensors[each].shape)}, expected {expected}")
        if not count:
            raise InputError(f"{path}: found no patches, expected some")
        found.append(part)
    return found[0], found[1]


def load_frames(path: str | Path) -> FrameDataset:
    """Load crops that `FrameDataset.save` wrote.

    Raises:
        InputError: no such file, another kind of file, or inconsistent tensors.
    """
    tensors, _ = read_tensors(path, FORMAT)
    names = [field.name for field in fields(FrameDataset)]
    if set(tensors) != set(names):
        raise InputError(f"{path}: found tensors {', '.join(sorted(tensors))}, expected {', '.join(names)}")
    found = FrameDataset(**tensors)
    count, fiducials = len(found), found.place.shape[1]
    shapes = {
        "crops": (count, *found.crops.shape[1:2] * 2),
        "place": (count, fiducials, 2),
        **dict.fromkeys(("sigma", "radius", "depth", "asked", "seen"), (count, fiducials)),
        **dict.fromkeys(("camera", "snapshot"), (count,)),
    }
    for name, shape in shapes.items():
        if tuple(tensors[name].shape) != shape:
            raise InputError(f"{path}: {name}: found shape {tuple(tensors[name].shape)}, expected {shape}")
    if not count:
        raise InputError(f"{path}: found no crops, expected some")
    return found


def load_splits(folder: str | Path) -> tuple[FrameDataset, FrameDataset]:
    """Load a dataset of `imgcal harvest`: the training crops and the held-out crops.

    Raises:
        InputError: see `load_frames`; or crops of different sizes.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a dataset of `imgcal harvest`")
    train, held_out = load_frames(folder / TRAIN), load_frames(folder / HELD_OUT)
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
    values = {field.name: getattr(crops, field.name) for field in fields(crops)}
    return FrameDataset(**values | {"crops": light, "place": place})


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

"""Measure blobs again by a network: half-hidden and unevenly lit markers, for which a fitted ellipse is off."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.detection import Blobs, DetectionOptions, Frame
from imgcal.errors import InputError
from imgcal.io import model_file, nearest, shipped_names
from imgcal.networks import Measurer, cut_patches, load_measurer, normalize_crops
from imgcal.types import UNUSABLE, BlobFlag, BlobKind, Detections

REDUCED = 3.5  # radius in patch pixels after scaling by `cut_patches`
LEAST_SIGMA = 0.02  # patch pixels: limit of the network's accuracy
FARTHEST = 1.5  # maximum displacement of a centre, in radii
LIKELY, SURE = 0.5, 0.8  # probability of a kind: to learn sizes from whole markers, and to flag others
SMALLEST = 0.5  # minimum radius of a part of a marker, as a share of the markers' radius
SEVERAL = 4  # minimum number of whole markers for a camera's typical radius


Columns = TypeVar("Columns", Blobs, Detections)


@dataclass(frozen=True)
class Remeasured:
    """A network's measurements of K blobs."""

    uv: NDArray[np.float64]  # (K, 2) pixels
    sigma: NDArray[np.float64]  # (K,) pixels
    kind: NDArray[np.float64]  # (K, 4) probabilities of BlobKind
    radius: NDArray[np.float64]  # (K,) pixels, expected radius of the markers


@dataclass(frozen=True)
class LearnedMeasurer:
    """Measures blobs again, and classifies them as whole markers, parts of markers, merged, or none.

    A fitted ellipse is as accurate as the noise allows if a marker is whole and evenly lit: those keep their centres.
    Partial ones get the network's centre and sigma; merged ones and non-markers are flagged.
    """

    network: Measurer
    name: str = "measurer"

    @classmethod
    def load(cls, path: str) -> LearnedMeasurer:
        """Load one: a file, the folder of a run, or the name of a shipped one.

        Raises:
            InputError: there is no such file, or it contains something else.
        """
        file = model_file(path)
        if not file.is_file():
            known = [name for name in shipped_names("models", ".safetensors") if name.startswith("measurer")]
            raise InputError(
                f"measurer: found {path!r:.80}{nearest(path, known)}, expected {', '.join(known)} (shipped), or a "
                "network that measures blobs: a file, or the folder of a run of `imgcal train measurer-cnn`"
            )
        return cls(load_measurer(file).network, path)

    def __call__(self, frames: Mapping[str, Frame | None], blobs: Columns, options: DetectionOptions) -> Columns:
        """Measure the blobs of one snapshot again.

        Args:
            frames: camera name -> frame (H, W), in the order of `blobs.camera`.
            blobs: the blobs found in them.
            options: how they were found.
        """
        if not len(blobs.uv):
            return blobs
        output = self.measure(frames, blobs, options)
        moved = np.linalg.norm(output.uv - blobs.uv, axis=1)
        taken = (output.kind.argmax(1) == BlobKind.PARTIAL) & (moved < FARTHEST * output.radius)
        flags = blobs.flags.copy()
        flags[output.kind[:, BlobKind.MERGED] > SURE] |= np.uint8(BlobFlag.MERGED)
        flags[output.kind[:, BlobKind.FALSE] > SURE] |= np.uint8(BlobFlag.REFLECTION)
        uv = np.where(taken[:, None], output.uv, blobs.uv)
        sigma = np.where(taken, output.sigma, blobs.sigma)
        return replace(blobs, uv=uv, sigma=sigma, flags=flags)

    def of_snapshots(
        self, frames: Callable[[int], Mapping[str, Frame | None]], blobs: Detections, options: DetectionOptions
    ) -> Detections:
        """Measure the blobs of several snapshots again.

        Args:
            frames: frames of a snapshot by its number: camera name -> frame.
            blobs: the blobs found in them.
            options: how they were found.
        """
        uv, sigma, flags = blobs.uv.copy(), blobs.sigma.copy(), blobs.flags.copy()
        for snapshot in np.unique(blobs.snapshot).tolist():
            rows = np.flatnonzero(blobs.snapshot == snapshot)
            shown = frames(snapshot)
            part = self({name: shown.get(name) for name in blobs.camera_names}, blobs.select(rows), options)
            uv[rows], sigma[rows], flags[rows] = part.uv, part.sigma, part.flags
        return replace(blobs, uv=uv, sigma=sigma, flags=flags)

    @torch.no_grad()
    def measure(
        self, frames: Mapping[str, Frame | None], blobs: Blobs | Detections, options: DetectionOptions
    ) -> Remeasured:
        """Run the network on K blobs, again with the radius of whole markers for parts; arguments as for `__call__`."""
        radius = np.nan_to_num(blobs.radius, nan=REDUCED).clip(1.0)
        first = self._ask(frames, blobs, radius, options)
        whole = (first.kind[:, BlobKind.WHOLE] > LIKELY) & ((blobs.flags & int(UNUSABLE)) == 0)
        usual = _usual(radius, whole, blobs.camera)
        larger = (radius > SMALLEST * usual) & (radius < usual) & ~whole
        return self._ask(frames, blobs, np.where(larger, usual, radius), options) if larger.any() else first

    def _ask(
        self,
        frames: Mapping[str, Frame | None],
        blobs: Blobs | Detections,
        radius: NDArray[np.float64],
        options: DetectionOptions,
    ) -> Remeasured:
        """Run the network on blobs whose markers have these radii (K,)."""
        names = list(frames)
        scale = np.clip(np.round(radius / REDUCED), 1, 64).astype(np.int64)
        # Cut out blobs of one camera and one scale together: each row of `cut_patches` is such a group.
        groups, group = np.unique(np.stack([blobs.camera, scale], axis=1), axis=0, return_inverse=True)
        group = group.reshape(-1)
        place = _places(group)
        shape = (len(groups), int(place.max()) + 1)
        uv, size = np.zeros((*shape, 2)), np.repeat(REDUCED * groups[:, 1:], shape[1], axis=1)
        uv[group, place], size[group, place] = blobs.uv, REDUCED * scale
        of_camera = tuple(names[camera] for camera in groups[:, 0])
        patches, placement = cut_patches(
            frames, of_camera, torch.from_numpy(uv), torch.from_numpy(size), inverted=options.polarity == "dark"
        )
        rows, columns = torch.from_numpy(group), torch.from_numpy(place)
        reduced = torch.from_numpy(radius / scale).float()
        output = self.network(normalize_crops(patches[rows, columns]), reduced)
        corner, by = placement.corner[rows, columns], placement.scale[rows, columns]
        sigma = (output.log_sigma.double().exp().square() + LEAST_SIGMA**2).sqrt() * by
        uv = corner + by[:, None] * (output.offset.double() + placement.size / 2)
        return Remeasured(uv.numpy(), sigma.numpy(), output.kind.softmax(-1).double().numpy(), radius)


def _usual(radius: NDArray[np.float64], whole: NDArray[np.bool_], camera: NDArray[np.int64]) -> NDArray[np.float64]:
    """Radius (K,) of whole markers in each blob's camera, or in all cameras if it shows few; nan = unknown."""
    usual = np.full(len(radius), np.median(radius[whole]) if whole.any() else np.nan)
    for one in np.unique(camera[whole]):
        here = whole & (camera == one)
        if here.sum() >= SEVERAL:
            usual[camera == one] = np.median(radius[here])
    return usual


def _places(group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number the members of each group: (K,)."""
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    place = np.empty_like(group)
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)
    return place

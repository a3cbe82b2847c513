"""Inputs of the query network: crops where a rig and poses expect the object, and queries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from imgcal.geometry import RigidTransform
from imgcal.networks.infrared import Queries
from imgcal.networks.measurer import RADIUS
from imgcal.types import CROP_MARGIN, PATCH_SIZE, CalibrationObject, CameraRig, CropPlacement

USUAL_RADIUS = 0.05  # of an object's size, if it does not specify the size of its markers

Frames = Mapping[str, NDArray[np.uint8] | NDArray[np.uint16] | None]


@dataclass(frozen=True)
class Expectation:
    """Fiducials predicted from H poses."""

    uv: Tensor  # (H, C, N, 2) pixels
    radius: Tensor  # (H, C, N) pixels
    depth: Tensor  # (H, C, N) mm
    visible: Tensor  # (H, C, N) bool

    @classmethod
    def of(
        cls, rig: CameraRig, obj: CalibrationObject, rig_from_object: RigidTransform, usual: float | None = None
    ) -> Expectation:
        """Project an object at poses (H,) into a rig without batch axes.

        Args:
            rig: the cameras.
            obj: the object.
            rig_from_object: poses (H,).
            usual: mm, radius of the markers if the object does not specify it; None = derived from its size.
        """
        points = rig_from_object.apply(obj.points.to(rig.focal_length))
        seen = rig.expand(len(points)).project(points)
        usual = USUAL_RADIUS * obj.size if usual is None else usual
        size = obj.points.new_full((obj.num_fiducials,), usual) if obj.radius is None else obj.radius
        focal = rig.focal_length.mean(-1)[:, None]  # (C, 1)
        radius = focal * size.to(focal) / seen.depth.clamp(min=1e-3)
        return cls(seen.uv, radius, seen.depth, seen.visible)

    def placement(self, rig: CameraRig, size: int) -> CropPlacement:
        """Place crops around the predictions of all poses: (C,)."""
        uv, visible = self.uv.movedim(0, 1).flatten(1, 2), self.visible.movedim(0, 1).flatten(1, 2)
        return CropPlacement.around(uv, visible, CROP_MARGIN * rig.focal_length.mean(-1), size)

    def queries(self, placement: CropPlacement, shift: Tensor | None = None) -> Queries:
        """Build queries for all fiducials in all poses: (H C, N).

        Args:
            placement: (C,) of the crops.
            shift: (H, C, 2) pixels, known image shift of the cameras; None = unknown.
        """
        uv = self.uv if shift is None else self.uv + shift[..., None, :]
        place = placement.to_crop(uv)
        inside = ((place > -0.5) & (place < placement.size - 0.5)).all(-1) & self.visible
        counted = self.visible.to(uv)
        mean = (self.depth * counted).sum(-1, keepdim=True) / counted.sum(-1, keepdim=True).clamp(min=1)
        depth = torch.where(inside, self.depth / mean.clamp(min=1e-3) - 1, 0.0)
        place = torch.where(inside[..., None], place, placement.size / 2)
        radius = torch.where(inside, self.radius / placement.scale[..., None], 1.0)
        numbers = (place.float(), radius.float(), depth.float(), inside)
        return Queries(*(part.flatten(0, 1) for part in numbers))


def cut_crops(frames: Frames, names: tuple[str, ...], placement: CropPlacement, *, inverted: bool = False) -> Tensor:
    """Cut crops from frames, each pixel the mean of a block of the frame.

    Args:
        frames: by camera; None or absent = no frame.
        names: of the cameras, C.
        placement: (C,) of the crops; parts outside of the image become NaN.
        inverted: markers are dark on bright ground.

    Returns:
        (C, S, S) float32 grey levels.
    """
    size = placement.size
    crops = torch.full((len(names), size, size), torch.nan)
    corners = (placement.corner + 0.5).round().long().tolist()
    scales = placement.scale.long().tolist()
    for camera, (name, (column, row), scale) in enumerate(zip(names, corners, scales, strict=True)):
        frame = frames.get(name)
        if frame is None:
            continue
        height, width = frame.shape
        reach = size * scale
        top, left, bottom, right = max(row, 0), max(column, 0), min(row + reach, height), min(column + reach, width)
        if bottom <= top or right <= left:
            continue
        part = torch.from_numpy(frame[top:bottom, left:right].astype(np.float32))
        around = (left - column, column + reach - right, top - row, row + reach - bottom)
        if any(around):
            part = functional.pad(part, around, value=torch.nan)
        crops[camera] = functional.avg_pool2d(part[None], scale)[0]
    return -crops if inverted else crops


def cut_patches(
    frames: Frames, names: tuple[str, ...], uv: Tensor, radius: Tensor, *, inverted: bool = False
) -> tuple[Tensor, CropPlacement]:
    """Cut patches around places, for the measurer, downsampled until the markers of a camera are small enough.

    Args:
        frames: by camera; None or absent = no frame.
        names: of the cameras, C.
        uv: (C, N, 2) pixels.
        radius: (C, N) pixels, expected.
        inverted: markers are dark on bright ground.

    Returns:
        (C, N, 24, 24) float32 grey levels, NaN outside of the image, and their placement (C, N).
    """
    cameras, count = radius.shape
    scale = (radius.median(-1).values / RADIUS).round().clamp(1, 64)[:, None].expand(-1, count)
    corner = (uv + 0.5 - scale[..., None] * PATCH_SIZE / 2).round().nan_to_num().clamp(-1e6, 1e6)
    patches = torch.full((cameras, count, PATCH_SIZE, PATCH_SIZE), torch.nan)
    for camera, name in enumerate(names):
        frame = frames.get(name)
        if frame is None:
            continue
        step = int(scale[camera, 0])
        height, width = frame.shape
        values = np.full((count, PATCH_SIZE * step, PATCH_SIZE * step), np.nan, np.float32)
        for window, (column, row) in zip(values, corner[camera].long().tolist(), strict=True):
            top, left = (min(max(place, 0), size) for place, size in ((row, height), (column, width)))
            part = frame[top : max(row + PATCH_SIZE * step, 0), left : max(column + PATCH_SIZE * step, 0)]
            window[top - row :, left - column :][: part.shape[0], : part.shape[1]] = part
        patches[camera] = functional.avg_pool2d(torch.from_numpy(values), step)
    return -patches if inverted else patches, CropPlacement(corner - 0.5, scale, PATCH_SIZE)

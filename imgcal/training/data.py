"""Synthetic rigs, generated for every training step on the training device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from imgcal.synthesis import (
    LEVELS,
    Corruption,
    Drift,
    ImageOptions,
    PoseRange,
    Snapshots,
    host_generator,
    render_views,
    synthesize,
    synthesize_at_once,
)
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views

SPARE = 1.25  # factor on the expected number of trials

# Indices into `imgcal.synthesis.LEVELS`.
Levels = Annotated[list[Annotated[int, Field(ge=0, lt=len(LEVELS))]], Field(max_length=64)]


@dataclass(frozen=True)
class RigBatch:
    """Inputs of a network and their ground truth."""

    views: Views  # (B,)
    truth: Prediction  # (B,) float32

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for saving."""
        rig, pose = self.truth.rig, self.truth.rig_from_object
        named = {
            "uv": self.views.uv,
            "seen": self.views.seen,
            "images": self.views.images,
            "focal_length": rig.focal_length,
            "principal_point": rig.principal_point,
            "distortion": rig.distortion,
            "cam_from_rig.rotation": rig.cam_from_rig.rotation,
            "cam_from_rig.translation": rig.cam_from_rig.translation,
            "rig_from_object.rotation": pose.rotation,
            "rig_from_object.translation": pose.translation,
        }
        return {name: tensor for name, tensor in named.items() if tensor is not None}


@dataclass(frozen=True)
class Source:
    """Make batches: `show(sample(count, generator), generator)`."""

    factory: CameraRig  # float32, on the training device
    obj: CalibrationObject  # float32, on the training device
    drift: Drift
    pose_range: PoseRange
    corruption: Corruption = Corruption()
    images: ImageOptions | None = None  # None = the network takes points
    levels: tuple[int, ...] = ()  # indices of `LEVELS` for degrading equal shares of a batch's images
    good: float | None = None  # share of rigs that see everything; None = check each batch, which waits for the device
    canvas: dict[int, Tensor] = field(default_factory=dict)  # reused image memory by number of rigs: CPU only

    def sample(self, count: int, generator: torch.Generator) -> Snapshots:
        """Draw `count` random rigs; the generator is on the training device."""
        if self.good is not None:
            trials = math.ceil(SPARE * count / self.good) + 32
            return synthesize_at_once(
                self.factory, self.obj, count, trials, generator, drift=self.drift, pose_range=self.pose_range
            )
        return synthesize(self.factory, self.obj, count, generator, drift=self.drift, pose_range=self.pose_range)

    def show(self, made: Snapshots, generator: torch.Generator) -> RigBatch:
        """Make the network's inputs. Images are valid until the next call."""
        truth = Prediction(made.rig, made.rig_from_object)
        views, size = Views(uv=made.projection.uv, seen=made.projection.visible), self.factory.image_size
        if self.levels and self.images is not None:
            images, _ = draw_levels(views, size, self.obj, self.images, self.levels, generator)
            return RigBatch(Views(images=images), truth)
        if not self.corruption.nothing:
            views = self.corruption.apply(views, size, generator).views
        if self.images is None or views.uv is None or views.seen is None:
            return RigBatch(views, truth)
        canvas = self._canvas(views.uv)
        images = render_views(views.uv, views.seen, size, self.obj, self.images, quantise=True, out=canvas)
        return RigBatch(Views(images=images), truth)

    def _canvas(self, uv: Tensor) -> Tensor | None:
        """Memory for images: on a CPU, reusing it is much faster than allocating it."""
        if self.images is None or uv.device.type != "cpu":
            return None
        count, size = len(uv), self.images.size
        if count not in self.canvas:
            self.canvas[count] = uv.new_empty(count, self.factory.num_cameras, 3, size, size)
        return self.canvas[count]


def draw_levels(
    views: Views,
    image_size: Tensor,
    obj: CalibrationObject,
    options: ImageOptions,
    levels: Sequence[int],
    generator: torch.Generator,
) -> tuple[Tensor, Views]:
    """Draw images of points, (B, C, N, 2), in equal shares of the batch at the given indices of `LEVELS`.

    Where a batch cannot be divided evenly, the remainder is assigned at random: over many batches, shares are equal.

    Returns:
        Images (B, C, 3, size, size), and the views as drawn.
    """
    assert views.uv is not None and views.seen is not None
    if len(views.uv) % len(levels):
        first = int(torch.randint(len(levels), (), generator=host_generator(generator)))
        levels = (*levels[first:], *levels[:first])
    shares = zip(levels, views.uv.tensor_split(len(levels)), views.seen.tensor_split(len(levels)), strict=True)
    parts = [
        LEVELS[level].draw(Views(uv, seen), image_size, obj, options, generator)
        for level, uv, seen in shares
        if len(uv)
    ]
    drawn = [corrupted.views for _, corrupted in parts]
    uv = torch.cat([one.uv for one in drawn if one.uv is not None])
    seen = torch.cat([one.seen for one in drawn if one.seen is not None])
    return torch.cat([images for images, _ in parts]), Views(uv, seen)


def object_to(obj: CalibrationObject, device: torch.device | str) -> CalibrationObject:
    """Move an object to a device, in float32."""
    radius = None if obj.radius is None else obj.radius.to(device, torch.float32)
    points, colours = obj.points.to(device, torch.float32), obj.colours.to(device, torch.float32)
    return replace(obj, points=points, colours=colours, radius=radius)

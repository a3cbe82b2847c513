"""Crops for the query network, and their fiducials: the whole object in one crop, or its parts in many.

In a crop of a whole object of many small markers, they are smaller than any in the network's training. In tiles of
neighbours they have the usual size, and the network has as much context as for a small object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.geometry import RigidTransform
from imgcal.networks.expected_positions import USUAL_RADIUS, Expectation
from imgcal.types import CalibrationObject, CameraRig, CropPlacement

LEAST_RADIUS = 0.5  # crop pixels: smallest markers in training (`synthesis/crops.py`)
USUAL_SHARE = 0.12  # of the gap between markers: their radius, if the object does not specify it
RADIUS = 1.8  # crop pixels to which markers are downsampled in tiles: the median of training
BORDER = 14  # crop pixels from a tile's own fiducials to its edge
LEAST_NEIGHBOURS = 5.0  # fiducials per tile, on average: as in training, fewer are no constellation


@dataclass(frozen=True)
class Tiles:
    """T crops, each with up to n fiducials to locate."""

    placement: CropPlacement  # (T,)
    camera: Tensor  # (T,) the camera of each
    fiducial: Tensor  # (T, n) the fiducials to locate
    there: Tensor  # (T, n) bool: a valid entry; the others only fill the row
    counts: Tensor  # (T, n) bool: each fiducial of a camera belongs to one tile; in others it is only a neighbour
    usual: float | None = None  # mm, radius of markers if the object does not specify it; see `Expectation.of`
    divided: bool = False  # the object has many tiles per camera

    @classmethod
    def of_object(cls, rig: CameraRig, obj: CalibrationObject, poses: RigidTransform, size: int) -> Tiles:
        """Choose crops of `size` pixels around an object at poses (H,), the most likely first.

        Use one crop per camera (T = C, n = N) around all poses, or tiles around the first pose if that makes markers
        too small.
        """
        expected = Expectation.of(rig, obj, poses)
        whole = cls.whole(expected.placement(rig, size), obj.num_fiducials)
        gaps = torch.cdist(obj.points, obj.points).fill_diagonal_(torch.inf)
        usual = min(USUAL_RADIUS * obj.size, USUAL_SHARE * float(gaps.amin(1).median()))
        seen = Expectation.of(rig, obj, poses[:1], usual)
        reduced = (seen.radius[0] / whole.placement.scale[:, None])[seen.visible[0]]
        if not len(reduced) or float(reduced.median()) >= LEAST_RADIUS:
            return whole
        tiles = replace(cls.from_neighbours(seen, size), usual=usual)
        return tiles if float(tiles.there.sum(1).float().mean()) >= LEAST_NEIGHBOURS else whole

    @classmethod
    def whole(cls, placement: CropPlacement, fiducials: int) -> Tiles:
        """Locate all fiducials in one crop per camera (C,)."""
        cameras = len(placement.scale)
        every = torch.ones(cameras, fiducials, dtype=torch.bool)
        return cls(placement, torch.arange(cameras), torch.arange(fiducials).expand(cameras, -1), every, every)

    @classmethod
    def from_neighbours(cls, expected: Expectation, size: int) -> Tiles:
        """Divide the visible fiducials of one pose (1, C, N) into tiles of neighbours, side by side in each image."""
        cells = [
            _side_by_side(uv[seen], radius[seen], size)[:2]
            for uv, radius, seen in zip(expected.uv[0], expected.radius[0], expected.visible[0], strict=True)
        ]
        camera = torch.cat([torch.full((len(middle),), c) for c, (middle, _) in enumerate(cells)])
        middle, scale = (torch.cat(parts) for parts in zip(*cells, strict=True))
        corner = torch.round(middle + 0.5 - scale[:, None] * size / 2) - 0.5
        placement = CropPlacement(corner, scale, size)
        uv, visible = expected.uv[0, camera], expected.visible[0, camera]  # (T, N)
        # Each belongs to the tile with the nearest centre; neighbours are all others in the crop.
        off = (uv - middle[:, None]).abs().amax(-1)
        nearest = torch.stack([off[camera == c].argmin(0) for c in camera.unique().tolist()])
        first = torch.searchsorted(camera, camera.unique())
        counts = torch.zeros_like(visible)
        counts[first[:, None] + nearest, torch.arange(visible.shape[1])] = True
        place = placement.to_crop(uv)
        there = ((place > 0) & (place < size - 1)).all(-1) & visible
        counts &= there
        order = there.to(torch.int8).argsort(dim=1, descending=True, stable=True)[:, : int(there.sum(1).max())]
        return cls(placement, camera, order, there.gather(1, order), counts.gather(1, order), divided=True)

    def select_cameras(self, cameras: Tensor) -> Tiles:
        """Locate fiducials only in the given cameras, (C,) bool."""
        return replace(self, there=self.there & cameras[self.camera, None])

    def arrange_expected(self, expected: Expectation) -> Expectation:
        """Rearrange expectations (H, C, N) by tile: (H, T, n)."""
        if not self.divided:  # keeps the memory layout, and with it the rounding of sums
            return expected
        uv, radius, depth, visible = (
            values[:, self.camera[:, None], self.fiducial]
            for values in (expected.uv, expected.radius, expected.depth, expected.visible)
        )
        return Expectation(uv, radius, depth, visible & self.there)

    def join(self, values: Tensor, cameras: int, fiducials: int) -> Tensor:
        """Rearrange values (T, n, ...) by camera: (C, N, ...), zero for fiducials without a tile."""
        if not self.divided:
            return values
        whole = values.new_zeros(cameras, fiducials, *values.shape[2:])
        whole[self.camera[:, None].expand_as(self.fiducial)[self.counts], self.fiducial[self.counts]] = values[
            self.counts
        ]
        return whole

    def sum_by_camera(self, values: Tensor, cameras: int) -> Tensor:
        """Sum the values (T, n, ...) that belong to tiles by camera: (C, ...)."""
        if not self.divided:
            return values.sum(1)
        counted = (values * self.counts.view(*self.counts.shape, *[1] * (values.ndim - 2))).sum(1)
        return counted.new_zeros(cameras, *counted.shape[1:]).index_add(0, self.camera, counted)


def _side_by_side(uv: Tensor, radius: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Place tiles on the fiducials (M, 2) px that a camera sees, if any: centres (T, 2) px and scales (T,)."""
    if not len(uv):
        return uv, radius
    scale = (radius.median() / RADIUS).round().clamp(min=1)
    low, high = uv.amin(0), uv.amax(0)
    columns, rows = ((high - low) / (scale * (size - 2 * BORDER))).ceil().clamp(min=1).long().tolist()
    step = (high - low) / uv.new_tensor((columns, rows))
    u, v = (low[i] + step[i] * (torch.arange(n) + 0.5).to(uv) for i, n in enumerate((columns, rows)))
    middle = torch.cartesian_prod(u, v)
    # Drop empty tiles: the object may have holes or an outline that is not a box.
    own = ((uv[:, None] - middle).abs() <= step / 2 + 1e-6).all(-1).any(0)
    return middle[own], scale.expand(int(own.sum()))

"""Which crops of the cameras are looked at, and for which fiducials: the whole object in one, or its parts in many.

A crop of a whole object of many small markers shows them smaller than the network has ever seen any. In tiles of
neighbours they are as large as in its training, and the network knows neither more nor less than of a small object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.geometry import RigidTransform
from imgcal.networks.expected_positions import USUAL_RADIUS, Expectation
from imgcal.types import CalibrationObject, CameraRig, CropPlacement

LEAST_RADIUS = 0.5  # crop pixels: of smaller markers there were none in training (`synthesis/crops.py`)
USUAL_SHARE = 0.12  # of the gap between markers: their radius, where the object does not say it
RADIUS = 1.8  # crop pixels that markers are reduced to in tiles: the median of training
BORDER = 14  # crop pixels from a tile's own fiducials to its edge
LEAST_NEIGHBOURS = 5.0  # fiducials a tile, on average: as in training, fewer are no constellation


@dataclass(frozen=True)
class Tiles:
    """T crops, in each of which up to n fiducials are looked for."""

    placement: CropPlacement  # (T,)
    camera: Tensor  # (T,) the camera of each
    fiducial: Tensor  # (T, n) what is looked for
    there: Tensor  # (T, n) bool: not only to fill the row
    counts: Tensor  # (T, n) bool: each fiducial of a camera counts in one tile, in others it is a neighbour of theirs
    usual: float | None = None  # mm, radius of markers where the object does not say it; see `Expectation.of`
    divided: bool = False  # the object has many tiles a camera

    @classmethod
    def of_object(cls, rig: CameraRig, obj: CalibrationObject, poses: RigidTransform, size: int) -> Tiles:
        """Choose crops of `size` pixels around an object at poses (H,), the likeliest first.

        One crop a camera (T = C, n = N) around all poses; tiles around the first where that makes markers too small.
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
        """Look for all fiducials in one crop a camera (C,)."""
        cameras = len(placement.scale)
        every = torch.ones(cameras, fiducials, dtype=torch.bool)
        return cls(placement, torch.arange(cameras), torch.arange(fiducials).expand(cameras, -1), every, every)

    @classmethod
    def from_neighbours(cls, expected: Expectation, size: int) -> Tiles:
        """Cut what one pose (1, C, N) puts in view into tiles of neighbours, side by side in each image."""
        cells = [
            _side_by_side(uv[seen], radius[seen], size)[:2]
            for uv, radius, seen in zip(expected.uv[0], expected.radius[0], expected.visible[0], strict=True)
        ]
        camera = torch.cat([torch.full((len(middle),), c) for c, (middle, _) in enumerate(cells)])
        middle, scale = (torch.cat(parts) for parts in zip(*cells, strict=True))
        corner = torch.round(middle + 0.5 - scale[:, None] * size / 2) - 0.5
        placement = CropPlacement(corner, scale, size)
        uv, visible = expected.uv[0, camera], expected.visible[0, camera]  # (T, N)
        # Each counts where it is nearest to the middle; neighbours are all that the crop shows.
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
        """Look for nothing in other cameras than these, (C,) bool."""
        return replace(self, there=self.there & cameras[self.camera, None])

    def arrange_expected(self, expected: Expectation) -> Expectation:
        """Arrange what is expected (H, C, N) by tile: (H, T, n)."""
        if not self.divided:  # as it lies in memory: sums then round as they always did
            return expected
        uv, radius, depth, visible = (
            values[:, self.camera[:, None], self.fiducial]
            for values in (expected.uv, expected.radius, expected.depth, expected.visible)
        )
        return Expectation(uv, radius, depth, visible & self.there)

    def join(self, values: Tensor, cameras: int, fiducials: int) -> Tensor:
        """Arrange values (T, n, ...) by camera: (C, N, ...), zero where no tile says anything."""
        if not self.divided:
            return values
        whole = values.new_zeros(cameras, fiducials, *values.shape[2:])
        whole[self.camera[:, None].expand_as(self.fiducial)[self.counts], self.fiducial[self.counts]] = values[
            self.counts
        ]
        return whole

    def sum_by_camera(self, values: Tensor, cameras: int) -> Tensor:
        """Add up what counts of values (T, n, ...) by camera: (C, ...)."""
        if not self.divided:
            return values.sum(1)
        counted = (values * self.counts.view(*self.counts.shape, *[1] * (values.ndim - 2))).sum(1)
        return counted.new_zeros(cameras, *counted.shape[1:]).index_add(0, self.camera, counted)


def _side_by_side(uv: Tensor, radius: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Place tiles of one camera on what it sees, (M, 2) px, if anything: middles (T, 2) px and scales (T,)."""
    if not len(uv):
        return uv, radius
    scale = (radius.median() / RADIUS).round().clamp(min=1)
    low, high = uv.amin(0), uv.amax(0)
    columns, rows = ((high - low) / (scale * (size - 2 * BORDER))).ceil().clamp(min=1).long().tolist()
    step = (high - low) / uv.new_tensor((columns, rows))
    u, v = (low[i] + step[i] * (torch.arange(n) + 0.5).to(uv) for i, n in enumerate((columns, rows)))
    middle = torch.cartesian_prod(u, v)
    # Where the object has a hole, or its edge is not that of a box, there is nothing to look for.
    own = ((uv[:, None] - middle).abs() <= step / 2 + 1e-6).all(-1).any(0)
    return middle[own], scale.expand(int(own.sum()))

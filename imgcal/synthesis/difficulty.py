"""What makes frames hard, as settings with names: light, motion, focus, clutter, hidden and uneven markers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.geometry import RigidTransform
from imgcal.types import CameraRig
from renderers import BlobRange, ClutterModel, SensorModel, Smear, Spots, Surface, drape_spots

Interval = tuple[float, float]
NONE: Interval = (0.0, 0.0)
MOMENT = 1e-3  # of the exposure: how far apart two poses are whose difference is the speed


@dataclass(frozen=True)
class Difficulty:
    """How frames of a capture are disturbed. Values are uniform in their intervals, drawn for every snapshot unless
    stated otherwise.

    Examples:
        >>> Difficulty(peak_snr=(1.0, 3.0)).peak_snr
        (1.0, 3.0)
        >>> Difficulty(hidden=1.5)
        Traceback (most recent call last):
        ValueError: hidden must be a share, found 1.5
    """

    peak_snr: Interval | None = None  # middle of a marker above the ground over the noise of one pixel; None = bright
    exposure_ms: Interval = NONE  # time during which the object moves
    speed: Interval = NONE  # mm/s, of the object's centroid, in any direction
    turn_deg: Interval = NONE  # degrees/s about the centroid, any axis
    defocus: Interval = NONE  # px, radius of the disc of confusion, one for each camera
    clutter: ClutterModel | None = None  # false blobs, streaks, textures, neighbours, drapes, dark bodies
    hidden: float = 0.0  # share of the markers that are hidden altogether, each in each camera on its own
    cut: float = 0.0  # share of the markers that a straight edge cuts
    cut_diameter: Interval = (0.3, 0.7)  # share of its diameter that a cut marker loses
    limb: Interval = NONE  # darkening towards the limb, for each marker
    bumps: int = 0  # dirt and highlights on each marker
    bump_gain: Interval = NONE  # factor 1 + gain in their middle: below 0 dirt, above 0 a highlight
    vignetting: float = 0.0  # share of the light that is lost in the corners
    row_noise: float = 0.0  # grey levels

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        for name in ("hidden", "cut", "vignetting"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be a share, found {getattr(self, name)}")
        limits = {
            "peak_snr": (0.1, 1000), "exposure_ms": (0, 1000), "speed": (0, 20_000), "turn_deg": (0, 5000),
            "defocus": (0, 100), "cut_diameter": (0, 1), "limb": (0, 1), "bump_gain": (-1, 10),
        }  # fmt: skip
        for name, (least, most) in limits.items():
            low, high = getattr(self, name) or (least, most)
            if not least <= low <= high <= most:
                raise ValueError(f"{name} must be an interval within {least} to {most}, found {low} to {high}")
        if not (0 <= self.bumps <= 20 and 0 <= self.row_noise <= 1000):
            raise ValueError(f"bumps, row_noise must be 0 to 20, 0 to 1000, found {self.bumps}, {self.row_noise}")

    def sensor(self, sensor: SensorModel, generator: torch.Generator) -> SensorModel:
        """Choose the light of one snapshot."""
        if self.peak_snr is not None:
            dim = SensorModel.low_light(float(_uniform(self.peak_snr, generator)), bit_depth=sensor.bit_depth)
            sensor = replace(dim, blur=sensor.blur, polarity=sensor.polarity)
        return replace(sensor, vignetting=max(sensor.vignetting, self.vignetting), row_noise=self.row_noise)

    def smear(
        self,
        rig: CameraRig,
        rig_from_object: RigidTransform,
        points: Tensor,
        radius: Tensor | None,
        generator: torch.Generator,
    ) -> Smear | None:
        """Move the object during the exposure, and put the cameras out of focus.

        Args:
            rig: C cameras.
            rig_from_object: the pose in the middle of the exposure.
            points: (N, 3) mm, fiducials of the object.
            radius: (N,) mm, or None.
            generator: source of randomness.

        Returns:
            Of markers (C, N), or None where neither is asked for.
        """
        if self.exposure_ms[1] == 0 and self.defocus[1] == 0:
            return None
        like = rig.focal_length
        before, after = (
            rig.project(pose.apply(points), radius).uv
            for pose in self._exposure_poses(rig_from_object, points, generator)
        )
        path = (after - before) / MOMENT
        defocus = _uniform(self.defocus, generator, rig.num_cameras, 1).to(like).expand(path.shape[:-1])
        return Smear(path, defocus)

    def disguise(self, markers: Spots, generator: torch.Generator) -> Spots:
        """Cut, dirty and hide markers (C, N)."""
        size = markers.intensity.shape
        direction, share = _uniform((0, 2 * math.pi), generator, *size), _uniform(self.cut_diameter, generator, *size)
        is_cut = _uniform((0, 1), generator, *size) < self.cut
        is_hidden = _uniform((0, 1), generator, *size) < self.hidden
        markers = replace(markers, visible=markers.visible & ~is_hidden)
        normal = torch.stack([direction.cos(), direction.sin()], dim=-1).to(markers.uv)
        # The half extent of an ellipse along a direction n is sqrt(n A n).
        extent = (normal[..., None, :] @ markers.shape @ normal[..., :, None])[..., 0, 0].clamp(min=0).sqrt()
        offset = torch.where(is_cut, extent * (1 - 2 * share).to(extent), math.inf)
        surface = Surface(torch.cat([normal, offset[..., None]], dim=-1)[..., None, :])
        if self.limb[1] > 0:
            surface = replace(surface, limb=_uniform(self.limb, generator, *size).to(extent))
        if self.bumps:
            surface = replace(surface, bumps=self._bumps(size, generator).to(extent))
        if self.cut == 0 and surface.limb is None and surface.bumps is None:
            return markers
        return replace(markers, surface=surface)

    def _exposure_poses(
        self, pose: RigidTransform, points: Tensor, generator: torch.Generator
    ) -> tuple[RigidTransform, RigidTransform]:
        """Two poses a `MOMENT` of the exposure apart, around the one in its middle."""
        seconds = 1e-3 * float(_uniform(self.exposure_ms, generator))
        way = _direction(generator).to(points) * float(_uniform(self.speed, generator)) * seconds
        turn = _direction(generator).to(points) * math.radians(float(_uniform(self.turn_deg, generator))) * seconds
        centre = pose.apply(points.mean(0, keepdim=True))[0]
        cross = points.new_zeros(3, 3)
        cross[0, 1], cross[0, 2], cross[1, 2] = -turn[2], turn[1], -turn[0]
        cross = cross - cross.mT

        def at(time: float) -> RigidTransform:
            rotation = torch.linalg.matrix_exp(time * cross)
            return RigidTransform(
                rotation @ pose.rotation, centre + time * way + rotation @ (pose.translation - centre)
            )

        return at(-MOMENT / 2), at(MOMENT / 2)

    def _bumps(self, size: torch.Size, generator: torch.Generator) -> Tensor:
        away = _uniform((0, 1), generator, *size, self.bumps).sqrt()
        angle = _uniform((0, 2 * math.pi), generator, *size, self.bumps)
        radius, gain = _uniform((0.15, 0.5), generator, *away.shape), _uniform(self.bump_gain, generator, *away.shape)
        return torch.stack([away * angle.cos(), away * angle.sin(), radius, gain], dim=-1)


def behind_drapes(markers: Spots, drapes: Tensor | None) -> Spots:
    """Cut markers at the edges of drapes, if there are any."""
    return markers if drapes is None else drape_spots(markers, drapes)


def _uniform(interval: tuple[float, float], generator: torch.Generator, *shape: int) -> Tensor:
    unit = torch.rand(shape, generator=generator, dtype=torch.float64, device=generator.device)
    return interval[0] + (interval[1] - interval[0]) * unit


def _direction(generator: torch.Generator) -> Tensor:
    vector = torch.randn(3, generator=generator, dtype=torch.float64, device=generator.device)
    return vector / vector.norm()


FALSE = BlobRange(20, (3.0, 15.0), (1.0, 1.6), (0.3, 1.0), fewest=8)
GLINTS = BlobRange(5, (8.0, 30.0), (2.0, 6.0), (0.4, 1.2), fewest=2)
STREAKS = BlobRange(3, (60.0, 250.0), (15.0, 50.0), (0.3, 1.0), fewest=0)
TEXTURES = BlobRange(1, (60.0, 160.0), (1.0, 2.0), (0.1, 0.3), fewest=0)
CLUTTER = ClutterModel(GLINTS, FALSE, occluded=0.1, streaks=STREAKS, textures=TEXTURES)
HAND = Difficulty(exposure_ms=(15.0, 25.0), speed=(300.0, 1000.0), turn_deg=(30.0, 180.0), clutter=ClutterModel())

DIFFICULTIES = {
    # As `imgcal simulate` makes captures: bright markers, a few false blobs, every twentieth marker partly covered.
    "clean": Difficulty(clutter=ClutterModel()),
    # A marker's brightest pixel stands one to three standard deviations out of the noise of photons and sensor.
    "low-light": Difficulty(peak_snr=(1.0, 3.0), clutter=ClutterModel(), vignetting=0.3, row_noise=0.5),
    # A hand-held object, moved fast before long exposures: paths of one to two marker diameters.
    "motion-blur": HAND,
    # 10 to 25 false blobs of the markers' sizes, streaks and textured regions; 30 % of the markers are hidden, and
    # drapes hide more.
    "clutter": Difficulty(clutter=replace(CLUTTER, drapes=1), hidden=0.3),
    # Discs of confusion of up to a marker's size; a third of the markers touches a false blob.
    "defocus": Difficulty(defocus=(5.0, 12.0), clutter=ClutterModel(neighbours=0.35)),
    # Dim, moved and cluttered at once.
    "combined": replace(HAND, peak_snr=(2.0, 5.0), clutter=CLUTTER, hidden=0.15, vignetting=0.3, row_noise=0.5),
    # Edges cut half of the markers and hide 30 to 70 % of their diameters; drapes cut more.
    "half-hidden": Difficulty(cut=0.5, clutter=ClutterModel(drapes=2)),
    # Real spheres: dark towards the limb, dirty, with highlights, lit through a lens that darkens the corners.
    "uneven": Difficulty(limb=(0.2, 0.9), bumps=4, bump_gain=(-0.9, 0.6), clutter=ClutterModel(), vignetting=0.4),
}
"""Levels with names: "clean" to "combined" are A to F of identity on frames; the last two show markers as they are."""

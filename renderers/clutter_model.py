"""Clutter that frames may show besides their markers, as counts and intervals."""

from __future__ import annotations

from dataclasses import dataclass

from renderers.sensor_model import LARGEST_LEVEL


@dataclass(frozen=True)
class BlobRange:
    """Number of blobs per frame, and the intervals that their values are drawn from uniformly."""

    count: int  # blobs in each frame
    radius: tuple[float, float]  # px, semi-major axis
    aspect: tuple[float, float]  # semi-major over semi-minor axis
    intensity: tuple[float, float]  # of the light, in units of a marker's
    fewest: int | None = None  # the number in each frame is drawn from this to `count`; None = always `count`

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if not 0 <= self.count <= 10_000:
            raise ValueError(f"count must be from 0 to 10000, found {self.count}")
        if self.fewest is not None and not 0 <= self.fewest <= self.count:
            raise ValueError(f"fewest must be from 0 to count = {self.count}, found {self.fewest}")
        for name, least, most in (("radius", 0.1, 1000.0), ("aspect", 0.01, 100.0), ("intensity", 0.0, LARGEST_LEVEL)):
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(f"{name} must be an interval within {least} to {most}, found {low} to {high}")


NO_BLOBS = BlobRange(0, (1.0, 1.0), (1.0, 1.0), (1.0, 1.0))


@dataclass(frozen=True)
class ClutterModel:
    """Clutter of a frame besides its markers."""

    reflections: BlobRange = BlobRange(2, (6.0, 30.0), (2.0, 6.0), (0.5, 2.0))
    blobs: BlobRange = BlobRange(4, (1.0, 6.0), (1.0, 1.5), (0.2, 1.0))
    occluded: float = 0.05  # probability that a dark body partly covers a marker
    occluded_diameter: tuple[float, float] = (0.1, 0.7)  # share of the marker's diameter that it covers
    streaks: BlobRange = NO_BLOBS  # specular lines of tools and edges: long and thin
    textures: BlobRange = NO_BLOBS  # extended bright regions, each with `speckles` in it
    speckles: int = 20  # small bright blobs on each of the textured regions
    neighbours: float = 0.0  # probability that a false blob of about the same size touches a marker
    neighbour_distance: tuple[float, float] = (0.8, 2.2)  # of the two centres, in radii of the marker
    drapes: int = 0  # dark sheets with straight edges that hide what lies behind
    drape_size: tuple[float, float] = (0.05, 0.2)  # from the middle to the edges, shares of the frame's height

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        low, high = self.occluded_diameter
        if not (0 <= self.occluded <= 1 and 0 <= low <= high <= 1):
            raise ValueError(f"occluded, occluded_diameter must be shares, found {self.occluded}, {low} to {high}")
        if not 0 <= self.neighbours <= 1:
            raise ValueError(f"neighbours must be a share, found {self.neighbours}")
        for name in ("neighbour_distance", "drape_size"):
            low, high = getattr(self, name)
            if not 0 <= low <= high <= 10:
                raise ValueError(f"{name} must be an interval within 0 to 10, found {low} to {high}")
        for name in ("drapes", "speckles"):
            if not 0 <= getattr(self, name) <= 1000:
                raise ValueError(f"{name} must be from 0 to 1000, found {getattr(self, name)}")

"""Realistic monochrome infrared frames: blurred, exposed and noisy ellipses with clutter and occlusion."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from renderers.compositing import Canvas, composite_windows, window_starts

# Windows reach this many standard deviations of the blur beyond the ellipse: 3e-7 of the light lies outside.
REACH_SIGMAS = 5.0
# Slabs that an ellipse is cut into: thin against the blur, and enough for a round outline without blur.
SLABS_PER_BLUR = 6.0
SLABS = (48, 512)
LARGEST_LEVEL = 1000.0  # of anything that is a share of full scale
SENSOR_LIMITS = (
    ("blur", 0, 100), ("read_noise", 0, 65535), ("shot_noise", 0, 65535), ("hot_pixels", 0, 1),
    ("exposure", 0, LARGEST_LEVEL), ("saturation", 0, LARGEST_LEVEL), ("background", -LARGEST_LEVEL, LARGEST_LEVEL),
    ("contrast", -LARGEST_LEVEL, LARGEST_LEVEL), ("hot_pixel_seed", 0, 2**63 - 1),
)  # fmt: skip
SHARP = 0.05  # blur below which the optics count as this sharp, in pixels


@dataclass(frozen=True)
class Spots:
    """Ellipses of uniform brightness in pixels."""

    uv: Tensor  # (*B, N, 2) px, centres
    shape: Tensor  # (*B, N, 2, 2) px^2, A of the boundary (x - uv)^T A^-1 (x - uv) = 1
    intensity: Tensor  # (*B, N), 1 is the sensor's contrast, 0 is a dark body that hides what lies behind
    visible: Tensor  # (*B, N) bool
    depth: Tensor  # (*B, N), smaller is nearer


@dataclass(frozen=True)
class BlobRange:
    """How many blobs a frame, and the intervals that they are drawn from, uniformly."""

    count: int
    radius: tuple[float, float]  # px, semi-major axis
    aspect: tuple[float, float]  # semi-major over semi-minor axis
    intensity: tuple[float, float]

    def __post_init__(self) -> None:
        """Refuse what no frame shows."""
        if not 0 <= self.count <= 10_000:
            raise ValueError(f"count must be from 0 to 10000, found {self.count}")
        for name, least, most in (("radius", 0.1, 1000.0), ("aspect", 0.01, 100.0), ("intensity", 0.0, LARGEST_LEVEL)):
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(f"{name} must be an interval within {least} to {most}, found {low} to {high}")


@dataclass(frozen=True)
class ClutterModel:
    """What a frame shows beside its markers."""

    reflections: BlobRange = BlobRange(2, (6.0, 30.0), (2.0, 6.0), (0.5, 2.0))
    blobs: BlobRange = BlobRange(4, (1.0, 6.0), (1.0, 1.5), (0.2, 1.0))
    occluded: float = 0.05  # probability that a dark body partly covers a marker
    occluded_diameter: tuple[float, float] = (0.1, 0.7)  # share of the marker's diameter that it covers

    def __post_init__(self) -> None:
        """Refuse shares that are none."""
        low, high = self.occluded_diameter
        if not (0 <= self.occluded <= 1 and 0 <= low <= high <= 1):
            raise ValueError(f"occluded, occluded_diameter must be shares, found {self.occluded}, {low} to {high}")


@dataclass(frozen=True)
class Clutter:
    """The truth about a frame's clutter."""

    false_blobs: Spots  # (*B, M), behind all markers
    occluders: Spots  # (*B, N), one for each marker, before all markers; visible where the marker is partly covered


@dataclass(frozen=True)
class SensorModel:
    """Optics and sensor. Levels are shares of full scale; noise is in grey levels of the chosen bit depth."""

    bit_depth: Literal[8, 12, 16] = 8  # 12 bit is stored in 16, with values up to 4095
    polarity: Literal["bright", "dark"] = "bright"  # "dark" inverts the levels: dark markers on a bright ground
    blur: float = 0.7  # px, standard deviation of the lens blur
    background: float = 0.06  # level at the centre of the frame
    gradient: tuple[float, float] = (0.0, 0.0)  # change of the background across the frame's width and height
    contrast: float = 0.7  # level that a blob of intensity 1 adds
    exposure: float = 1.0  # gain on everything that reaches the sensor
    saturation: float = 1.0  # level at which pixels are full
    read_noise: float = 2.0  # grey levels, standard deviation
    shot_noise: float = 0.0  # grey levels, standard deviation at full scale; grows with the root of the level
    hot_pixels: float = 0.0  # share of the pixels that are stuck at full scale
    hot_pixel_seed: int = 0  # the same cameras have the same hot pixels in every call

    def __post_init__(self) -> None:
        """Refuse what no sensor has."""
        if self.bit_depth not in (8, 12, 16):
            raise ValueError(f"bit_depth must be 8, 12 or 16, found {self.bit_depth}")
        if self.polarity not in ("bright", "dark"):
            raise ValueError(f"polarity must be 'bright' or 'dark', found {self.polarity!r}")
        for name, low, high in SENSOR_LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be from {low} to {high}, found {getattr(self, name)}")
        if not all(-LARGEST_LEVEL <= change <= LARGEST_LEVEL for change in self.gradient):
            raise ValueError(f"gradient must be from {-LARGEST_LEVEL} to {LARGEST_LEVEL}, found {self.gradient}")

    @property
    def full_scale(self) -> int:
        """Largest grey level."""
        return int(2**self.bit_depth - 1)


@dataclass(frozen=True)
class InfraredFrames:
    """Frames, and how much of each marker they show."""

    frames: Tensor  # (*B, H, W) uint8, or uint16 for 12 and 16 bit
    seen: Tensor  # (*B, N) share of each marker's area that is inside the frame and not hidden


def infrared_frames(
    markers: Spots,
    image_size: tuple[int, int],
    sensor: SensorModel | None = None,
    *,
    clutter: Clutter | None = None,
    generator: torch.Generator | None = None,
) -> InfraredFrames:
    """Render frames as an infrared camera would deliver them.

    Occluders hide markers, near markers hide far ones, and markers hide false blobs. Occlusion acts on the blurred
    outlines, which is exact except within the blur of a border between two blobs.

    Args:
        markers: (*B, N) ellipses in pixels; the last batch axis counts cameras.
        image_size: Height and width.
        sensor: Optics and sensor, default ``SensorModel()``.
        clutter: From ``sample_clutter``, default none.
        generator: Source of the noise, on the device of the markers.

    Returns:
        Frames and the visible share of each marker.

    Raises:
        ValueError: Shapes do not fit.
    """
    sensor = sensor or SensorModel()
    light, seen = render_blobs(markers, image_size, sensor.blur, clutter=clutter)
    return InfraredFrames(expose(light, sensor, generator=generator), seen)


def render_blobs(
    markers: Spots, image_size: tuple[int, int], blur: float, *, clutter: Clutter | None = None
) -> tuple[Tensor, Tensor]:
    """Render the light on the sensor, before exposure: ellipses blurred by the lens and integrated over pixels.

    Differentiable in the markers' centres, shapes and intensities.

    Args:
        markers: (*B, N) ellipses in pixels; what is invisible may hold NaN.
        image_size: Height and width.
        blur: Standard deviation of the lens blur in pixels.
        clutter: From ``sample_clutter``, default none.

    Returns:
        Light (*B, H, W), 0 on the ground and the intensity inside a blob, and (*B, N), the share of each marker's area
        that is inside the frame and not hidden.

    Examples:
        >>> one = torch.ones(1, 1)
        >>> disc = Spots(torch.tensor([[[16.0, 12.0]]]), 9.0 * torch.eye(2).expand(1, 1, 2, 2), one, one > 0, one)
        >>> light, _ = render_blobs(disc, (24, 32), blur=0.7)
        >>> light.shape, bool(light[0, 12, 16] > light[0, 12, 20])
        (torch.Size([1, 24, 32]), True)
    """
    batch = markers.uv.shape[:-2]
    layers = [markers] if clutter is None else [clutter.occluders, markers, clutter.false_blobs]
    canvas = Canvas.blank(math.prod(batch), 1, image_size, like=markers.uv)
    seen = [_composite(canvas, blobs, batch, image_size, max(blur, SHARP)) for blobs in layers]
    return canvas.images.view(*batch, *image_size), seen[len(layers) // 2].view(*batch, -1)


def expose(light: Tensor, sensor: SensorModel, *, generator: torch.Generator | None = None) -> Tensor:
    """Turn light into grey levels: background, exposure, saturation, noise, hot pixels, quantization.

    Args:
        light: (*B, H, W) from ``render_blobs``; the last batch axis counts cameras.
        sensor: Optics and sensor.
        generator: Source of the noise, on the device of ``light``.

    Returns:
        (*B, H, W) uint8, or uint16 for 12 and 16 bit.
    """
    height, width = light.shape[-2:]
    dtype = torch.uint8 if sensor.bit_depth == 8 else torch.uint16
    frames = torch.empty(light.shape, dtype=dtype, device=light.device)
    across_u, across_v = (torch.linspace(-0.5, 0.5, n, dtype=light.dtype, device=light.device) for n in (width, height))
    ground = sensor.background + sensor.gradient[0] * across_u + sensor.gradient[1] * across_v[:, None]
    hot = _hot_pixels(light.shape, sensor, light.device)
    # One frame at a time: the temporaries of a frame stay in the processor's cache.
    for i, (frame, target) in enumerate(
        zip(light.detach().reshape(-1, height, width), frames.view(-1, height, width), strict=True)
    ):
        level = ground + sensor.contrast * frame
        if sensor.polarity == "dark":
            level = 1 - level
        level.mul_(sensor.exposure).clamp_(0, sensor.saturation).mul_(sensor.full_scale)
        if sensor.read_noise > 0 or sensor.shot_noise > 0:
            noise = torch.empty_like(level).normal_(generator=generator)
            if sensor.shot_noise > 0:
                variance = level * (sensor.shot_noise**2 / sensor.full_scale) + sensor.read_noise**2
                level.addcmul_(noise, variance.sqrt_())
            else:
                level.add_(noise, alpha=sensor.read_noise)
        level.view(-1)[hot[i % len(hot)]] = sensor.full_scale
        target.copy_(level.round_().clamp_(0, sensor.full_scale))
    return frames


def sample_clutter(
    model: ClutterModel, markers: Spots, image_size: tuple[int, int], *, generator: torch.Generator | None = None
) -> Clutter:
    """Draw reflections, clutter blobs and occluders for every frame.

    Args:
        model: Counts and intervals.
        markers: (*B, N) markers, for the batch shape and for the occluders.
        image_size: Height and width.
        generator: On the device of the markers.

    Returns:
        The clutter, which is also the truth about it: reflections come first in ``false_blobs``.
    """
    batch = markers.uv.shape[:-2]

    def uniform(interval: tuple[float, float], *shape: int) -> Tensor:
        unit = torch.rand(*batch, *shape, generator=generator, dtype=markers.uv.dtype, device=markers.uv.device)
        return interval[0] + (interval[1] - interval[0]) * unit

    parts: dict[str, list[Tensor]] = {"uv": [], "shape": [], "intensity": []}
    height, width = image_size
    for kind in (model.reflections, model.blobs):
        major = uniform(kind.radius, kind.count)
        axes = torch.stack([major, major / uniform(kind.aspect, kind.count)], dim=-1)
        angle = uniform((0.0, math.pi), kind.count)
        cos, sin = angle.cos(), angle.sin()
        rotated = torch.stack([cos, -sin, sin, cos], dim=-1).unflatten(-1, (2, 2)) * axes[..., None, :]
        centre = uniform((-0.5, width - 0.5), kind.count), uniform((-0.5, height - 0.5), kind.count)
        parts["uv"].append(torch.stack(centre, dim=-1))
        parts["shape"].append(rotated @ rotated.mT)
        parts["intensity"].append(uniform(kind.intensity, kind.count))
    values = {name: torch.cat(tensors, dim=len(batch)) for name, tensors in parts.items()}
    always = torch.ones_like(values["intensity"], dtype=torch.bool)
    false_blobs = Spots(**values, visible=always, depth=torch.full_like(values["intensity"], math.inf))
    return Clutter(false_blobs, _occluders(model, markers, uniform))


def ellipse_coverage(
    centre: Tensor, shape: Tensor, rows: Tensor, columns: Tensor, window_size: tuple[int, int], blur: float, slabs: int
) -> Tensor:
    """Integrate blurred ellipses over the pixels of local windows.

    An ellipse is cut into horizontal slabs, thinner towards its ends. A slab is a rectangle of the slab's exact area; a
    rectangle blurred by a Gaussian and integrated over a pixel is a product of two exact terms, so the sum over slabs
    is one small matrix product. The result is point-symmetric: cutting moves no centroid.

    Args:
        centre: (P, 2) pixels.
        shape: (P, 2, 2) ellipse matrices, px^2.
        rows: (P,) first row of each window.
        columns: (P,) first column of each window.
        window_size: Height and width of the windows.
        blur: Standard deviation of the blur in pixels, positive.
        slabs: Number of slabs.

    Returns:
        (P, h, w) coverage in [0, 1].
    """
    turn = torch.linspace(0, math.pi, slabs + 1, dtype=torch.float64, device=centre.device)
    cut = -turn.cos()  # slab edges on the unit disc, from -1 to 1
    chord = ((turn - turn.sin() * turn.cos()) / 2).diff() / cut.diff()  # mean half chord of the unit disc in each slab
    edge, middle, chord = (x.to(centre.dtype) for x in (cut, (cut[1:] + cut[:-1]) / 2, chord))

    half_height = shape[:, 1, 1].sqrt()
    half_width = (torch.linalg.det(shape).clamp(min=0) / shape[:, 1, 1]).sqrt()  # of the chord through the centre
    slant = shape[:, 0, 1] / half_height
    u = (centre[:, 0] - columns)[:, None] + slant[:, None] * middle  # (P, slabs) chord centres in the window
    v = (centre[:, 1] - rows)[:, None] + half_height[:, None] * edge  # (P, slabs + 1)
    along_u = _blurred_box(u - half_width[:, None] * chord, u + half_width[:, None] * chord, window_size[1], blur)
    along_v = _blurred_box(v[:, :-1], v[:, 1:], window_size[0], blur)
    return (along_v.mT @ along_u).clamp(0, 1)


def _occluders(model: ClutterModel, markers: Spots, uniform: Callable[..., Tensor]) -> Spots:
    """Put a dark body over one side of some markers; ``uniform(interval, *shape)`` samples (*B, *shape)."""
    # Where a marker is the unit disc, its occluder is a larger disc that reaches into it from one side.
    count, radius = markers.uv.shape[-2], 1.5
    angle = uniform((0.0, 2 * math.pi), count)
    distance = 1 + radius - 2 * uniform(model.occluded_diameter, count)
    direction = torch.stack([angle.cos(), angle.sin()], dim=-1) * distance[..., None]
    root = torch.linalg.cholesky_ex(markers.shape).L
    return Spots(
        uv=markers.uv + (root @ direction[..., None])[..., 0],
        shape=markers.shape * radius**2,
        intensity=torch.zeros_like(markers.intensity),
        visible=markers.visible & (uniform((0.0, 1.0), count) < model.occluded),
        depth=markers.depth,
    )


def _blurred_box(low: Tensor, high: Tensor, length: int, blur: float) -> Tensor:
    """Blur the interval [low, high] (...) by a Gaussian and integrate it over pixels 0 .. length - 1: (..., length)."""
    edges = torch.arange(length + 1, dtype=low.dtype, device=low.device) - 0.5

    def twice_integrated(x: Tensor) -> Tensor:
        # Of a Gaussian; without the term x / 2, which cancels in the difference of neighbouring pixels.
        t = x / (math.sqrt(2) * blur)
        # Clamped, because the processor is many times slower where the exponential is denormal.
        return (x * torch.erf(t) + math.sqrt(2 / math.pi) * blur * torch.exp(-t.clamp(-6, 6).square())) / 2

    return (twice_integrated(edges - low[..., None]) - twice_integrated(edges - high[..., None])).diff(dim=-1)


def _composite(canvas: Canvas, blobs: Spots, batch: torch.Size, image_size: tuple[int, int], blur: float) -> Tensor:
    """Draw blobs behind what is on the canvas; return the (B, N) share of each blob's area that is seen."""
    count = blobs.uv.shape[-2]
    if blobs.uv.shape != (*batch, count, 2) or blobs.shape.shape != (*batch, count, 2, 2):
        expected = f"({', '.join(map(str, batch))}, N, 2) and (..., N, 2, 2)"
        raise ValueError(f"blobs need {expected}, found {tuple(blobs.uv.shape)} and {tuple(blobs.shape.shape)}")
    images = math.prod(batch)
    height, width = image_size
    half = torch.diagonal(blobs.shape, dim1=-2, dim2=-1).clamp(min=0).sqrt()  # (*B, N, 2) extent along u, v
    reach = half + REACH_SIGMAS * blur + 1
    size = torch.tensor([width, height], dtype=blobs.uv.dtype, device=blobs.uv.device)
    # A comparison with NaN is false, so what is not finite, or no ellipse, is not drawn.
    near = ((blobs.uv > -reach) & (blobs.uv < size - 1 + reach)).all(-1)
    drawn = blobs.visible & near & (half > 0).all(-1) & (torch.linalg.det(blobs.shape) > 0)
    # What is not drawn comes last and is left out of the windows.
    depth = torch.where(drawn, blobs.depth.clamp(max=torch.finfo(blobs.depth.dtype).max), math.inf)
    most = int(drawn.sum(-1).max()) if drawn.numel() else 0
    if most == 0:
        return blobs.uv.new_zeros(images, count)
    order = depth.reshape(images, count).argsort(dim=-1, stable=True)[:, :most]

    def nearest_first(values: Tensor, neutral: Tensor | float) -> Tensor:
        mask = drawn.reshape(*drawn.shape, *[1] * (values.ndim - drawn.ndim))
        flat = torch.where(mask, values, neutral).reshape(images, count, -1)
        return flat.gather(1, order[..., None].expand(-1, -1, flat.shape[-1]))

    uv = nearest_first(blobs.uv, 0.0)
    shape = nearest_first(blobs.shape, torch.eye(2, dtype=uv.dtype, device=uv.device)).unflatten(-1, (2, 2))
    intensity = nearest_first(blobs.intensity, 0.0)  # (B, N, 1)
    shown = drawn.reshape(images, count).gather(1, order)
    extent = torch.where(drawn[..., None], half.detach(), 0.0).flatten(0, -2).amax(dim=0).tolist()
    window = [min(2 * math.ceil(x + REACH_SIGMAS * blur) + 1, n) for x, n in zip(extent, (width, height), strict=True)]
    slabs = min(max(math.ceil(SLABS_PER_BLUR * max(extent) / blur), SLABS[0]), SLABS[1])
    columns, rows = (window_starts(uv[..., i], window[i], n) for i, n in enumerate((width, height)))
    coverage = ellipse_coverage(
        uv.flatten(0, 1), shape.flatten(0, 1), rows.flatten(), columns.flatten(), (window[1], window[0]), blur, slabs
    ).unflatten(0, (images, most))
    coverage = coverage * shown[..., None, None]
    seen = composite_windows(canvas, coverage, intensity, rows, columns)
    area = math.pi * torch.linalg.det(shape).clamp(min=0).sqrt()
    return seen.new_zeros(images, count).scatter(1, order, seen / area)


def _hot_pixels(shape: torch.Size, sensor: SensorModel, device: torch.device) -> Tensor:
    """Choose the stuck pixels of each camera, the last batch axis: (C, count) indices into a frame."""
    cameras = shape[-3] if len(shape) > 2 else 1
    pixels = shape[-2] * shape[-1]
    generator = torch.Generator(device).manual_seed(sensor.hot_pixel_seed)
    count = round(sensor.hot_pixels * pixels)
    return torch.randint(pixels, (cameras, count), generator=generator, device=device)

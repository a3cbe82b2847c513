"""Training crops: any rig, object and drift, and monochrome crops as bad as cameras deliver them, rendered at once.

Nothing here is a full frame. Crops are rendered at their own reduced scale, where a marker is a few pixels wide: an
ellipse under lens and pixel is a Gaussian of the same area and spread there, saturating towards its own brightness, and
motion blur along a segment is its exact integral. All of it is tensors on the device of the generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.synthesis.drawing import Draw, host_generator
from imgcal.synthesis.rigs import PhysicalDrift, RelativeDrift
from imgcal.types import CROP_MARGIN, CROP_SIZE, CameraRig, CropPlacement

PATCH = 24  # crop pixels, window that a spot is drawn in


@dataclass(frozen=True)
class Scenes:
    """Random rigs that look at random objects, B of each, all with C cameras and N fiducials."""

    factory: CameraRig  # (B,)
    rig: CameraRig  # (B,) after the drift
    points: Tensor  # (B, N, 3) mm in the object's frame
    radius: Tensor  # (B,) mm of the spherical fiducials
    rig_from_object: RigidTransform  # (B,) the truth
    expected: RigidTransform  # (B,) what is believed of it


@dataclass(frozen=True)
class CropTruth:
    """Rendered crops with what was expected in them, and what is there."""

    crops: Tensor  # (B, C, S, S) grey; NaN outside the image
    placement: CropPlacement  # (B, C)
    expected: Tensor  # (B, C, N, 2) crop pixels: by the factory rig and the believed pose
    radius: Tensor  # (B, C, N) crop pixels
    depth: Tensor  # (B, C, N) over the mean of the fiducials, minus 1
    place: Tensor  # (B, C, N, 2) crop pixels, where the markers are
    seen: Tensor  # (B, C, N) bool: enough of the marker is to be seen


def sample_scenes(rigs: int, cameras: int, fiducials: int, generator: torch.Generator) -> Scenes:
    """Draw rigs, objects, drifts and errors of the believed pose.

    Args:
        rigs: B.
        cameras: C, of each rig.
        fiducials: N, of each object.
        generator: source of randomness; its device is where all runs.
    """
    draw = Draw(generator)
    points = _objects(rigs, fiducials, draw)
    size = points.square().sum(-1).amax(-1).sqrt()  # (B,)
    distance = size * draw.between(4.0, 12.0, rigs)
    pose = RigidTransform(
        rotation_from_vector(draw.direction(rigs) * draw.between(0, math.pi, rigs, 1)), draw.zeros(rigs, 3)
    )
    factory = _cameras(rigs, cameras, distance, draw)
    host = host_generator(generator)
    relative, amount, *kappas = torch.rand(4, generator=host).tolist()
    if relative < 0.5:
        amount = 0.3 + 1.3 * amount
        rig = PhysicalDrift(amount * 0.7, amount * 3.0, amount * 0.01, amount * 6.0, amount * 0.01).apply(
            factory, generator
        )
    else:
        rig = RelativeDrift(*(0.005 + 0.035 * kappa for kappa in kappas)).apply(factory, generator)
    # Mostly about a degree off; one in three anything up to 14 degrees.
    small = draw.normal(rigs, 1).abs() * 1.5
    angle = torch.where(draw.unit(rigs, 1) < 0.33, draw.between(0.0, 14.0, rigs, 1), small)
    turn = rotation_from_vector(draw.direction(rigs) * torch.deg2rad(angle))
    aside = draw.normal(rigs, 3) * (0.012 * draw.between(0.1, 2.0, rigs, 1) * distance[:, None])
    expected = RigidTransform(turn @ pose.rotation, pose.translation + aside)
    return Scenes(factory, rig, points, size * draw.between(0.02, 0.08, rigs), pose, expected)


def render_crops(scenes: Scenes, generator: torch.Generator) -> CropTruth:
    """Render the scenes in poor quality: every crop has its own mixture of disturbances."""
    draw = Draw(generator)
    believed = scenes.factory.project(scenes.expected.apply(scenes.points))
    truth = scenes.rig.project(scenes.rig_from_object.apply(scenes.points))
    batch = believed.uv.shape[:2]
    focal = scenes.factory.focal_length[..., 0]
    ahead = believed.depth > 0
    margin = CROP_MARGIN * focal * draw.between(0.8, 1.5, *batch)
    placement = CropPlacement.around(believed.uv, ahead, margin, CROP_SIZE)
    place, expected = placement.to_crop(truth.uv), placement.to_crop(believed.uv)
    pixels = focal[..., None] * scenes.radius[:, None, None] / placement.scale[..., None]
    radius, expected_radius = pixels / truth.depth, pixels / believed.depth
    crops, seen = _photograph(place, radius, draw)
    inside = ((place > -0.5) & (place < CROP_SIZE - 0.5)).all(-1)
    depth = believed.depth / believed.depth.mean(-1, keepdim=True) - 1
    return CropTruth(crops, placement, expected, expected_radius, depth, place, seen & inside & (truth.depth > 0))


def second_look(truth: CropTruth, generator: torch.Generator) -> CropTruth:
    """Expect the fiducials where a rig fitted to a first look has them: near their places, or all shifted."""
    draw = Draw(generator)
    batch = truth.seen.shape[:2]
    apart = truth.expected - truth.place
    rest = (apart - apart.mean(2, keepdim=True)) * draw.between(0.0, 0.3, *batch, 1, 1)
    lost = torch.where(draw.unit(*batch, 1, 1) < 0.15, 12.0, 0.8)
    return replace(truth, expected=truth.place + rest + lost * draw.normal(*batch, 1, 2))


def _photograph(place: Tensor, radius: Tensor, draw: Draw) -> tuple[Tensor, Tensor]:
    """Render markers (B, C, N, 2) of crop-pixel radii (B, C, N): crops (B, C, S, S), and which are to be seen."""
    batch, count = place.shape[:2], place.shape[2]
    hidden = draw.unit(*batch, count) < draw.sometimes(0.5, 0.45, *batch)[..., None]
    velocity = draw.direction(*batch, of=2) * (draw.sometimes(0.4, 1.0, *batch).square() * 9)[..., None]
    velocities = velocity[:, :, None] * (1 + 0.1 * draw.normal(*batch, count, 1))
    blur = 0.35 + draw.sometimes(0.4, 1.8, *batch)
    uneven = draw.sometimes(0.5, 0.8, *batch)[..., None]
    brightness = (uneven * draw.normal(*batch, count)).clamp(-2, 1).exp()
    cut = torch.where(
        draw.unit(*batch, count) < draw.sometimes(0.3, 0.8, *batch)[..., None],
        draw.between(-0.6, 0.6, *batch, count),
        9.0,
    )
    markers = _Spots(place, radius, brightness * ~hidden, velocities, cut)

    false = 28
    shown = draw.unit(*batch, false) < draw.sometimes(0.6, 1.0, *batch)[..., None] ** 1.5
    typical = radius.clamp(0.3, 4).mean(-1, keepdim=True)
    strays = _Spots(
        draw.between(-2, CROP_SIZE + 1, *batch, false, 2),
        typical * draw.between(-0.7, 0.6, *batch, false).exp(),
        shown * draw.between(0.15, 1.6, *batch, false),
        torch.where(draw.unit(*batch, false, 1) < 0.5, velocity[:, :, None], 0.0).expand(*batch, false, 2),
        torch.full((*batch, false), 9.0, device=place.device),
    )
    light = _add_spots(_join(markers, strays), blur, draw) + _background(batch, draw)
    light = light.clamp(max=draw.between(0.7, 3.0, *batch)[..., None, None])
    noise = draw.between(math.log(0.0015), math.log(0.22), *batch).exp()
    shot = draw.sometimes(0.5, 1.0, *batch)[..., None, None] * light.clamp(min=0)
    level = light + noise[..., None, None] * (1 + shot).sqrt() * draw.normal(*light.shape)
    # Some crops reach over the image's border.
    columns = torch.arange(CROP_SIZE, device=light.device)
    border = torch.where(draw.unit(*batch, 1) < 0.15, draw.between(0, 40, *batch, 1), -1.0)
    outside = (columns < border)[..., None, :].expand_as(level)
    flip = draw.unit(*batch, 1, 1) < 0.5
    outside = torch.where(flip, outside.flip(-1), outside)
    least = torch.where(cut < 8, cut > -0.35, True)  # less than a fifth of the marker is not asked for
    where = place.round().clamp(0, CROP_SIZE - 1).long()
    flat = outside.flatten(2).gather(2, where[..., 1] * CROP_SIZE + where[..., 0])
    return level.masked_fill(outside, torch.nan), ~hidden & least & ~flat


def degrade_crops(
    crops: Tensor, place: Tensor, radius: Tensor, seen: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Make crops of real frames harder: blurred, moved, dark, noisy, behind drapes, among dots that are not markers.

    Args:
        crops: (P, S, S) light, in which the ground is about 0 and a marker about 1; NaN outside the image.
        place: (P, N, 2) crop pixels, where the markers are.
        radius: (P, N) crop pixels.
        seen: (P, N) bool, markers that the crops show.
        generator: source of randomness; each crop gets a mixture of its own.

    Returns:
        Crops, and which markers they still show.
    """
    draw, count = Draw(generator), len(crops)
    outside, light = crops.isnan(), crops.nan_to_num()
    size = torch.where(seen, radius, torch.nan).nanmedian(-1).values.nan_to_num(1.0).clamp(0.4, 4.0)
    light = _smear(light, draw.sometimes(0.4, 1.5, count) * size, draw.sometimes(0.4, 2.0, count) * size, draw)
    batch, dots = torch.Size((count, 1)), 28
    shown = draw.unit(*batch, dots) < draw.sometimes(0.5, 1.0, *batch)[..., None] ** 1.5
    spots = _Spots(
        draw.between(-2, CROP_SIZE + 1, *batch, dots, 2),
        size[:, None, None] * draw.between(-0.5, 0.5, *batch, dots).exp(),
        shown * draw.between(0.4, 1.1, *batch, dots),
        torch.zeros(*batch, dots, 2, device=crops.device),
        torch.full((*batch, dots), 9.0, device=crops.device),
    )
    light = light + _add_spots(spots, draw.between(0.3, 0.8, *batch), draw)[:, 0]
    cover, level = _drapes(count, draw)
    light = light + cover * (level[:, None, None] - light)
    where = place.round().clamp(0, CROP_SIZE - 1).long()
    hidden = cover.flatten(1).gather(1, where[..., 1] * CROP_SIZE + where[..., 0]) > 0.5
    dark = draw.sometimes(0.4, 1.0, count)[:, None, None] * light.clamp(min=0)
    noise = torch.where(draw.unit(count) < 0.5, draw.between(math.log(0.003), math.log(0.5), count).exp(), 0.0)
    light = light + noise[:, None, None] * (1 + dark).sqrt() * draw.normal(*light.shape)
    return light.masked_fill(outside, torch.nan), seen & ~hidden


def _smear(light: Tensor, spread: Tensor, length: Tensor, draw: Draw) -> Tensor:
    """Blur images (P, S, S) by Gaussians of standard deviation `spread` (P,), longer by `length` (P,) one way."""
    reach = PATCH // 2
    steps = torch.arange(-reach, reach + 1, device=light.device, dtype=light.dtype)
    angle = draw.between(0, math.pi, len(light))[:, None, None]
    along = steps * angle.cos() + steps[:, None] * angle.sin()
    across = steps[:, None] * angle.cos() - steps * angle.sin()
    across_variance = spread.square().clamp(min=0.02)[:, None, None]
    along_variance = across_variance + length.square()[:, None, None]
    kernel = torch.exp(-along.square() / (2 * along_variance) - across.square() / (2 * across_variance))
    kernel = kernel / kernel.sum((1, 2), keepdim=True)
    padded = functional.pad(light[None], (reach,) * 4, mode="replicate")
    return functional.conv2d(padded, kernel[:, None], groups=len(light))[0]


def _drapes(count: int, draw: Draw) -> tuple[Tensor, Tensor]:
    """Draw oblongs with edges over images, most of them without any: cover (P, S, S) in [0, 1], light (P,) of them."""
    steps = torch.arange(CROP_SIZE, device=draw.generator.device, dtype=torch.float32)
    cover = torch.zeros(count, CROP_SIZE, CROP_SIZE, device=steps.device)
    some = draw.unit(count) < 0.35
    for _ in range(4):
        angle = draw.between(0, math.pi, count)[:, None, None]
        middle, half = draw.between(0, CROP_SIZE, count, 2), draw.between(0.05, 0.35, count, 2) * CROP_SIZE
        x, y = steps - middle[:, 0, None, None], steps[:, None] - middle[:, 1, None, None]
        along, across = x * angle.cos() + y * angle.sin(), y * angle.cos() - x * angle.sin()
        inside = torch.minimum(half[:, 0, None, None] - along.abs(), half[:, 1, None, None] - across.abs())
        there = (some & (draw.unit(count) < 0.5))[:, None, None]
        cover = torch.maximum(cover, torch.sigmoid(4 * inside) * there)
    return cover, torch.where(draw.unit(count) < 0.5, draw.between(-0.3, 0.0, count), draw.between(0.5, 1.3, count))


@dataclass(frozen=True)
class _Spots:
    place: Tensor  # (B, C, M, 2) crop pixels
    radius: Tensor  # (B, C, M) crop pixels
    brightness: Tensor  # (B, C, M)
    velocity: Tensor  # (B, C, M, 2) crop pixels during the exposure
    cut: Tensor  # (B, C, M) radii from the middle to the edge behind which the spot is hidden


def _join(*parts: _Spots) -> _Spots:
    return _Spots(*(torch.cat([getattr(part, name) for part in parts], dim=2) for name in _Spots.__dataclass_fields__))


def _add_spots(spots: _Spots, blur: Tensor, draw: Draw) -> Tensor:
    """Add up spots, each in a window of its own: (B, C, S, S)."""
    batch, count = spots.radius.shape[:2], spots.radius.shape[2]
    corner = spots.place.detach().clamp(-PATCH, CROP_SIZE + PATCH).round() - PATCH // 2
    steps = torch.arange(PATCH, device=blur.device, dtype=blur.dtype)
    u, v = (corner[..., axis, None] + steps for axis in (0, 1))  # (B, C, M, PATCH)
    du, dv = (u - spots.place[..., 0, None])[..., None, :], (v - spots.place[..., 1, None])[..., :, None]
    length = spots.velocity.square().sum(-1).sqrt()[..., None, None]
    along = spots.velocity[..., None, None] / length.clamp(min=1e-6)[..., None, :, :]  # (B, C, M, 2, 1, 1)
    ahead = du * along[..., 0, :, :] + dv * along[..., 1, :, :]
    across = dv * along[..., 0, :, :] - du * along[..., 1, :, :]
    across = torch.where(length > 1e-5, across.square(), du.square() + dv.square())
    variance = (spots.radius.square() / 4 + blur[..., None].square())[..., None, None]
    sigma = variance.sqrt()
    # A Gaussian moved along a segment: in closed form by the normal distribution; 1.702 turns it into a sigmoid.
    half = length / 2
    moved = torch.sigmoid(1.702 * (ahead + half) / sigma) - torch.sigmoid(1.702 * (ahead - half) / sigma)
    profile = torch.where(
        length > 1e-2, moved * (2.5066 * sigma / length.clamp(min=1e-2)), torch.exp(-ahead.square() / (2 * variance))
    )
    profile = torch.where(length > 1e-5, profile, 1.0) * torch.exp(-across / (2 * variance))
    peak = spots.radius[..., None, None].square() / (2 * variance)
    covered = 1 - torch.exp(-1.6 * peak * profile)
    angle = draw.between(0, 2 * math.pi, *batch, count)[..., None, None]
    beyond = du * angle.cos() + dv * angle.sin() - (spots.cut * spots.radius)[..., None, None]
    light = covered * spots.brightness[..., None, None] * torch.sigmoid(-beyond / 0.25)
    column, row = u.long()[..., None, :], v.long()[..., :, None]
    good = (column >= 0) & (column < CROP_SIZE) & (row >= 0) & (row < CROP_SIZE)
    index = torch.where(good, row.clamp(0, CROP_SIZE - 1) * CROP_SIZE + column.clamp(0, CROP_SIZE - 1), 0)
    image = torch.zeros(*batch, CROP_SIZE * CROP_SIZE, device=blur.device, dtype=light.dtype)
    return image.scatter_add(2, index.flatten(2), (light * good).flatten(2)).unflatten(2, (CROP_SIZE, CROP_SIZE))


def _background(batch: torch.Size, draw: Draw) -> Tensor:
    """Slow light, drapes (stripes), streaks and edges: (B, C, S, S)."""
    one = torch.ones(1, 1, 1, 1, device=draw.generator.device)
    slow = draw.normal(math.prod(batch), 1, 5, 5)
    slow = functional.interpolate(slow, (CROP_SIZE, CROP_SIZE), mode="bicubic", align_corners=True)[:, 0].unflatten(
        0, batch
    )
    ground = slow * draw.sometimes(0.5, 0.4, *batch)[..., None, None]
    steps = torch.linspace(-1, 1, CROP_SIZE, device=one.device)

    def wave(*shape: int) -> Tensor:
        """Coordinates along and across random directions, the middle shifted: two (B, C, *shape, S, S)."""
        angle = draw.between(0, 2 * math.pi, *batch, *shape)[..., None, None]
        shift = draw.between(-1, 1, *batch, *shape, 2)[..., None, None]
        x, y = steps - shift[..., 0, :, :], steps[:, None] - shift[..., 1, :, :]
        return torch.stack((x * angle.cos() + y * angle.sin(), y * angle.cos() - x * angle.sin()))

    along, _ = wave()
    stripes = (
        torch.sin(along * draw.between(5, 60, *batch)[..., None, None])
        * draw.sometimes(0.25, 0.5, *batch)[..., None, None]
    )
    edge_along, _ = wave()
    edge = torch.sigmoid(edge_along * 50) * draw.sometimes(0.25, 0.8, *batch)[..., None, None]
    along, across = wave(3)
    long, wide = draw.between(0.05, 0.5, *batch, 3), draw.between(0.008, 0.06, *batch, 3)
    amount = draw.sometimes(0.4, 1.8, *batch, 3)
    streaks = torch.exp(-(along / long[..., None, None]).pow(4) - (across / wide[..., None, None]).square())
    return ground + stripes + edge + (streaks * amount[..., None, None]).sum(2)


def _objects(rigs: int, fiducials: int, draw: Draw) -> Tensor:
    """Draw fiducials about their centroid, some 100 mm from it: balls, boxes, plates, subsets of lattices."""
    box = draw.between(-1, 1, rigs, fiducials, 3)
    ball = draw.direction(rigs, fiducials) * draw.unit(rigs, fiducials, 1) ** (1 / 3)
    plate = box * box.new_tensor((1.0, 0.8, 0.05))
    lattice = torch.stack(torch.meshgrid(*(torch.arange(-1.0, 2.0, device=box.device),) * 3, indexing="ij"), -1).view(
        -1, 3
    )
    chosen = draw.unit(rigs, len(lattice)).argsort(1)[:, :fiducials]
    grid = lattice[chosen] + 0.02 * box
    kind = (draw.unit(rigs, 1, 1) * 4).floor()
    points = torch.where(kind == 0, box, torch.where(kind == 1, ball, torch.where(kind == 2, plate, grid)))
    points = points - points.mean(1, keepdim=True)
    return 100 * points / points.square().sum(-1).amax(-1).sqrt()[:, None, None]


def _cameras(rigs: int, cameras: int, distance: Tensor, draw: Draw) -> CameraRig:
    """Cameras at about a distance from the rig's origin, looking near it, from anywhere."""
    turn = rotation_from_vector(draw.direction(rigs, cameras) * draw.between(0, math.pi, rigs, cameras, 1))
    size = torch.tensor((2048.0, 1088.0), device=distance.device)
    focal = draw.between(1000, 2400, rigs, cameras, 1) * (1 + 0.005 * draw.normal(rigs, cameras, 2))
    far = distance[:, None, None] * draw.between(0.85, 1.2, rigs, cameras, 1)
    aside = far * 0.15 * draw.normal(rigs, cameras, 2).clamp(-2, 2)
    scale = torch.tensor((0.1, 0.1, 0.003, 0.003, 0.05), device=distance.device)
    return CameraRig(
        focal_length=focal,
        principal_point=size / 2 + 10 * draw.normal(rigs, cameras, 2),
        distortion=scale * draw.between(-1, 1, rigs, cameras, 5),
        cam_from_rig=RigidTransform(turn, torch.cat((aside, far), -1)),
        image_size=size.long().expand(cameras, 2),
        camera_names=tuple(f"cam{i + 1:02d}" for i in range(cameras)),
    )

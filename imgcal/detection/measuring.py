"""How exactly a blob lies where: background-subtracted, intensity-weighted centroids of many windows at once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.detection.finding import Candidates
from imgcal.detection.options import DetectionOptions, Frame
from imgcal.observations import BlobFlag

HALF_SIZES = (6, 8, 11, 15, 20, 27, 37, 50)  # px; windows of 2 h + 1, few different ones so that blobs share arrays
RING = 2  # px, width of the frame of a window from which the background is taken
CLIP = (4.0, 9.0)  # standard deviations of a 3 x 3 mean below which a pixel is background: weak blob, bright blob
CLIP_PEAK = 0.1  # of the peak: where the clip lies between the two
SIGNIFICANT = 6.0  # standard deviations of a 3 x 3 mean that the brightest one of a blob must reach
CROWDED = 0.2  # of the peak: a border this bright with a neighbour lets too much of its light in
SMALLEST_SIGMA = 0.001  # px, what sampling by pixels leaves without any noise
# px * sqrt(px): sub-pixel position lost where clipping turns a soft edge into a step, over sqrt(radius); the worst case of
# the exposures (2 to 15 times full scale) in the tests.
CLIPPED_SIGMA = 0.045
TWO_PEAKED = 0.55  # bimodality coefficient
SKIRT = 3.5  # px, how far the blurred edge reaches beyond the component that was found


@dataclass(frozen=True)
class Source:
    """A frame with what was found in it."""

    frame: Frame  # (H, W)
    found: Candidates
    scale: int  # largest grey value
    mask: NDArray[np.bool_] | None  # (H, W) true inside known reflections


@dataclass(frozen=True)
class Blobs:
    """Measured blobs, one row each; see `Detections` for the columns."""

    uv: NDArray[np.float64]  # (K, 2) pixels
    sigma: NDArray[np.float64]  # (K,) pixels
    radius: NDArray[np.float64]  # (K,) pixels
    flags: NDArray[np.uint8]  # (K,) BlobFlag bits
    source: NDArray[np.int64]  # (K,) index into the frames that were measured together


@dataclass(frozen=True)
class _Windows:
    """Windows of equal size around K blobs, with the background removed."""

    grey: NDArray[np.float32]  # (K, P, P) above the local background; polarity bright
    smooth: NDArray[np.float32]  # (K, P, P) mean of the 3 x 3 pixels
    weight: NDArray[np.float32]  # (K, P, P) in [0, 1]: how much a pixel belongs to the blob
    gain: NDArray[np.float32]  # (K, P, P) how much a pixel's noise moves the blob's brightness
    noise: NDArray[np.float32]  # (K,) grey levels, standard deviation of a background pixel
    slope: NDArray[np.float32]  # (K,) grey levels / px, standard deviation of the background's slope
    saddle: NDArray[np.float32]  # (K,) grey levels, brightest border with a neighbour
    clipped: NDArray[np.bool_]  # (K, P, P) at or above saturation


def measure(sources: list[Source], options: DetectionOptions) -> Blobs:
    """Measure all candidates of several frames together, and keep those that are blobs.

    A first pass puts a window around the candidate as it was found; the second one centres it on the measured blob, so that
    the result does not depend on the grid of blocks on which the candidate was found.
    """
    counts = [len(source.found.boxes) for source in sources]
    owner = np.repeat(np.arange(len(sources)), counts)
    if not owner.size:
        return Blobs(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.uint8), owner)
    boxes = np.concatenate([source.found.boxes for source in sources])
    seeds = np.concatenate([source.found.seeds for source in sources])
    centres = (boxes[:, :2] + boxes[:, 2:]) // 2
    reach = (boxes[:, 2:] - boxes[:, :2]).max(1) / 2
    for half, rows in _by_size(reach + SKIRT + RING):
        windows = _cut(sources, owner[rows], centres[rows], seeds[rows], half, options)
        offset, reach[rows] = _centroid(windows)
        centres[rows] += np.rint(offset).astype(np.int64)
    result = Blobs(np.zeros(boxes[:, :2].shape), np.zeros(len(boxes)), reach, np.zeros(len(boxes), np.uint8), owner)
    kept = np.zeros(len(boxes), np.bool_)
    for half, rows in _by_size(reach + 1.5 + RING):
        windows = _cut(sources, owner[rows], centres[rows], seeds[rows], half, options)
        offset, result.sigma[rows], result.radius[rows], result.flags[rows], kept[rows] = _judge(windows, options)
        result.uv[rows] = centres[rows] + offset
        result.flags[rows] |= _outside(sources, owner[rows], result.uv[rows], reach[rows])
    kept &= ~_repeated(result)
    return Blobs(*(column[kept] for column in (result.uv, result.sigma, result.radius, result.flags, owner)))


def _by_size(reach: NDArray[np.float64]) -> list[tuple[int, NDArray[np.int64]]]:
    """Group windows of reach (K,) px by the smallest half size that holds them."""
    sizes = np.searchsorted(HALF_SIZES[:-1], reach)
    return [(HALF_SIZES[i], np.flatnonzero(sizes == i)) for i in np.unique(sizes)]


def _cut(
    sources: list[Source],
    owner: NDArray[np.int64],
    centres: NDArray[np.int64],
    seeds: NDArray[np.int64],
    half: int,
    options: DetectionOptions,
) -> _Windows:
    """Cut windows of half size `half` around `centres` (K, 2), remove the background and tell blob from surroundings."""
    grey, found, clipped = _gather(sources, owner, centres, half, options)
    side = 2 * half + 1
    offset = np.arange(-half, half + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(offset, offset))
    basis = np.stack([np.ones_like(x), x, y], 1).astype(np.float32)
    ring = np.flatnonzero(np.maximum(abs(x), abs(y)) > half - RING)
    plane, noise, slope = _background(grey[:, ring], basis[ring])
    grey -= plane @ basis.T
    grey = grey.reshape(-1, side, side)
    smooth = cv2.blur(grey.reshape(-1, side), (3, 3)).reshape(grey.shape)  # rows next to a window's edge are not used
    territory, saddle = _territory(found.reshape(grey.shape), smooth, np.clip(seeds - centres + half, 0, side - 1))
    top = (smooth * territory).max((1, 2))
    clip = np.clip(CLIP_PEAK * top, CLIP[0] / 3 * noise, CLIP[1] / 3 * noise)[:, None, None]
    weight = np.clip(smooth / clip - 1, 0, 1) * territory
    # On the ramp between background and blob the noise of the 3 x 3 mean moves the weight as well.
    ramp = np.where((weight > 0) & (weight < 1), grey / clip, 0)
    gain = weight + cv2.blur(ramp.reshape(-1, side), (3, 3)).reshape(grey.shape)
    return _Windows(grey, smooth, weight, gain, noise, slope, saddle, clipped.reshape(grey.shape))


def _gather(
    sources: list[Source], owner: NDArray[np.int64], centres: NDArray[np.int64], half: int, options: DetectionOptions
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]:
    """Copy windows out of the frames: grey values (bright polarity), found components, clipped pixels; (K, P * P) each."""
    offset = np.arange(-half, half + 1)
    parts = []
    for index in np.unique(owner):
        source = sources[index]
        height, width = source.frame.shape
        u, v = (centres[owner == index, None] + offset[:, None]).transpose(2, 0, 1)  # (K, P)
        # Beyond the border the last row or column repeats; a blob that reaches it is flagged.
        pixel = np.clip(v, 0, height - 1)[:, :, None], np.clip(u, 0, width - 1)[:, None, :]
        grey = source.frame[pixel].astype(np.float32).reshape(len(u), -1)
        if options.polarity == "dark":
            grey = source.scale - grey
        limit = 0.995 * source.scale if options.saturation is None else options.saturation
        parts.append((grey, source.found.mask[pixel].reshape(len(u), -1), grey >= limit))
    grey, found, clipped = (np.concatenate(column) for column in zip(*parts, strict=True))
    return grey, found, clipped


def _background(ring: NDArray[np.float32], basis: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """Fit a plane to the ring around each blob, without what else lies there.

    Args:
        ring: (K, R) grey values.
        basis: (R, 3) 1, x, y at the ring's pixels.

    Returns:
        Plane (K, 3); noise (K,), one standard deviation of a pixel, not less than that of rounding to whole grey levels;
        standard deviation of the plane's slopes (K,).
    """
    quartile = np.partition(ring, (ring.shape[1] // 4, ring.shape[1] // 2), axis=1)
    middle = quartile[:, ring.shape[1] // 2, None]
    # The lower half tells the spread: clutter in the ring is bright. One grey level is the quantization of that estimate.
    spread = 1.4826 * (middle - quartile[:, ring.shape[1] // 4, None]) + 1
    inlier = (abs(ring - middle) < 4 * spread).astype(np.float32)
    normal = np.einsum("kr,ri,rj->kij", inlier, basis, basis, optimize=True)
    # Centred on the middle: grey values of 16 bit lose nothing in float32.
    moment = (inlier * (ring - middle)) @ basis
    plane = np.linalg.solve(normal + 1e-3 * np.eye(3, dtype=np.float32), moment[..., None])[..., 0]
    residual = inlier * (ring - middle - plane @ basis.T)
    noise = np.sqrt((residual**2).sum(1) / np.maximum(inlier.sum(1) - 3, 1))
    plane[:, :1] += middle
    noise = np.maximum(noise, 12**-0.5)
    return plane, noise, noise / np.sqrt(np.maximum((normal[:, 1, 1] + normal[:, 2, 2]) / 2, 1))


def _territory(
    found: NDArray[np.uint8], smooth: NDArray[np.float32], seeds: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Give each blob the pixels that are nearer to it than to other components, up to its skirt.

    Args:
        found: (K, P, P) non-zero on components.
        smooth: (K, P, P) grey values above the background.
        seeds: (K, 2) a pixel (u, v) of the blob in its window.

    Returns:
        Territory (K, P, P) and the brightest border with a neighbour (K,), 0 without one.
    """
    strip = (found == 0).astype(np.uint8).reshape(-1, found.shape[2])
    distance, labels = cv2.distanceTransformWithLabels(strip, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP)
    distance, labels = distance.reshape(found.shape), labels.reshape(found.shape)
    own = labels == labels[np.arange(len(labels)), seeds[:, 1], seeds[:, 0]][:, None, None]
    inner = np.zeros_like(own)
    inner[:, RING:-RING, RING:-RING] = True
    foreign = cv2.dilate((~own & inner).astype(np.uint8).reshape(strip.shape), np.ones((3, 3), np.uint8)).reshape(own.shape)
    own &= inner
    saddle = np.where((foreign > 0) & own & (distance <= SKIRT), smooth, 0).max((1, 2))
    own &= distance <= SKIRT
    return own, saddle


def _centroid(windows: _Windows) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted centroid (K, 2) relative to the window's centre, and how far the blob reaches from it (K,)."""
    half = windows.grey.shape[1] // 2
    offset = np.arange(-half, half + 1, dtype=np.float32)
    mass = windows.weight * windows.grey
    total = np.maximum(mass.sum((1, 2)), 1e-6)
    centre = np.stack([mass.sum(1) @ offset, mass.sum(2) @ offset], 1) / total[:, None]
    across = np.stack([windows.weight.any(1), windows.weight.any(2)], 1)  # (K, 2, P)
    reach = np.where(across, abs(offset - np.rint(centre)[:, :, None]), 0).max((1, 2))
    return np.clip(centre, -half, half).astype(np.float64), reach.astype(np.float64)


def _judge(
    windows: _Windows, options: DetectionOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8], NDArray[np.bool_]]:
    """Measure centre (K, 2), sigma (K,), radius (K,), flags (K,), and tell which windows hold a blob (K,)."""
    centre, _ = _centroid(windows)
    half = windows.grey.shape[1] // 2
    offset = np.arange(-half, half + 1, dtype=np.float32)
    x = offset[None, None, :] - centre[:, 0, None, None].astype(np.float32)
    y = offset[None, :, None] - centre[:, 1, None, None].astype(np.float32)
    square = x**2 + y**2
    inside = windows.weight > 0.5
    brightness = np.maximum((windows.weight * windows.grey).sum((1, 2)), 1e-6)
    peak = np.maximum((inside * windows.grey).max((1, 2)), 1e-6)
    top = (inside * windows.smooth).max((1, 2))
    radius = np.sqrt(brightness / peak / np.pi)
    elongation, two_peaked = _shape(np.minimum(windows.weight * windows.smooth, top[:, None, None] / 2), x, y)
    # Each pixel's noise moves the centroid by its lever arm over the brightness; mean of both axes.
    lever = (windows.gain**2 * square).sum((1, 2)) / 2
    tilt = (windows.weight * square).sum((1, 2)) / 2
    variance = (windows.noise**2 * lever + (windows.slope * tilt) ** 2) / brightness**2 + SMALLEST_SIGMA**2
    saturated = (windows.clipped & inside).any((1, 2))
    variance += saturated * CLIPPED_SIGMA**2 / np.maximum(radius, 1)
    merged = two_peaked | (windows.saddle > CROWDED * top)
    flags = merged * np.uint8(BlobFlag.MERGED) | saturated * np.uint8(BlobFlag.SATURATED)
    least = 0.0 if options.threshold is None else options.threshold
    kept = (radius >= options.min_radius) & (radius <= options.max_radius) & (peak >= least)
    kept &= (top > SIGNIFICANT / 3 * windows.noise) & (elongation <= options.max_elongation)
    return centre, np.sqrt(variance), radius, flags, kept


def _shape(
    mass: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Tell the elongation (K,) of a mass distribution (K, P, P), and whether it has two parts along its major axis (K,).

    Source: Sarle's bimodality coefficient, (skewness ** 2 + 1) / kurtosis: 0.50 for any filled ellipse, 0.56 for a uniform
    rod, 0.60 for two discs that touch.
    """
    mass = mass / np.maximum(mass.sum((1, 2), keepdims=True), 1e-6)
    mean_x, mean_y = (mass * x).sum((1, 2)), (mass * y).sum((1, 2))
    x, y = x - mean_x[:, None, None], y - mean_y[:, None, None]
    xx, yy, xy = ((mass * product).sum((1, 2)) for product in (x * x, y * y, x * y))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    swing = np.hypot(xx - yy, 2 * xy)
    major, minor = (xx + yy + swing) / 2, (xx + yy - swing) / 2
    elongation = np.sqrt(major / np.maximum(minor, 1e-3))
    along = x * np.cos(angle)[:, None, None] + y * np.sin(angle)[:, None, None]
    third, fourth = ((mass * along**n).sum((1, 2)) for n in (3, 4))
    bimodality = (third**2 / np.maximum(major, 1e-6) ** 3 + 1) * major**2 / np.maximum(fourth, 1e-6)
    return elongation, (bimodality > TWO_PEAKED) & (elongation > 1.3)


def _outside(
    sources: list[Source], owner: NDArray[np.int64], uv: NDArray[np.float64], reach: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Flag blobs that reach the border of their image or whose centres lie in a mask: (K,)."""
    shape = np.array([source.frame.shape[::-1] for source in sources])[owner]
    pixel = np.clip(np.rint(uv).astype(np.int64), 0, shape - 1)
    border = ((pixel < reach[:, None]) | (pixel + reach[:, None] > shape - 1)).any(1)
    masked = np.zeros(len(uv), np.bool_)
    for index, source in enumerate(sources):
        if source.mask is not None:
            rows = owner == index
            masked[rows] = source.mask[pixel[rows, 1], pixel[rows, 0]]
    flags: NDArray[np.uint8] = border * np.uint8(BlobFlag.BORDER) | masked * np.uint8(BlobFlag.MASKED)
    return flags


def _repeated(blobs: Blobs) -> NDArray[np.bool_]:
    """Mark blobs that lie on an earlier one of the same frame: components of one blob found in pieces; (K,)."""
    key = np.stack([blobs.source, *np.rint(blobs.uv).astype(np.int64).T], 1)
    repeated = np.ones(len(key), np.bool_)
    repeated[np.unique(key, axis=0, return_index=True)[1]] = False
    return repeated

"""How exactly a blob lies where: background-subtracted, intensity-weighted centroids of many windows at once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from imgcal.detection.finding import Candidates
from imgcal.detection.options import DetectionOptions, Frame
from imgcal.observations import BlobFlag

HALF_SIZES = (7, 10, 14, 20, 29, 42, 60)  # px; windows of 2 h + 1, few different ones so that blobs share arrays
RING = 2  # px, width of the frame of a window from which the background is taken
CLIP = (4.0, 9.0)  # standard deviations of a 3 x 3 mean below which a pixel is background: weak blob, bright blob
CLIP_PEAK = 0.1  # of the peak: where the clip lies between the two
SIGNIFICANT = 6.0  # standard deviations of a 3 x 3 mean that the brightest one of a blob must reach
CROWDED = 0.6  # of the peak: a border this bright with a neighbour is no border
SMALLEST_SIGMA = 0.001  # px, what sampling by pixels leaves without any noise
# px * sqrt(px): position lost where clipping turns a soft edge into a step, over sqrt(radius); the worst case of the
# exposures (2 to 15 times full scale) in the tests.
CLIPPED_SIGMA = 0.045
TWO_PEAKED = 0.515  # bimodality coefficient
REACH = 4  # px from a component to the end of its window: the skirt and a ring that is clear of it
SKIRT = 3.5  # px, how far the blurred edge reaches beyond the component that was found


@dataclass(frozen=True)
class Blobs:
    """Measured blobs of one snapshot, one row each; see `Detections` for the columns."""

    uv: NDArray[np.float64]  # (K, 2) pixels
    sigma: NDArray[np.float64]  # (K,) pixels
    radius: NDArray[np.float64]  # (K,) pixels
    flags: NDArray[np.uint8]  # (K,) BlobFlag bits
    camera: NDArray[np.int64]  # (K,) which of the frames


@dataclass(frozen=True)
class _Windows:
    """Windows of equal size around K blobs, with the background removed."""

    grey: NDArray[np.float32]  # (K, P, P) above the local background; polarity bright
    smooth: MatLike  # (K, P, P) mean of the 3 x 3 pixels
    weight: NDArray[np.float32]  # (K, P, P) in [0, 1]: how much a pixel belongs to the blob
    gain: NDArray[np.float32]  # (K, P, P) how much a pixel's noise moves the blob's brightness
    noise: NDArray[np.float32]  # (K,) grey levels, standard deviation of a background pixel
    slope: NDArray[np.float32]  # (K,) grey levels / px, standard deviation of the background's slope
    saddle: NDArray[np.float32]  # (K,) grey levels, brightest border with a neighbour
    clipped: NDArray[np.bool_]  # (K, P, P) at or above saturation


def measure(frames: list[Frame], candidates: Candidates, options: DetectionOptions, scales: list[int]) -> Blobs:
    """Measure the candidates of several frames together, and keep those that are blobs.

    Windows around all blobs of a similar size are one array, whatever their frame: the cost is calls, not pixels.
    """
    boxes = candidates.boxes
    centres = candidates.centres
    count = len(boxes)
    blobs = Blobs(np.zeros((count, 2)), np.zeros(count), np.zeros(count), np.zeros(count, np.uint8), candidates.frame)
    kept = np.zeros(count, np.bool_)
    for half, rows in _by_size((boxes[:, 2:] - centres).max(1, initial=0) + REACH):
        windows = _cut(frames, candidates, rows, half, options, scales)
        offset, blobs.sigma[rows], blobs.radius[rows], blobs.flags[rows], kept[rows] = _judge(windows, options)
        blobs.uv[rows] = centres[rows] + offset
    last = np.array([frame.shape[::-1] for frame in frames]).reshape(-1, 2)[blobs.camera] - 1
    blobs.flags[((boxes[:, :2] <= 1) | (boxes[:, 2:] >= last - 1)).any(1)] |= np.uint8(BlobFlag.BORDER)
    kept &= ~_repeated(blobs)
    return Blobs(blobs.uv[kept], blobs.sigma[kept], blobs.radius[kept], blobs.flags[kept], blobs.camera[kept])


def _by_size(reach: NDArray[np.float64]) -> list[tuple[int, NDArray[np.int64]]]:
    """Group windows of reach (K,) px by the smallest half size that holds them."""
    sizes = np.searchsorted(HALF_SIZES[:-1], reach)
    return [(HALF_SIZES[i], np.flatnonzero(sizes == i)) for i in np.unique(sizes)]


def _cut(
    frames: list[Frame],
    candidates: Candidates,
    rows: NDArray[np.int64],
    half: int,
    options: DetectionOptions,
    scales: list[int],
) -> _Windows:
    """Cut windows of half size `half` around candidates `rows` (K,), remove the background and mark the blobs."""
    centres = candidates.centres[rows]
    raw, found = _copy(frames, candidates, candidates.frame[rows], centres, half)
    level = np.array(scales, np.float32)[candidates.frame[rows]][:, None, None]
    grey = raw.astype(np.float32)
    if options.polarity == "dark":
        grey = level - grey
    clipped = grey >= (0.995 * level if options.saturation is None else options.saturation)
    side = 2 * half + 1
    offset = np.arange(-half, half + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(offset, offset))
    basis = np.stack([np.ones_like(x), x, y], 1).astype(np.float32)
    ring = np.flatnonzero(np.maximum(abs(x), abs(y)) > half - RING)
    plane, noise, slope = _background(grey.reshape(len(grey), -1)[:, ring], basis[ring])
    grey -= (plane @ basis.T).reshape(grey.shape)
    smooth = cv2.blur(grey.reshape(-1, side), (3, 3)).reshape(grey.shape)  # rows next to a window's edge are not used
    territory, saddle = _territory(found, smooth, np.clip(candidates.seeds[rows] - centres + half, 0, side - 1))
    top = (smooth * territory).max((1, 2))
    clip = np.clip(CLIP_PEAK * top, CLIP[0] / 3 * noise, CLIP[1] / 3 * noise)[:, None, None]
    weight = np.clip(smooth / clip - 1, 0, 1) * territory
    # On the ramp between background and blob the noise of the 3 x 3 mean moves the weight as well.
    ramp = np.where((weight > 0) & (weight < 1), grey / clip, 0)
    gain = weight + cv2.blur(ramp.reshape(-1, side), (3, 3)).reshape(grey.shape)
    return _Windows(grey, smooth, weight, gain, noise, slope, saddle, clipped)


def _copy(
    frames: list[Frame], candidates: Candidates, owner: NDArray[np.int64], centres: NDArray[np.int64], half: int
) -> tuple[Frame, NDArray[np.uint8]]:
    """Copy windows out of the frames and out of the mask of components: (K, P, P) each."""
    side = 2 * half + 1
    wide = np.result_type(*{frame.dtype for frame in frames})
    grey, found = np.empty((len(owner), side, side), wide), np.empty((len(owner), side, side), np.uint8)
    for k, (index, (u, v)) in enumerate(zip(owner.tolist(), centres.tolist(), strict=True)):
        frame, row = frames[index], candidates.rows[index]
        top, left, bottom, right = v - half, u - half, v + half + 1, u + half + 1
        if top >= 0 and left >= 0 and bottom <= frame.shape[0] and right <= frame.shape[1]:
            grey[k] = frame[top:bottom, left:right]
            found[k] = candidates.mask[row[top:bottom], left:right]
        else:  # beyond the border the last row or column repeats; a blob that reaches it is flagged
            rows = np.clip(np.arange(top, bottom), 0, frame.shape[0] - 1)[:, None]
            columns = np.clip(np.arange(left, right), 0, frame.shape[1] - 1)
            grey[k], found[k] = frame[rows, columns], candidates.mask[row[rows], columns]
    return grey, found


def _background(ring: NDArray[np.float32], basis: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """Fit a plane to the ring around each blob, without what else lies there.

    Args:
        ring: (K, R) grey values.
        basis: (R, 3) 1, x, y at the ring's pixels.

    Returns:
        Plane (K, 3); noise (K,), one standard deviation of a pixel, not less than that of rounding to grey levels;
        standard deviation of the plane's slopes (K,).
    """
    quartile = np.partition(ring, (ring.shape[1] // 4, ring.shape[1] // 2), axis=1)
    middle = quartile[:, ring.shape[1] // 2, None]
    # The lower half tells the spread: clutter in the ring is bright. One grey level is the estimate's quantization.
    spread = 1.4826 * (middle - quartile[:, ring.shape[1] // 4, None]) + 1
    inlier = (abs(ring - middle) < 4 * spread).astype(np.float32)
    normal = (inlier @ (basis[:, :, None] * basis[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    # Centred on the middle: grey values of 16 bit lose nothing in float32.
    moment = (inlier * (ring - middle)) @ basis
    plane = np.linalg.solve(normal + 1e-3 * np.eye(3, dtype=np.float32), moment[..., None])[..., 0]
    residual = inlier * (ring - middle - plane @ basis.T)
    noise = np.sqrt((residual**2).sum(1) / np.maximum(inlier.sum(1) - 3, 1))
    plane[:, :1] += middle
    noise = np.maximum(noise, 12**-0.5)
    return plane, noise, noise / np.sqrt(np.maximum((normal[:, 1, 1] + normal[:, 2, 2]) / 2, 1))


def _territory(
    found: NDArray[np.uint8], smooth: MatLike, seeds: NDArray[np.int64]
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
    foreign = cv2.dilate((~own & inner).astype(np.uint8).reshape(strip.shape), np.ones((3, 3), np.uint8)).reshape(
        own.shape
    )
    own &= inner
    saddle = np.where((foreign > 0) & own & (distance <= SKIRT), smooth, 0).max((1, 2))
    own &= distance <= SKIRT
    return own, saddle


def _judge(
    windows: _Windows, options: DetectionOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8], NDArray[np.bool_]]:
    """Measure centre (K, 2), sigma (K,), radius (K,), flags (K,), and tell which windows hold a blob (K,)."""
    half = windows.grey.shape[1] // 2
    offset = np.arange(-half, half + 1, dtype=np.float32)
    mass = windows.weight * windows.grey
    brightness = np.maximum(mass.sum((1, 2)), 1e-6)
    centre = np.stack([mass.sum(1) @ offset, mass.sum(2) @ offset], 1) / brightness[:, None]
    x = offset[None, None, :] - centre[:, 0, None, None]
    y = offset[None, :, None] - centre[:, 1, None, None]
    square = x * x + y * y
    inside = windows.weight > 0.5
    peak = np.maximum((inside * windows.grey).max((1, 2)), 1e-6)
    top = (inside * windows.smooth).max((1, 2))
    radius = np.sqrt(brightness / peak / np.pi)
    elongation, two_peaked = _shape(np.clip(mass, 0, top[:, None, None] / 2), x, y)
    # Each pixel's noise moves the centroid by its lever arm over the brightness; mean of both axes.
    lever = (windows.gain * windows.gain * square).sum((1, 2)) / 2
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
    """Tell the elongation (K,) of masses (K, P, P), and whether they have two parts along their major axes (K,).

    Source: Sarle's bimodality coefficient, (skewness ** 2 + 1) / kurtosis: 0.50 for any filled ellipse and less when it
    is blurred, 0.60 for two discs that touch and 0.51 to 0.57 when they are blurred, 0.56 for a uniform rod.
    """
    mass = mass / np.maximum(mass.sum((1, 2), keepdims=True), 1e-6)
    mean_x, mean_y = (mass * x).sum((1, 2)), (mass * y).sum((1, 2))
    x, y = x - mean_x[:, None, None], y - mean_y[:, None, None]
    xx, yy, xy = ((mass * product).sum((1, 2)) for product in (x * x, y * y, x * y))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    swing = np.hypot(xx - yy, 2 * xy)
    major, minor = (xx + yy + swing) / 2, (xx + yy - swing) / 2
    elongation = np.sqrt(major / np.maximum(minor, 1 / 12))  # no narrower than a pixel
    along = x * np.cos(angle)[:, None, None] + y * np.sin(angle)[:, None, None]
    square = along * along
    third, fourth = ((mass * square * power).sum((1, 2)) for power in (along, square))
    bimodality = (third**2 / np.maximum(major, 1e-6) ** 3 + 1) * major**2 / np.maximum(fourth, 1e-6)
    return elongation, (bimodality > TWO_PEAKED) & (elongation > 1.3)


def _repeated(blobs: Blobs) -> NDArray[np.bool_]:
    """Mark blobs that lie on an earlier one of the same frame: components of one blob found in pieces; (K,)."""
    key = np.stack([blobs.camera, *np.rint(blobs.uv).astype(np.int64).T], 1)
    repeated = np.ones(len(key), np.bool_)
    repeated[np.unique(key, axis=0, return_index=True)[1]] = False
    return repeated

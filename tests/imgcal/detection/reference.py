"""What the compiled functions of the detector compute, in plain NumPy and SciPy: slow, obvious, whole windows."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, uniform_filter

from imgcal.detection import window
from imgcal.observations import BlobFlag


def components(frame, screening, invert=None):
    """Number the pixels that exceed the level of their block: labels (H, W), 0 = none."""
    level = np.full(screening.shape, np.inf)
    level.ravel()[screening.blocks] = screening.base + screening.excess
    level = np.kron(level, np.ones((4, 4)))[: frame.shape[0], : frame.shape[1]]
    total = cv2.boxFilter(frame, cv2.CV_32F, (3, 3), normalize=False, borderType=cv2.BORDER_REPLICATE)
    smooth = total / np.float32(9)  # ties with the level are decided by the last bit
    if invert is not None:
        smooth = np.float32(invert) - smooth
    return cv2.connectedComponents((smooth > level).astype(np.uint8), connectivity=8)[1]


def boxes_of(labels):
    """Left, top, right, bottom (included) of each component, 1 to M: (M, 4)."""
    boxes = []
    for label in range(1, labels.max() + 1):
        v, u = np.nonzero(labels == label)
        boxes.append((u.min(), v.min(), u.max(), v.max()))
    return np.array(boxes, np.int64).reshape(-1, 4)


def measure(frame, labels, label, box, half, saturation, invert=None):
    """Centre u, v, sigma, radius, elongation and flags (without the border's) of one component.

    Returns None where the brightest pixels do not stand out.
    """
    middle = np.array([(box[0] + box[2]) // 2, (box[1] + box[3]) // 2])
    v, u = np.arange(middle[1] - half, middle[1] + half + 1)[:, None], np.arange(middle[0] - half, middle[0] + half + 1)
    rows, columns = np.clip(v, 0, frame.shape[0] - 1), np.clip(u, 0, frame.shape[1] - 1)
    inside = (rows == v) & (columns == u)
    raw = frame[rows, columns].astype(np.float64)
    if invert is not None:
        raw = invert - raw
    found = np.where(inside, labels[rows, columns], 0)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    inner = np.maximum(abs(x), abs(y)) <= half - window.RING
    plane, noise, slope = background(raw[~inner], x[~inner], y[~inner])
    grey = raw - plane[0] - plane[1] * x - plane[2] * y
    smooth = uniform_filter(grey, 3)

    own = distance_transform_edt(found != label)
    free = (found == 0) | (found == label)
    other = np.where(free.all(), np.inf, distance_transform_edt(free))
    foreign = cv2.dilate(((other <= own) & inner).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    territory = (own <= window.SKIRT) & (own <= other) & inner & inside
    saddle = smooth[territory & foreign].max(initial=0)

    clip = np.clip(window.CLIP_PEAK * smooth[territory].max(initial=0), *(c / 3 * noise for c in window.CLIP))
    weight = np.where(territory, np.clip(smooth / clip - 1, 0, 1), 0)
    gain = weight + uniform_filter(np.where((weight > 0) & (weight < 1), grey / clip, 0), 3)
    mass, core = weight * grey, weight > 0.5
    if not core.any():
        return None
    brightness = mass.sum()
    x0, y0 = (mass * x).sum() / brightness, (mass * y).sum() / brightness
    squared = (x - x0) ** 2 + (y - y0) ** 2
    radius, top = np.sqrt(brightness / grey[core].max() / np.pi), smooth[core].max()
    variance = noise**2 * (gain**2 * squared).sum() / 2 + (slope * (weight * squared).sum() / 2) ** 2
    variance = variance / brightness**2 + window.SMALLEST_SIGMA**2
    elongation, two_peaked = shape(np.clip(mass, 0, top / 2), x, y)
    flags = BlobFlag.MERGED if two_peaked or saddle > window.CROWDED * top else BlobFlag.NONE
    if (raw[core] >= saturation).any():
        flags |= BlobFlag.SATURATED
        variance += window.CLIPPED_SIGMA**2 / max(radius, 1)
    return middle[0] + x0, middle[1] + y0, np.sqrt(variance), radius, elongation, flags


def background(ring, x, y):
    """Plane (3,) through the inliers of a ring (R,), their standard deviation, and that of the plane's slopes."""
    ordered = np.sort(ring)
    middle, quarter = ordered[len(ring) // 2], ordered[len(ring) // 4]
    inlier = abs(ring - middle) < 4 * (1.4826 * (middle - quarter) + 1)
    basis = np.stack([np.ones_like(x), x, y], 1)[inlier]
    normal = basis.T @ basis
    plane = np.linalg.solve(normal + 1e-3 * np.eye(3), basis.T @ (ring[inlier] - middle))
    residual = ring[inlier] - middle - basis @ plane
    noise = max(np.sqrt((residual**2).sum() / max(len(basis) - 3, 1)), 12**-0.5)
    plane[0] += middle
    return plane, noise, noise / np.sqrt((normal[1, 1] + normal[2, 2]) / 2)


def shape(mass, x, y):
    """Ratio of the axes of the ellipse of equal moments, and whether there are two parts along the longer one."""
    mass = mass / mass.sum()
    x, y = x - (mass * x).sum(), y - (mass * y).sum()
    moments = np.array([[(mass * a * b).sum() for a in (x, y)] for b in (x, y)])
    (minor, major), axes = np.linalg.eigh(moments)
    along = axes[0, 1] * x + axes[1, 1] * y
    skewness = (mass * along**3).sum() / major**1.5
    kurtosis = (mass * along**4).sum() / major**2
    elongation = np.sqrt(major / max(minor, 1 / 12))
    return elongation, (skewness**2 + 1) / kurtosis > window.TWO_PEAKED and elongation > 1.3

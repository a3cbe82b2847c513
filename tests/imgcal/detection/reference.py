"""NumPy and SciPy references for the detector's compiled functions: slow, obvious, on whole windows."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, uniform_filter

from imgcal.detection import candidates, fitting, kernels
from imgcal.detection import moments as moments_of
from imgcal.types import BlobFlag


def components(frame, screening, invert=None):
    """Number the pixels that exceed the level of their block: labels (H, W), 0 = none."""
    level = pixels(of_blocks(screening, screening.base + screening.excess, np.inf), frame.shape)
    return connected(smoothed(frame, invert) > level)


def parted_components(frame, screening, saturation, invert=None):
    """Number them once more where clipped peaks within one are parted."""
    base, level = (of_blocks(screening, x, np.inf) for x in (screening.base, screening.base + screening.excess))
    smooth, labels = smoothed(frame, invert), components(frame, screening, invert)
    return connected(smooth > pixels(split(smooth, labels, level, base, saturation), frame.shape))


def of_blocks(screening, values, others):
    """Values (K,) of the screened blocks, and of all other ones: (R, Q)."""
    image = np.full(screening.shape, others)
    image.ravel()[screening.blocks] = values
    return image


def pixels(blocks, shape):
    """Values (R, Q) of blocks as those of their pixels (H, W)."""
    return np.kron(blocks, np.ones((4, 4)))[: shape[0], : shape[1]]


def smoothed(frame, invert=None):
    """Average the 3 x 3 pixels around each one: (H, W)."""
    total = cv2.boxFilter(frame, cv2.CV_32F, (3, 3), normalize=False, borderType=cv2.BORDER_REPLICATE)
    smooth = total / np.float32(9)  # ties with the level are decided by the last bit
    return smooth if invert is None else np.float32(invert) - smooth


def connected(marked):
    """Number the components (eight neighbours) of a mask (H, W)."""
    return cv2.connectedComponents(marked.astype(np.uint8), connectivity=8)[1]


def boxes_of(labels):
    """Left, top, right, bottom (included) of each component, 1 to M: (M, 4)."""
    boxes = []
    for label in range(1, labels.max() + 1):
        v, u = np.nonzero(labels == label)
        boxes.append((u.min(), v.min(), u.max(), v.max()))
    return np.array(boxes, np.int64).reshape(-1, 4)


def measure(frame, labels, label, box, half, saturation, invert=None, parted=False):
    """Centre u, v, sigma, radius, elongation and flags (without the border's) of one component.

    Returns None where the brightest pixels do not stand out.
    """
    centre = np.array([(box[0] + box[2]) // 2, (box[1] + box[3]) // 2])
    v, u = np.arange(centre[1] - half, centre[1] + half + 1)[:, None], np.arange(centre[0] - half, centre[0] + half + 1)
    rows, columns = np.clip(v, 0, frame.shape[0] - 1), np.clip(u, 0, frame.shape[1] - 1)
    inside = (rows == v) & (columns == u)
    raw = frame[rows, columns].astype(np.float64)
    if invert is not None:
        raw = invert - raw
    found = np.where(inside, labels[rows, columns], 0)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    inner = np.maximum(abs(x), abs(y)) <= half - kernels.RING
    plane, noise, slope = background(raw[~inner], x[~inner], y[~inner])
    grey = raw - plane[0] - plane[1] * x - plane[2] * y
    smooth = uniform_filter(grey, 3)

    own = distance_transform_edt(found != label)
    free = (found == 0) | (found == label)
    other = np.where(free.all(), np.inf, distance_transform_edt(free))
    foreign = cv2.dilate(((other <= own) & inner).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    territory = (own <= kernels.SKIRT) & (own <= other) & inner & inside
    saddle = smooth[territory & foreign].max(initial=0)

    clip = np.clip(kernels.CLIP_PEAK * smooth[territory].max(initial=0), *(c / 3 * noise for c in kernels.CLIP))
    weight = np.where(territory, np.clip(smooth / clip - 1, 0, 1), 0)
    core = weight > 0.5
    if not core.any():
        return None
    brightness, top = (weight * grey).sum(), smooth[core].max()
    radius = np.sqrt(brightness / grey[core].max() / np.pi)
    patch = (box[2] - box[0] + 1) * (box[3] - box[1] + 1) > brightness / grey[core].max()
    elongation, two_peaked, middle, moments = shape(np.clip(weight * grey, 0, top / 2), x, y, patch)
    clipped = bool((raw[core] >= saturation).any())
    flags = BlobFlag.SATURATED if clipped else BlobFlag.NONE
    x0 = y0 = known = residual = 0.0
    if two_peaked or saddle > (kernels.CROWDED_CLIPPED if clipped and parted else kernels.CROWDED) * top:
        flags |= BlobFlag.MERGED
    else:
        start = fitting.start_ellipse(grey[core].max(), radius, clipped, moments, middle)
        rows = territory & (quadratic(start, x, y) >= max(start[1] - fitting.BAND, 0) ** 2 - 1)
        rows &= (raw < saturation) | (not clipped)
        x0, y0, known, residual = fit(x[rows], y[rows], grey[rows], start, clipped, noise)
    fits = (
        known * radius**2 > max(noise**2, residual) and residual - noise**2 < (kernels.MISFIT * grey[core].max()) ** 2
    )
    if fits and np.hypot(x0 - middle[0], y0 - middle[1]) < kernels.FARTHEST:
        variance = max(noise**2, residual) / known + (slope * brightness / known) ** 2
        variance += clipped * kernels.CLIPPED_FIT**2 / max(radius, 1)
    else:
        x0, y0, variance = centroid(grey, weight, clip, noise, slope, x, y)
        variance += clipped * kernels.CLIPPED_SIGMA**2 / max(radius, 1)
    variance += clipped * min(saddle / top, 1) ** 3 * (kernels.SHARED * radius) ** 2
    sigma = np.sqrt(variance + kernels.SMALLEST_SIGMA**2)
    return centre[0] + x0, centre[1] + y0, sigma, radius, elongation, flags


def centroid(grey, weight, clip, noise, slope, x, y):
    """Centre x, y and variance of the weighted centroid; the noise of the 3 x 3 mean moves the weights as well."""
    gain = weight + uniform_filter(np.where((weight > 0) & (weight < 1), grey / clip, 0), 3)
    brightness = (weight * grey).sum()
    x0, y0 = (weight * grey * x).sum() / brightness, (weight * grey * y).sum() / brightness
    squared = (x - x0) ** 2 + (y - y0) ** 2
    variance = noise**2 * (gain**2 * squared).sum() / 2 + (slope * (weight * squared).sum() / 2) ** 2
    return x0, y0, variance / brightness**2


def quadratic(parameters, x, y):
    """Squared distance from the centre in units of the blur."""
    xx, xy, yy, x0, y0 = parameters[2:]
    return xx * (x - x0) ** 2 + 2 * xy * (x - x0) * (y - y0) + yy * (y - y0) ** 2


def fit(x, y, grey, start, clipped, noise):
    """A Phi(t) without defective pixels: centre x, y, information (0 where it fails), mean squared residual."""
    if len(x) <= fitting.PARAMETERS:
        return 0.0, 0.0, 0.0, 0.0
    tries = []
    for _ in range(fitting.DEFECTS + 1):
        now, known, cost, residual = descend(x, y, grey, start, clipped, noise)
        left = len(x) - fitting.PARAMETERS
        tries.append((*now[5:], known, cost / max(left, 1)))
        worst = np.abs(residual).argmax()
        others = (cost - residual[worst] ** 2) / max(left - 1, 1)
        least = max(fitting.DEFECT * np.sqrt(max(others, 0)), fitting.LEAST_DEFECT * now[0])
        if left <= 1 or abs(residual[worst]) < least:
            break
        x, y, grey, start = (*(np.delete(values, worst) for values in (x, y, grey)), now)
    return tries[-1] if tries[-1][3] <= (fitting.CLEAN * noise) ** 2 else tries[0]


def descend(x, y, grey, start, clipped, noise):
    """Levenberg and Marquardt: parameters, the centre's information, squared residuals, and those of the last step."""
    now, damping, moved = start, 1e-3, False
    value, jacobian = drawn(now, x, y)
    for _ in range(fitting.CLIPPED_STEPS if clipped else fitting.STEPS):
        residual, normal = grey - value, jacobian.T @ jacobian
        gradient = jacobian.T @ residual
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        if moved and (np.diag(normal)[5:] * step[5:] ** 2).sum() < fitting.SETTLED * noise**2:
            covariance = np.linalg.inv(normal)
            return now + step, 2 / np.trace(covariance[5:, 5:]), residual @ residual - gradient @ step, residual
        trial = now + step
        if trial[:3].min() > 0 and trial[2] * trial[4] - trial[3] ** 2 > 1e-3:
            after = drawn(trial, x, y)
            if ((grey - after[0]) ** 2).sum() < residual @ residual:
                now, damping, moved, (value, jacobian) = trial, damping / 10, True, after
                continue
        damping = max(30 * damping, 1e-2)
    residual = grey - value
    return now, 0.0, residual @ residual, residual


def drawn(parameters, x, y):
    """The model and its derivatives (P, 7); how the ellipse's shape changes the softness of its edge is left out."""
    height, edge, xx, xy, yy, x0, y0 = parameters
    dx, dy = x - x0, y - y0
    gx, gy, along = xx * dx + xy * dy, xy * dx + yy * dy, quadratic(parameters, x, y)
    away = np.sqrt(1 + along)
    steep = np.sqrt((1 + np.sqrt(xx * yy - xy**2) * along) / (1 + gx**2 + gy**2))
    rise, density = phi(steep * (edge - away))
    slope = height * steep * density
    toward = slope / away
    columns = rise, slope, -toward * dx**2 / 2, -toward * dx * dy, -toward * dy**2 / 2, toward * gx, toward * gy
    return height * columns[0], np.stack(columns, 1)


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


def shape(mass, x, y, patch):
    """Ratio of the axes of the ellipse of equal moments, whether there are two parts along the longer one, the middle
    (2,), and the moments xx, xy, yy.
    """
    mass = mass / mass.sum()
    middle = np.array([(mass * x).sum(), (mass * y).sum()])
    x, y = x - middle[0], y - middle[1]
    moments = np.array([[(mass * a * b).sum() for a in (x, y)] for b in (x, y)])
    (minor, major), axes = np.linalg.eigh(moments)
    along = axes[0, 1] * x + axes[1, 1] * y
    skewness = (mass * along**3).sum() / major**1.5
    kurtosis = (mass * along**4).sum() / major**2
    elongation = np.sqrt(major / max(minor, 1 / 12))
    two_peaked = (skewness**2 + 1) / kurtosis > moments_of.TWO_PEAKED and elongation > 1.3
    if patch and minor > moments_of.LEAST_WIDE**2 and elongation < moments_of.LONGEST_PATCH:
        two_peaked = two_peaked and waist(mass, along, np.sqrt(major)) < moments_of.WAIST
    return elongation, two_peaked, middle, (moments[0, 0], moments[0, 1], moments[1, 1])


def waist(mass, along, spread):
    """Least share of the mass at a place along the axis, of what lies on either side of it."""
    at = along / max(1.0, spread / 3.5) + moments_of.PROFILE / 2
    bins = np.arange(moments_of.PROFILE)
    profile = (mass[..., None] * np.clip(1 - abs(at[..., None] - bins), 0, None)).sum((0, 1))
    sides = np.array([min(profile[:i].max(), profile[i + 1 :].max()) for i in bins[1:-1]])
    inside = sides > moments_of.PART * profile.max()
    return min(1.0, (profile[1:-1][inside] / sides[inside]).min(initial=1.0))


def phi(t):
    """The detector's normal distribution and its density: a polynomial within +-END."""
    odd = np.polynomial.Polynomial(np.stack([np.zeros(6), fitting.PHI.astype(float)], 1).ravel())
    t = np.clip(t, -fitting.END, fitting.END)
    return 0.5 + odd(t), odd.deriv()(t)


def split(smooth, labels, level, base, saturation):
    """Levels (R, Q) of blocks, raised where that parts clipped peaks within one component of `labels` (H, W).

    `smooth` (H, W) are means of 3 x 3 pixels, `level` and `base` (R, Q) those of the blocks.
    """

    def highest(values):  # of the components that have pixels in a block
        image = np.pad(values[labels], [(0, -n % 4) for n in smooth.shape])
        return image.reshape(level.shape[0], 4, level.shape[1], 4).max((1, 3))

    clipped, count = (smooth >= saturation) & (labels > 0), labels.max()
    tops = np.zeros(count + 1)
    np.maximum.at(tops, labels[clipped], smooth[clipped] - pixels(base, smooth.shape)[clipped])
    most, chosen = np.ones(count + 1, int), np.zeros(count + 1)
    for part in candidates.SPLIT_AT[::-1]:
        trial = np.maximum(level, base + part * highest(tops))
        pieces = connected((labels > 0) & (smooth > pixels(trial, smooth.shape)))
        peaks = np.zeros(count + 1, int)
        for piece in range(1, pieces.max() + 1):
            inside = pieces == piece
            peaks[labels[inside][0]] += clipped[inside].sum() >= candidates.LEAST_CLIPPED
        most = np.maximum(most, peaks)
        chosen[(peaks == most) & (most > 1)] = part
        if (peaks < 2).all():
            break
    height = highest(chosen * tops)
    return np.where(height > 0, np.maximum(level, base + height), level)

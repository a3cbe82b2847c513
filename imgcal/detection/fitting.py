"""Compiled fit of a disc's image to a blob, for a centre as accurate as the noise allows.

A centroid uses all pixels of a blob, but only its edge carries information about its position. The model is an ellipse
with a soft edge, A Phi(c - sqrt(1 + d' Q d)) at the offset d from the centre. It is smooth in the middle, like a small
blurred disc, and a blurred step far out, like the edge of a large one. It fits blurred discs of any radius to a
thousandth of their contrast. It is symmetric about its centre, so it is unbiased for other symmetric blobs, too,
although it fits them less well.
"""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN201, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from renderers.compiling import njit

# A, c, Qxx, Qxy, Qyy, and last the centre x, y: the last corner of the Cholesky factor is its marginal information.
PARAMETERS = 7
ROWS = PARAMETERS + 4  # of scratch: the derivatives, the residual; x, y and grey value of the pixels
MOST = 3000  # most pixels in a fit; blobs with more at their edge keep their centroid
BLUR = 0.8  # px, initial softness of the edge of a clipped blob
BAND = 5.0  # in units of the blur: width of the band inside the edge in which pixels are used
STEPS = 5  # Gauss-Newton steps; two are nearly always enough
CLIPPED_STEPS = 15  # more, because the start is farther off where the top of the blob is clipped
SETTLED = 0.01  # of the variance: a smaller step of the centre ends the iteration
FARTHEST = 0.5  # px from the centroid: a fit farther away has found something else
DEFECTS = 3  # most defective pixels of a blob that are left out
DEFECT = 5.0  # times the RMS residual of the other pixels ...
LEAST_DEFECT = 0.1  # ... and of the blob's height: the least residual of a defective pixel
CLEAN = 2.0  # times the noise: the largest RMS residual of the others; a blob of another shape has no defects
# Phi(t) - 1/2 = t * polynomial(t^2) for |t| < END, with value 1/2 and slope 0 there: at most 2.4e-4 off.
END = 3.5
PHI = np.array([3.9820702e-1, -6.4665547e-2, 8.6445825e-3, -7.4875071e-4, 3.6610834e-5, -7.5567596e-7], np.float32)
_SLOPE = (PHI * np.arange(1, 13, 2)).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def fit_centre(rows, pixels, start, clipped, noise):
    """Fit the centre of a blob.

    Single pixels far off the fit are hot or dead and left out if the others then differ from it by their noise alone.

    Args:
        rows: (ROWS, MOST) scratch; its last three rows are offsets x, y and grey values above the background.
        pixels: P, number of pixels.
        start: (PARAMETERS,) initial parameters.
        clipped: whether saturated pixels are left out.
        noise: standard deviation of a pixel.

    Returns:
        Centre x, y; its information, 1 / px^2 for unit noise (mean of the axes, 0 where the fit has failed); the mean
        squared residual; and the blur of the edge (px).
    """
    now, known, cost = _descend(rows, pixels, start, clipped, noise)
    first, left = (now[5], now[6], known, cost / max(pixels - PARAMETERS, 1), _find_blur(now)), pixels
    for _ in range(DEFECTS):
        if known == 0.0:
            cost = _draw(rows, left, now)  # the last residuals are those of a refused step
        if left <= PARAMETERS + 1 or not _drop_defect(rows, left, cost, now[0]):
            break
        left -= 1
        now, known, cost = _descend(rows, left, now, clipped, noise)
    freedom = max(left - PARAMETERS, 1)
    if left == pixels or cost > (CLEAN * noise) ** 2 * freedom:
        return first
    return now[5], now[6], known, cost / freedom, _find_blur(now)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_blur(p):
    """Blur of the edge of an ellipse (px)."""
    return (p[2] * p[4] - p[3] * p[3]) ** -0.25


@njit(cache=True, nogil=True, error_model="numpy")
def _drop_defect(rows, pixels, cost, height):
    """Put the last pixel in the place of one whose residual nothing but a defect explains; return whether one has."""
    worst = 0
    for p in range(pixels):
        if abs(rows[7, p]) > abs(rows[7, worst]):
            worst = p
    squared = rows[7, worst] ** 2
    others = (cost - squared) / (pixels - PARAMETERS - 1)
    if squared < DEFECT**2 * others or squared < (LEAST_DEFECT * height) ** 2:
        return False
    for i in range(8, ROWS):
        rows[i, worst] = rows[i, pixels - 1]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _descend(rows, pixels, start, clipped, noise):
    """Minimize the squared residuals: the parameters, the centre's information as `fit_centre`, and their sum."""
    now, cost = start, _draw(rows, pixels, start)
    normal = _products(rows, pixels)
    factor, damping, moved, settled = normal, 1e-3, False, False
    for _ in range(CLIPPED_STEPS if clipped else STEPS):
        factor = _factor(normal, damping)
        step = _solve(factor, normal[PARAMETERS, :PARAMETERS])
        trial = now + step
        # The remaining change of the centre is far below the noise, so the model need not be evaluated again.
        settled = moved and normal[5, 5] * step[5] ** 2 + normal[6, 6] * step[6] ** 2 < SETTLED * noise**2
        if settled:
            now = trial
            for i in range(PARAMETERS):
                cost -= normal[PARAMETERS, i] * step[i]
            break
        after = _draw(rows, pixels, trial) if _is_blob(trial) else np.inf
        if after < cost:
            now, cost, damping = trial, after, damping / 10
            normal, moved = _products(rows, pixels), True
        else:
            damping = max(30 * damping, 1e-2)
    if damping > 1e-4:  # smaller values make no difference
        factor = _factor(normal, 1e-9)
    a, b, d = factor[5, 5], factor[6, 5], factor[6, 6]
    known = a * a * d * d / ((a * a + b * b + d * d) / 2)  # one over the mean of the inverse's diagonal
    return now, known if settled else 0.0, cost


@njit(cache=True, nogil=True, error_model="numpy")
def start_ellipse(peak, radius, clipped, moments, centre):
    """Initial ellipse with the area and moments (xx, xy, yy) of the blob, clipped at half of its peak.

    The half axes of the clipped blob are longer than those of the disc because of its blur.
    """
    start = np.empty(PARAMETERS)
    xx, xy, yy = 4 * moments[0], 4 * moments[1], 4 * moments[2]  # squared half axes of a filled ellipse
    longer = np.sqrt(np.sqrt(max(xx * yy - xy * xy, 0.0)))
    blur = BLUR if clipped else min(max((longer - radius) / 0.93, 0.5), 1.5)
    less = min(longer**2 - radius**2, 0.5 * min(xx, yy))
    xx, yy = xx - less, yy - less
    size = np.sqrt(max(xx * yy - xy * xy, 0.01))
    start[2], start[3], start[4] = yy / size / blur**2, -xy / size / blur**2, xx / size / blur**2
    start[5], start[6] = centre
    if clipped:
        start[0], start[1] = 1.5 * peak, np.sqrt(1 + (radius / blur) ** 2) - 0.4
    else:
        start[1] = np.sqrt(1 + max((radius / blur) ** 2 - 1.5, 0.5))
        start[0] = peak / (1 - 0.5 * np.exp(-0.8 * (start[1] - 1) - 0.4 * (start[1] - 1) ** 2))  # peak / Phi(c - 1)
    return start


@njit(cache=True, nogil=True, error_model="numpy")
def _is_blob(p):
    """Check that parameters describe a bright ellipse."""
    return p[0] > 0 and p[1] > 0 and p[2] > 0 and p[2] * p[4] - p[3] * p[3] > 1e-3 and abs(p[5] + p[6]) < 1e3


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy", heavy=True)
def _draw(rows, pixels, parameters):
    """Evaluate derivatives and residuals of all pixels (columns); return the sum of the squared residuals."""
    height, edge, xx, xy, yy, x0, y0 = parameters.astype(np.float32)
    zero, one, half, end, mean = (
        np.float32(0),
        np.float32(1),
        np.float32(0.5),
        np.float32(END),
        np.sqrt(xx * yy - xy * xy),
    )
    p0, p1, p2, p3, p4, p5 = PHI
    s0, s1, s2, s3, s4, s5 = _SLOPE
    flat, cost = rows.reshape(-1), zero  # only rows at constant offsets are vectorized
    for p in range(pixels):
        dx, dy = flat[8 * MOST + p] - x0, flat[9 * MOST + p] - y0
        gx, gy = xx * dx + xy * dy, xy * dx + yy * dy
        along = dx * gx + dy * gy
        away = np.sqrt(one + along)
        # The model's edge is softer along the longer axis; this makes it equally soft all around.
        steep = np.sqrt((one + mean * along) / (one + gx * gx + gy * gy))
        t = min(max(steep * (edge - away), -end), end)
        q = t * t
        rise = half + t * (p0 + q * (p1 + q * (p2 + q * (p3 + q * (p4 + q * p5)))))
        slope = height * steep * (s0 + q * (s1 + q * (s2 + q * (s3 + q * (s4 + q * s5)))))
        outward, error = slope / away, flat[10 * MOST + p] - height * rise
        flat[p], flat[MOST + p] = rise, slope
        flat[2 * MOST + p], flat[3 * MOST + p] = -half * outward * dx * dx, -outward * dx * dy
        flat[4 * MOST + p], flat[5 * MOST + p] = -half * outward * dy * dy, outward * gx
        flat[6 * MOST + p], flat[7 * MOST + p] = outward * gy, error
        cost += error * error
    return float(cost)


@njit(cache=True, nogil=True, fastmath=True, heavy=True)
def _products(rows, pixels):
    """Sum the products of derivatives and residuals: lower triangle (8, 8)."""
    products = np.empty((PARAMETERS + 1, PARAMETERS + 1))
    for i in range(PARAMETERS + 1):
        for j in range(i + 1):
            a, b, total = rows[i], rows[j], np.float32(0)
            for p in range(pixels):
                total += a[p] * b[p]
            products[i, j] = total
    return products


@njit(cache=True, nogil=True, error_model="numpy")
def _factor(normal, damping):
    """Cholesky factor of the normal matrix with its diagonal scaled by 1 + damping."""
    factor = np.empty((PARAMETERS, PARAMETERS))  # the upper triangle is never read
    for i in range(PARAMETERS):
        for j in range(i + 1):
            value = normal[i, j] * (1 + damping) if i == j else normal[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = np.sqrt(max(value, 1e-9 * normal[i, i] + 1e-12))
            else:
                factor[i, j] = value / factor[j, j]
    return factor


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(factor, right):
    """Solve with a Cholesky factor."""
    step = np.empty(PARAMETERS)
    for i in range(PARAMETERS):
        value = right[i]
        for k in range(i):
            value -= factor[i, k] * step[k]
        step[i] = value / factor[i, i]
    for i in range(PARAMETERS - 1, -1, -1):
        value = step[i]
        for k in range(i + 1, PARAMETERS):
            value -= factor[k, i] * step[k]
        step[i] = value / factor[i, i]
    return step

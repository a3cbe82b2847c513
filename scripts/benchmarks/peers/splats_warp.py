"""Coloured Gaussian splats as kernels of NVIDIA Warp, on the CPU, with Warp's own derivatives."""

# Warp interprets annotations as its own types, which a type checker does not understand. So annotations are not
# imported from __future__, and types are not checked here.
# mypy: ignore-errors

from collections.abc import Callable

import numpy as np
import warp as wp

from scripts.benchmarks.peers.splats import Images, Scene

Profiles = wp.array(dtype=wp.float32, ndim=4)
Points = wp.array(dtype=wp.vec2, ndim=2)
Colours = wp.array(dtype=wp.vec3, ndim=1)


@wp.func
def integral(edge: float, sigma: float) -> float:
    """Integrate a Gaussian of peak 1 over the pixel that starts at an edge."""
    scale = 1.0 / (1.4142135623730951 * sigma)
    return 1.2533141373155001 * sigma * (wp.erf((edge + 1.0) * scale) - wp.erf(edge * scale))


@wp.kernel
def draw_profiles(uv: Points, sigma: float, reach: int, profiles: Profiles) -> None:
    """Fill in both profiles of each splat, with one thread per pixel of a profile."""
    m, n, axis, j = wp.tid()
    centre = uv[m, n][axis]
    profiles[m, n, axis, j] = integral(float(int(wp.round(centre)) - reach + j) - 0.5 - centre, sigma)


@wp.kernel
def draw_windows(
    uv: Points,
    colours: Colours,
    reach: int,
    profiles: Profiles,
    images: Profiles,
) -> None:
    """Add splats to images (M, 3, H, W), with one thread per window row."""
    m, n, i = wp.tid()
    row = int(wp.round(uv[m, n][1])) - reach + i
    if row >= 0 and row < images.shape[2]:
        light = colours[n] * profiles[m, n, 1, i]
        left = int(wp.round(uv[m, n][0])) - reach
        for j in range(2 * reach + 1):
            column = left + j
            if column >= 0 and column < images.shape[3]:
                across = profiles[m, n, 0, j]
                wp.atomic_add(images, m, 0, row, column, light[0] * across)
                wp.atomic_add(images, m, 1, row, column, light[1] * across)
                wp.atomic_add(images, m, 2, row, column, light[2] * across)


@wp.kernel
def draw_pixels(
    uv: Points,
    colours: Colours,
    sigma: float,
    reach: int,
    images: Profiles,
) -> None:
    """Add all splats that reach a pixel to images (M, 3, H, W), with one thread per pixel.

    Splats are added, not assigned: the derivative of an assignment would clear the gradient of the images.
    """
    m, row, column = wp.tid()
    light = wp.vec3(0.0, 0.0, 0.0)
    limit = float(reach) + 0.5
    for n in range(uv.shape[1]):
        du = float(column) - uv[m, n][0]
        dv = float(row) - uv[m, n][1]
        if wp.abs(du) < limit and wp.abs(dv) < limit:
            light += colours[n] * (integral(du - 0.5, sigma) * integral(dv - 0.5, sigma))
    wp.atomic_add(images, m, 0, row, column, light[0])
    wp.atomic_add(images, m, 1, row, column, light[1])
    wp.atomic_add(images, m, 2, row, column, light[2])


class WarpSplats:
    """Launches that are recorded once, with arrays that are allocated once."""

    def __init__(self, scene: Scene, *, windows: bool, upstream: Images | None = None) -> None:
        """Prepare the arrays and launches.

        Args:
            scene: Splats to draw.
            windows: Draw window by window, else pixel by pixel.
            upstream: (M, 3, H, W) gradient with respect to the images, for `backward`.

        """
        wp.config.log_level = wp.LOG_WARNING
        (images, count, _), side, reach = scene.uv.shape, scene.side, scene.reach
        length = 2 * reach + 1
        differentiable = upstream is not None

        def zeros(*shape: int) -> wp.array:
            return wp.zeros(shape, dtype=wp.float32, device="cpu", requires_grad=differentiable)

        self.uv = wp.array(scene.uv, dtype=wp.vec2, device="cpu", requires_grad=differentiable)
        self.colours = wp.array(scene.colours, dtype=wp.vec3, device="cpu", requires_grad=differentiable)
        self.images = zeros(images, 3, side, side)
        if upstream is not None:
            self.images.grad.assign(upstream)
        inner = []
        if windows:
            profiles = zeros(images, count, 2, length)
            inner = [profiles]
            launches = [
                (draw_profiles, (images, count, 2, length), [self.uv, scene.sigma, reach], [profiles]),
                (draw_windows, (images, count, length), [self.uv, self.colours, reach, profiles], [self.images]),
            ]
        else:
            inputs = [self.uv, self.colours, scene.sigma, reach]
            launches = [(draw_pixels, (images, side, side), inputs, [self.images])]
        self._gradients = [x.grad for x in (self.uv, self.colours, *inner)]
        self._launches = [_recorded(*launch) for launch in launches]
        self._tape = wp.Tape()
        with self._tape:
            for kernel, dim, inputs, outputs in launches:
                wp.launch(kernel, dim, inputs, outputs, device="cpu")

    def forward(self) -> Images:
        """Draw the images."""
        self.images.zero_()
        for launch in self._launches:
            launch()
        images: Images = self.images.numpy()
        return images

    def backward(self) -> Images:
        """Return the gradient (M, N, 2) of the images from `forward` with respect to the points."""
        for gradient in self._gradients:
            gradient.zero_()
        self._tape.backward()
        by_uv: Images = self.uv.grad.numpy().astype(np.float32, copy=False)
        return by_uv


def _recorded(kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[object], outputs: list[object]) -> Callable:
    launch: Callable = wp.launch(kernel, dim, inputs, outputs, device="cpu", record_cmd=True).launch
    return launch

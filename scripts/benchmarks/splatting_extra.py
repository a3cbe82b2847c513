"""More on the renderers: many rigs at once, precisions and modes; infrared frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from renderers import ClutterModel, SensorModel, Spots, infrared_frames, palette, render_blobs, sample_clutter, splat
from scripts.benchmarks.effort import Effort
from scripts.timing import side_by_side

CAMERAS, FIDUCIALS, SIZE, SIGMA = 10, 8, (224, 224), 2.0
FRAME = (1088, 2048)


def many_rigs(effort: Effort) -> list[dict[str, Any]]:
    """Time splats of more images than fit into any cache, in all precisions and modes."""
    rigs = effort.pick(32, 2)
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(rigs, CAMERAS, FIDUCIALS, 2, generator=generator) * torch.tensor([SIZE[1], SIZE[0]])
    colours = palette(FIDUCIALS)
    out = torch.zeros(rigs, CAMERAS, 3, *SIZE)
    half = torch.zeros(out.shape, dtype=torch.bfloat16)
    ones = torch.ones(uv.shape[:-1])
    leaves = [x.clone().requires_grad_() for x in (uv, colours, SIGMA * ones, ones)]

    def backward() -> None:
        points, paint, size, intensity = leaves
        torch.autograd.grad(splat(points, paint, size, SIZE, intensity=intensity), leaves, out)

    def stream() -> None:
        for one in uv:
            splat(one, colours, SIGMA, SIZE, out=out[0])

    names: dict[str, Callable[[], object]] = {
        "one by one into one buffer, `out=`": stream,
        f"{rigs} rigs into a buffer, `out=`": lambda: splat(uv, colours, SIGMA, SIZE, out=out),
        f"{rigs} rigs into a bfloat16 buffer": lambda: splat(uv, colours, SIGMA, SIZE, out=half),
        f"{rigs} rigs, fresh images": lambda: splat(uv, colours, SIGMA, SIZE),
        f"{rigs} rigs, and gradients by points, colours, sizes, intensities": backward,
        f'{rigs} rigs, `compositing="over"`': lambda: splat(uv, colours, SIGMA, SIZE, compositing="over"),
        f"(clearing the images of {rigs} rigs)": out.zero_,
    }
    times = side_by_side(names, effort.pick(12.0, 0.2))
    keys = ("p50", "p99", "best")
    return [{"name": name, **{key: getattr(taken, key) / rigs for key in keys}} for name, taken in times.items()]


def infrared(effort: Effort) -> list[dict[str, Any]]:
    """Time grey frames with markers of 2 to 10 px radius, like those of `imgcal simulate`."""
    cameras, size = effort.pick((CAMERAS, FRAME), (1, (64, 64)))
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(cameras, FIDUCIALS, 2, generator=generator) * torch.tensor([size[1], size[0]])
    ones = torch.ones(cameras, FIDUCIALS)
    radius = 2 + 8 * torch.rand(cameras, FIDUCIALS, generator=generator)
    markers = Spots(uv, radius[..., None, None] ** 2 * torch.eye(2), ones, ones > 0, ones)
    clutter = sample_clutter(ClutterModel(occluded=0.2), markers, size, generator=generator)
    sensor = SensorModel(bit_depth=12, shot_noise=2.0, hot_pixels=1e-5)
    names: dict[str, Callable[[], object]] = {
        "light of the markers": lambda: render_blobs(markers, size, 0.7),
        "frames of 8 bit": lambda: infrared_frames(markers, size, generator=generator),
        "frames of 12 bit, clutter, occlusion, shot noise, hot pixels": lambda: infrared_frames(
            markers, size, sensor, clutter=clutter, generator=generator
        ),
    }
    return [{"name": name, **taken.values()} for name, taken in side_by_side(names, effort.pick(6.0, 0.1)).items()]

"""Colour-coded images: fiducials of ten cameras drawn as Gaussian splats, compared with other CPU renderers."""

from __future__ import annotations

import ctypes
import gc
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from renderers import palette, splat, splat_reference
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peer import peer, versions
from scripts.benchmarks.peers import splats as peers
from scripts.benchmarks.peers.splats import Scene
from scripts.benchmarks.splatting_extra import infrared, many_rigs
from scripts.output import BLUE, GREY, figure, markdown
from scripts.timing import side_by_side

CAMERAS, SIGMA = 10, 2.0
SCENES = ((224, 8), (224, 64), (448, 8), (448, 64))  # side of the images, fiducials
MARGIN = 8.0  # pixels to the border, because OpenCV's blur loses light there
EQUAL = 1 / 255
OURS, OURS_OUT = "**imgcal**", "**imgcal**, `out=`"
DENSE = "sum of whole images (kornia `render_gaussian2d`)"
CIRCLES = "discs, 4 x enlarged (`cv2.circle`, `cv2.resize`)"
BLUR = "impulses, then `cv2.GaussianBlur`"
NUMPY = "windows in NumPy and SciPy"
WARP_WINDOWS, WARP_PIXELS = "Warp kernel, a thread a window row", "Warp kernel, a thread a pixel"

Run = Callable[[], Any]


@dataclass(frozen=True)
class Case:
    """One method to draw a scene."""

    forward: Run  # returns the images
    backward: Run | None = None  # draws, and returns the gradient with respect to the points


def measure(effort: Effort) -> dict[str, Any]:
    """Draw the same scenes with all methods."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    scenes = [_measure_scene(side, count, effort) for side, count in effort.pick(SCENES, ((32, 3),))]
    return {
        "versions": versions("kornia", "opencv-python-headless", "numpy", "warp-lang"),
        "cameras": CAMERAS,
        "sigma": SIGMA,
        "scenes": scenes,
        "rigs": many_rigs(effort),
        "infrared": infrared(effort),
    }


def cases(scene: Scene, upstream: np.ndarray) -> dict[str, Callable[[], Case] | None]:
    """Return functions that prepare each case; None = the tool is absent."""
    shape = (len(scene.uv), 3, scene.side, scene.side)
    swapped = (len(scene.uv), scene.side, scene.side, 3)
    made: dict[str, Callable[[], Case] | None] = {
        OURS_OUT: lambda: _imgcal_out(scene),
        OURS: lambda: _imgcal(scene, torch.from_numpy(upstream)),
        DENSE: lambda: _kornia(scene, torch.from_numpy(upstream)),
        CIRCLES: lambda: _filling(scene, peers.opencv_circles, swapped, np.uint8),
        BLUR: lambda: _filling(scene, peers.opencv_blur, swapped),
        NUMPY: lambda: _filling(scene, peers.numpy_windows, shape),
        WARP_WINDOWS: None,
        WARP_PIXELS: None,
    }
    if peer("warp") is not None:
        warp: Any = import_module("scripts.benchmarks.peers.splats_warp")

        def kernels(windows: bool) -> Case:
            forward, both = (warp.WarpSplats(scene, windows=windows, upstream=x) for x in (None, upstream))
            return Case(forward.forward, lambda: (both.forward(), both.backward())[1])

        made[WARP_WINDOWS], made[WARP_PIXELS] = (lambda: kernels(True)), (lambda: kernels(False))
    return made


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables: methods, many rigs at once, infrared frames."""
    rows = []
    for scene in result["scenes"]:
        ours = next(row for row in scene["rows"] if row["name"] == OURS)
        for row in scene["rows"]:
            name = f"{scene['side']} x {scene['side']}, {scene['fiducials']}" if row is scene["rows"][0] else ""
            if "forward" not in row:
                rows.append([name, row["name"], "absent"])
                continue
            best = OURS_OUT if "out" in row["name"] else OURS
            base = next(other for other in scene["rows"] if other["name"] == best)
            equal = row["difference"] <= EQUAL
            rows.append(
                [
                    name,
                    row["name"],
                    f"{_rate(row['forward'])} ({row['forward']['p99']:.3g})",
                    _ratio(row["forward"], base["forward"]) + ("" if equal else " *"),
                    _rate(row.get("backward")),
                    _ratio(row.get("backward"), ours["backward"]) + ("" if equal or not row.get("backward") else " *"),
                    _plain(row["memory_mb"], "{:.0f}"),
                    f"{row['difference']:.1e}",
                ]
            )
    head = (
        "images, fiducials",
        "",
        "images/s (ms p99)",
        "imgcal is faster",
        "with gradient, images/s",
        "imgcal is faster",
    )
    rigs = [
        [row["name"], f"{row['p50']:.3g}", f"{row['best']:.3g}", f"{1e3 / row['p50']:,.0f}"] for row in result["rigs"]
    ]
    frames = [[row["name"], f"{row['p50']:.3g}", f"{row['p99']:.3g}"] for row in result["infrared"]]
    return {
        "splatting": markdown((*head, "memory, MB", "largest difference"), rows),
        "splatting rigs": markdown(("O10, 8 fiducials, 224 x 224", "ms per rig, p50", "best", "rigs/s"), rigs),
        "infrared": markdown(("ten frames of 2048 x 1088, 8 markers", "ms p50", "p99"), frames),
    }


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw images per second by number of splats, forward and with gradient."""
    scene = result["scenes"][0]
    rows = [row for row in scene["rows"] if "forward" in row][::-1]
    with figure(path, panels=2, size=(9.0, 3.2)) as panels:
        for axes, key, title in zip(panels, ("forward", "backward"), ("forward", "with gradient"), strict=True):
            shown = [row for row in rows if row.get(key)]
            values = [1e3 * CAMERAS / row[key]["p50"] for row in shown]
            colours = [BLUE if "imgcal" in row["name"] else GREY for row in shown]
            axes.barh([re.sub(r"[*`]| \(.*\)", "", row["name"]) for row in shown], values, color=colours)
            axes.set_xscale("log")
            axes.set_title(f"{scene['side']} x {scene['side']}, {scene['fiducials']} fiducials: {title}", fontsize=9)
            axes.set_xlabel("images/s, 1 thread")
            axes.tick_params(labelsize=8)


def _measure_scene(side: int, count: int, effort: Effort) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    uv = MARGIN + (side - 1 - 2 * MARGIN) * torch.rand(CAMERAS, count, 2, generator=generator)
    colours = palette(count)
    upstream = torch.randn(CAMERAS, 3, side, side, generator=generator).numpy()
    reference = splat_reference(uv, colours, SIGMA, (side, side)).numpy()
    scene = Scene(uv.numpy(), colours.numpy(), SIGMA, side)
    rows: dict[str, dict[str, Any]] = {}
    ready: dict[str, Case] = {}
    for name, make in cases(scene, upstream).items():
        rows[name] = {"name": name}
        if make is not None:
            ready[name] = make()
            rows[name]["difference"] = float(np.abs(as_images(ready[name].forward()) - reference).max())
            rows[name]["memory_mb"] = peak_megabytes(lambda make=make: make().forward())  # type: ignore[misc]
    seconds = effort.pick(7.0, 0.2)
    for name, taken in side_by_side({name: case.forward for name, case in ready.items()}, seconds).items():
        rows[name]["forward"] = taken.values()
    both = {name: case.backward for name, case in ready.items() if case.backward is not None}
    for name, taken in side_by_side(both, seconds).items():
        rows[name]["backward"] = taken.values()
    return {"side": side, "fiducials": count, "rows": list(rows.values())}


def as_images(drawn: Any) -> np.ndarray:
    """Convert the output of a case to (M, 3, H, W) in [0, 1]."""
    images = np.asarray(drawn.detach() if isinstance(drawn, torch.Tensor) else drawn)
    images = images / 255 if images.dtype == np.uint8 else images
    return images if images.shape[1] == 3 else images.transpose(0, 3, 1, 2)


def _imgcal_out(scene: Scene) -> Case:
    uv, colours, size = torch.from_numpy(scene.uv), torch.from_numpy(scene.colours), (scene.side, scene.side)
    out = torch.empty(len(uv), 3, *size)
    return Case(lambda: splat(uv, colours, scene.sigma, size, out=out))


def _imgcal(scene: Scene, upstream: torch.Tensor) -> Case:
    uv, colours, size = torch.from_numpy(scene.uv), torch.from_numpy(scene.colours), (scene.side, scene.side)
    leaf = uv.clone().requires_grad_()
    return Case(
        lambda: splat(uv, colours, scene.sigma, size),
        lambda: torch.autograd.grad(splat(leaf, colours, scene.sigma, size), leaf, upstream)[0],
    )


def _kornia(scene: Scene, upstream: torch.Tensor) -> Case:
    uv = torch.from_numpy(scene.uv)
    leaf = uv.clone().requires_grad_()
    return Case(
        lambda: peers.kornia_dense(scene, uv),
        lambda: torch.autograd.grad(peers.kornia_dense(scene, leaf), leaf, upstream)[0],
    )


def _filling(
    scene: Scene, function: Callable[[Scene, Any], Any], shape: tuple[int, ...], kind: Any = np.float32
) -> Case:
    images = np.empty(shape, dtype=kind)
    return Case(lambda: function(scene, images))


def peak_megabytes(run: Run) -> float | None:
    """Peak resident memory that a call adds, in MB; None if Linux does not report it."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    try:
        gc.collect()
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        reset.write_text("5")
        before = _kilobytes(status, "VmRSS")
        kept = run()
        peak = _kilobytes(status, "VmHWM")
        del kept
    except (OSError, AttributeError, TypeError):
        return None
    return max(0.0, (peak - before) / 1024)


def _kilobytes(status: Path, name: str) -> int:
    return int(re.search(rf"{name}:\s+(\d+)", status.read_text())[1])  # type: ignore[index]


def _rate(taken: Mapping[str, float] | None) -> str:
    return f"{1e3 * CAMERAS / taken['p50']:,.0f}" if taken else ""


def _ratio(taken: Mapping[str, float] | None, ours: Mapping[str, float]) -> str:
    return f"{taken['p50'] / ours['p50']:.3g} x" if taken and taken is not ours else ""


def _plain(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)

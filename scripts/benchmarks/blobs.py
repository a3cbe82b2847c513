"""Blob centres: imgcal compared with other finders and with the Cramér-Rao bound."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.detection import DetectionOptions, Frame, detect_snapshot
from imgcal.io import data_path, open_capture
from scripts.benchmarks.blob_scenes import BACKGROUND, CELLS, Cell, View, bound, rig_frames, view
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.peer import versions
from scripts.benchmarks.peers.blob_finders import FINDERS, SLOW, Known, present
from scripts.output import BLUE, GREEN, GREY, RED, figure, markdown
from scripts.timing import side_by_side
from tests.imgcal.detection.discs import nearest

OURS = "imgcal"
GATE = 1.0  # px; a centre farther from the truth is false
EQUAL = 2.0  # standard errors
PACKAGES = ("opencv-contrib-python-headless", "scikit-image", "photutils", "trackpy")


def measure(effort: Effort) -> dict[str, Any]:
    """Run every finder on the same frames of every cell, then time them on one frame."""
    cv2.setNumThreads(1)
    shape, frames = effort.pick((480, 640), (120, 160)), effort.pick(4, 1)
    cells = effort.pick(CELLS, CELLS[:1] + CELLS[-1:])
    return {
        "versions": versions(*PACKAGES),
        "frames": frames,
        "shape": list(shape),
        "cells": [accuracy(cell, shape, frames, number) for number, cell in enumerate(cells)],
        "time": times(effort),
        "rig": rig_times(effort),
    }


def accuracy(cell: Cell, shape: tuple[int, int], frames: int, seed: int) -> dict[str, Any]:
    """Recall, false blobs and errors of each finder in one cell, and the best peer."""
    rng = np.random.default_rng(seed)
    views = [view(cell, shape, rng) for _ in range(frames)]
    errors = {}
    scores = {}
    for name, find in FINDERS.items():
        if not present(name):
            continue
        seen = views[:1] if name in SLOW else views
        errors[name], false = errors_of([find(one.frame, cell.known) for one in seen], seen)
        scores[name] = score(errors[name], np.concatenate([one.uv for one in seen])) | {"false": false / len(seen)}
    values = {"cell": cell.name, "discs": sum(len(one.uv) for one in views), "bound": bound(cell, rng)}
    return values | {"finders": scores, "peer": best_peer(errors)}


def errors_of(found: Iterable[NDArray[np.float64]], views: Sequence[View]) -> tuple[NDArray[np.float64], int]:
    """Errors (M, 2) px of all true centres, NaN for missed ones; and the number of false centres."""
    errors, false = [], 0
    for centres, one in zip(found, views, strict=True):
        rows, distance = nearest(centres, one.uv)
        hit = distance < GATE
        error = np.full((len(one.uv), 2), np.nan)
        error[hit] = centres[rows[hit]] - one.uv[hit]
        errors.append(error)
        false += len(centres) - len(np.unique(rows[hit]))
    return np.concatenate(errors), false


def score(errors: NDArray[np.float64], uv: NDArray[np.float64]) -> dict[str, float]:
    """Recall; RMS per axis and its standard error; largest mean of an axis; amplitude over the subpixel phase."""
    hit = np.isfinite(errors).all(1)
    if hit.sum() < 3:
        return {"recall": float(hit.mean())}
    seen, squares = errors[hit], (errors[hit] ** 2).mean(1)
    rms = float(np.sqrt(squares.mean()))
    wave = [2 * (seen * turn(2 * np.pi * uv[hit])).mean(0) for turn in (np.cos, np.sin)]
    return {
        "recall": float(hit.mean()),
        "rms": rms,
        "rms_error": float(squares.std() / np.sqrt(len(squares)) / (2 * rms)),
        "bias": float(abs(seen.mean(0)).max()),
        "phase": float(np.hypot(*wave).max()),
    }


def best_peer(errors: Mapping[str, NDArray[np.float64]]) -> dict[str, Any]:
    """Find the most accurate peer that finds nearly everything, and compare it with imgcal on discs that both found.

    `gap` is the difference of the mean squared errors, peer minus imgcal, in units of its standard error.
    """
    ours = errors[OURS]
    rivals = {}
    for name, theirs in errors.items():
        both = np.isfinite(theirs).all(1) & np.isfinite(ours[: len(theirs)]).all(1)
        if name == OURS or both.sum() < 0.9 * len(theirs):
            continue
        mine, other = ((x[: len(theirs)][both] ** 2).mean(1) for x in (ours, theirs))
        error = (other - mine).std() / np.sqrt(both.sum())
        rivals[name] = {
            "ratio": float(np.sqrt(other.mean() / mine.mean())),
            "gap": float((other - mine).mean() / error),
        }
    if not rivals:
        return {}
    name = min(rivals, key=lambda one: rivals[one]["ratio"])
    return {"name": name} | rivals[name]


def times(effort: Effort) -> dict[str, dict[str, float]]:
    """Time every finder on one frame with ten blobs, one thread."""
    frame = next(iter(rig_frames(effort.pick((1088, 2048), (240, 320)), 1).values()))
    known = Known(4.0, 200.0, 2.0, BACKGROUND)
    cases = {name: partial(find, frame, known) for name, find in FINDERS.items() if present(name)}
    taken = side_by_side(cases, effort.pick(30.0, 0.5))
    return {name: one.values() | {"blobs": len(cases[name]())} for name, one in taken.items()}


def rig_times(effort: Effort) -> dict[str, Any]:
    """Time blob detection in ten frames in memory with one and two threads; OpenCV's components for reference."""
    shape, sample = effort.pick((1088, 2048), (240, 320)), open_capture(data_path("samples", "O10"))
    drawn = rig_frames(shape)
    scenes: dict[str, Mapping[str, Frame | None]] = {
        "2048 x 1088, 10 blobs": drawn,
        "2048 x 1088, 3 blobs": rig_frames(shape, blobs=3),
        "1024 x 544, the sample": next(frames for _, frames in sample.snapshots()),
    }

    def components() -> None:
        for frame in drawn.values():
            cv2.connectedComponentsWithStats((frame > 120).astype(np.uint8))

    options = DetectionOptions()
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(2) as two:
        cases: dict[str, Callable[[], object]] = {
            f"{name}: imgcal, {title}": partial(detect_snapshot, frames, options, pool=pool)
            for name, frames in scenes.items()
            for title, pool in (("1 thread", one), ("2 threads", two))
        }
        cases["2048 x 1088, 10 blobs: threshold and components"] = components
        taken = side_by_side(cases, effort.pick(16.0, 0.3))
    return {name: one.values() for name, one in taken.items()}


def tables(result: Mapping[str, Any]) -> dict[str, str]:
    """Make the tables of errors, recall and bias of every cell, and of times."""
    names = list(FINDERS)
    cells = result["cells"]
    return {
        "blobs best": _best(cells),
        "blobs accuracy": markdown(
            ["RMS (px)", "limit", *names],
            [[cell["cell"], f"{cell['bound']:.4f}", *_row(cell, names, _rms)] for cell in cells],
        ),
        "blobs finding": markdown(
            ["recall % / false per frame", *names], [[cell["cell"], *_row(cell, names, _found)] for cell in cells]
        ),
        "blobs bias": markdown(
            ["bias / phase (px)", *names], [[cell["cell"], *_row(cell, names, _bias)] for cell in cells]
        ),
        "blobs time": _time(result["time"]),
        "blobs rig": _rig(result["rig"]),
    }


def _best(cells: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for cell in cells:
        ours, peer = cell["finders"][OURS], cell["peer"]
        row = [cell["cell"], f"{cell['bound']:.4f}", f"{ours['rms']:.4f} ± {ours['rms_error']:.4f}"]
        row.append(f"{ours['rms'] / cell['bound']:.2f}")
        if peer:
            verdict = "equal" if abs(peer["gap"]) < EQUAL else "ahead" if peer["gap"] > 0 else "**behind**"
            row += [peer["name"], f"{peer['ratio']:.2f}", verdict]
        rows.append(row)
    head = ["", "limit (px)", "imgcal RMS (px)", "RMS / limit", "best peer", "its RMS / imgcal's", "imgcal is"]
    return markdown(head, rows)


def _row(cell: Mapping[str, Any], names: Sequence[str], text: Any) -> list[str]:
    finders = cell["finders"]
    known = [finders[name]["rms"] for name in names if name in finders and "rms" in finders[name]]
    return [text(finders[name], min(known)) if name in finders else "absent" for name in names]


def _rms(one: Mapping[str, float], best: float) -> str:
    if "rms" not in one:
        return "not found"
    text = f"{one['rms']:.4f}"
    return f"**{text}**" if one["rms"] == best else text


def _found(one: Mapping[str, float], best: float) -> str:
    return f"{100 * one['recall']:.1f} / {one['false']:.1f}"


def _bias(one: Mapping[str, float], best: float) -> str:
    return f"{one['bias']:.4f} / {one['phase']:.4f}" if "rms" in one else ""


def _time(taken: Mapping[str, Mapping[str, float]]) -> str:
    rows = []
    for name in FINDERS:
        if name not in taken:
            rows.append([name, "absent"])
            continue
        one = taken[name]
        ratio = one["p50"] / taken[OURS]["p50"]
        rows.append([name, f"{one['p50']:.2f}", f"{one['p99']:.2f}", f"{ratio:,.1f}", str(one["blobs"])])
    return markdown(["", "ms p50", "p99", "relative to imgcal", "found (of 10)"], rows)


def _rig(taken: Mapping[str, Any]) -> str:
    rows = [[name, f"{one['p50']:.2f}", f"{one['p99']:.2f}", f"{1e3 / one['p50']:.0f}"] for name, one in taken.items()]
    return markdown(["ten frames", "ms p50", "p99", "rigs/s"], rows)


SHOWN = {
    OURS: BLUE, "cv2.SimpleBlobDetector": RED, "trackpy.locate": GREEN, "photutils centroid_2dg": "#b8860b",
    "photutils centroid_com": "#8a5fb0", "threshold centroid": GREY,
}  # fmt: skip


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw errors relative to the bound, one row per cell."""
    cells = result["cells"]
    with figure(path, size=(8.0, 0.6 + 0.28 * max(len(cells), 6))) as (axes,):
        for name, colour in SHOWN.items():
            points = [
                (cell["finders"][name]["rms"] / cell["bound"], row)
                for row, cell in enumerate(cells)
                if "rms" in cell["finders"].get(name, {})
            ]
            if points:
                axes.plot(*zip(*points, strict=True), "o", color=colour, markersize=5, label=name)
        axes.axvline(1.0, color="black", linewidth=1)
        axes.set_xscale("log")
        axes.set_yticks(range(len(cells)), [cell["cell"] for cell in cells], fontsize=8)
        axes.invert_yaxis()
        axes.set_xlabel("RMS error over the Cramér-Rao bound")
        axes.legend(fontsize=8)

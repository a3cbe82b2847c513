"""Test networks on markers unlike those in training, before and after adaptation to some frames.

    python -m scripts.results.unlike_markers --runs out/unlike

Rig O10 and object asymmetric8 with squares, rings, bars, dark discs or bloomed lamps as markers, among false round
discs. The rig is known, as after a calibration. `imgcal harvest` labels 3 to 100 frames (ten per snapshot), `imgcal
train --from` adapts network and measurer, and other snapshots are measured, with an assumed pose that is wrong by
1 degree and 8 mm. Right and wrong are defined as in `scripts.results.infrared`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

import imgcal
from imgcal.association import Proposer, Sight, Snapshot, match_to_rig
from imgcal.detection import DetectionOptions, detect_snapshot, to_detections
from imgcal.errors import RefusedError
from imgcal.io import MODEL
from imgcal.matching import MatchedFilter
from imgcal.networks import Expectation, load_infrared, load_measurer
from imgcal.pipeline.learned_proposer import LearnedProposer
from imgcal.synthesis import PhysicalDrift, simulate_truth
from imgcal.training import (
    HELD_OUT,
    HELD_OUT_PATCHES,
    TRAIN,
    TRAIN_PATCHES,
    FrameDataset,
    PatchDataset,
    cut_labelled,
    split,
)
from imgcal.types import CameraRig, Detections, RigPrior
from scripts.output import RESULTS, ROOT, command, fill, markdown, read_json, surroundings, write_json
from scripts.results.infrared import Case, Tally, ask

JSON, PAGE = RESULTS / "unlike_markers.json", RESULTS / "infrared.md"
MARKERS = ("squares", "rings", "bars", "dark", "bloomed")
FRAMES = {3: (0,), 10: (0,), 30: (0, 1, 2), 100: (0,)}  # numbers of frames, and the seeds of each
CLUTTER = 15  # false round discs per frame
SNAPSHOTS = 3  # snapshots to measure
GROUND, LIGHT, NOISE = 25.0, 130.0, 4.0  # grey levels
MEASURER = "-measurer"  # suffix of the folders of adapted measurers
DRAWN = 24  # px, half of the window that a marker is drawn in


def draw(frame: NDArray[np.float64], place: NDArray[np.float64], radius: float, shape: str, angle: float) -> None:
    """Add the light of one marker; each pixel is the mean of nine samples."""
    middle = np.rint(place).astype(int)
    low, high = np.maximum(middle - DRAWN, 0), np.minimum(middle + DRAWN + 1, frame.shape[::-1])
    if (low >= high).any():
        return
    parts = (np.arange(3) - 1) / 3
    u = (np.arange(low[0], high[0])[:, None] + parts).ravel() - place[0]
    v = (np.arange(low[1], high[1])[:, None] + parts).ravel() - place[1]
    x = (u * np.cos(angle) + v[:, None] * np.sin(angle)) / radius
    y = (v[:, None] * np.cos(angle) - u * np.sin(angle)) / radius
    far = np.hypot(x, y)
    light = {
        "squares": np.maximum(abs(x), abs(y)) < 0.9,
        "rings": abs(far - 1.6) < 0.35,
        "bars": (abs(x) < 2.4) & (abs(y) < 0.4),
        "bloomed": 3 / (1 + far**4) + 0.25 * np.exp(-abs(y) / 0.4 - abs(x) / 4) + 0.25 / (1 + far**2),
    }.get(shape, far < 1).astype(np.float64)
    drawn = light.reshape(high[1] - low[1], 3, high[0] - low[0], 3).mean((1, 3))
    frame[low[1] : high[1], low[0] : high[0]] += drawn


def draw_frames(
    rig: CameraRig, expected: Expectation, shape: str, random: np.random.Generator
) -> dict[str, NDArray[np.uint8]]:
    """Draw the markers of one moment, and clutter, into a frame of each camera."""
    frames = {}
    for camera, name in enumerate(rig.camera_names):
        width, height = rig.image_size[camera].tolist()
        light = np.zeros((height, width))
        usual = float(expected.radius[0, camera].median())
        for _ in range(CLUTTER):
            draw(light, random.uniform((0, 0), (width, height)), usual * random.uniform(0.7, 1.3), "discs", 0.0)
        for fiducial in np.flatnonzero(expected.visible[0, camera].numpy()):
            place, size = expected.uv[0, camera, fiducial].numpy(), float(expected.radius[0, camera, fiducial])
            draw(light, place, size, shape, random.uniform(0, np.pi))
        shown = 190 - 130 * light if shape == "dark" else GROUND + LIGHT * light
        shown += NOISE * random.standard_normal(light.shape)
        frames[name] = np.clip(np.rint(shown), 0, 255).astype(np.uint8)
    return frames


def snapshots(rig: CameraRig, shape: str, count: int, seed: int) -> Iterator[tuple[CameraRig, Case]]:
    """Make snapshots of drifted rigs: the true rig, and the case."""
    obj, generator = imgcal.load_object("asymmetric8"), torch.Generator().manual_seed(seed)
    truth = simulate_truth(rig, obj, count, generator, PhysicalDrift())
    random, options = np.random.default_rng(seed), DetectionOptions(polarity="dark" if shape == "dark" else "bright")
    for number in range(count):
        expected = Expectation.of(truth.rig, obj, truth.rig_from_object[number][None])
        frames = draw_frames(rig, expected, shape, random)
        found = to_detections([detect_snapshot(frames, options)], rig.camera_names, ("0",))
        blobs = match_to_rig(found, rig)
        snapshot = Snapshot(frames, blobs, rig, obj, (rig.prior or RigPrior()).std(rig), (), options)
        yield (
            truth.rig,
            Case(snapshot, expected.uv[0].numpy(), expected.visible[0].numpy(), truth.rig_from_object[number]),
        )


def prepare(runs: Path, markers: Sequence[str] = MARKERS) -> None:
    """Harvest labels from frames of each kind of marker, with the known rig."""
    rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
    for shape in markers:
        for count in FRAMES:
            some = rig.select(range(min(count, 10)))
            made = list(snapshots(some, shape, max(count // 10, 1), 1000 + count))
            known, options = made[0][0], made[0][1].snapshot.detection
            frames = [case.snapshot.frames for _, case in made]
            series = {name: [each[name] for each in frames] for name in some.camera_names}
            sight = Sight(MatchedFilter(), frames.__getitem__, True, options)
            try:
                crops, cut = cut_labelled(frames.__getitem__, imgcal.detect(series, options), known, obj,
                                          detection=options, sight=sight)  # fmt: skip
                splits = split(crops, len(frames), some.num_cameras)
                parts: list[FrameDataset | PatchDataset] = [*splits, *split(cut, len(frames), some.num_cameras)]
            except RefusedError as error:
                print(f"{shape}, {count} frames: {error}", flush=True)
                continue
            folder = runs / "data" / f"{shape}-{count}"
            folder.mkdir(parents=True, exist_ok=True)
            for name, part in zip((TRAIN, HELD_OUT, TRAIN_PATCHES, HELD_OUT_PATCHES), parts, strict=True):
                part.save(folder / name, {"markers": shape})
            print(f"{shape}, {count} frames: {len(splits[0])} and {len(splits[1])} crops", flush=True)


def trainings(runs: Path, markers: Sequence[str] = MARKERS) -> list[list[str]]:
    """Arguments of `imgcal train` for each adaptation."""
    return [
        [name, "--from", f"{runs}/data/{shape}-{count}", "--out", f"{runs}/{shape}-{count}-{seed}{suffix}",
         "--set", f"training.seed={seed}"]
        for count, seeds in reversed(FRAMES.items()) for shape in markers for seed in seeds
        for name, suffix in (("ir-cnn", ""), ("measurer-cnn", MEASURER))
        if (runs / "data" / f"{shape}-{count}").is_dir()
    ]  # fmt: skip


def methods(shape: str, runs: Path) -> dict[str, tuple[Path, Path] | None]:
    """Files of query network and measurer of each method that there is; None = the matched filter."""
    shipped = ROOT / "data" / "models"
    pairs = {"ir-cnn": (shipped / "ir-cnn.safetensors", shipped / "measurer-cnn.safetensors")} | {
        f"{count} frames, seed {seed}": (
            runs / f"{shape}-{count}-{seed}" / MODEL, runs / f"{shape}-{count}-{seed}{MEASURER}" / MODEL,
        )
        for count, seeds in FRAMES.items() for seed in seeds
    }  # fmt: skip
    there = {name: pair for name, pair in pairs.items() if all(path.is_file() for path in pair)}
    return {"matched filter": None, **there}


def measured(shape: str, name: str, runs: Path) -> dict[str, Any]:
    """Run a method on the same snapshots as all others."""
    torch.set_num_threads(1)
    pair = methods(shape, runs)[name]
    method: Proposer = MatchedFilter()
    if pair is not None:
        method = LearnedProposer(load_infrared(pair[0]).network, load_measurer(pair[1]).network)
    tally = Tally()
    for number, (_, case) in enumerate(snapshots(imgcal.load_rig("O10"), shape, SNAPSHOTS, 77)):
        ask(partial(_detections, method), case, 1.0, number, tally)
    return tally.result()


def _detections(method: Proposer, snapshot: Snapshot) -> Detections:
    return method.propose(snapshot).detections


def tables(found: dict[str, Any]) -> str:
    """Make a table of right and wrong by marker and method; mean over seeds."""
    measured_names = {name.partition(", seed")[0] for methods in found.values() for name in methods}
    columns = [
        name for name in ("matched filter", "ir-cnn", *(f"{n} frames" for n in FRAMES)) if name in measured_names
    ]
    lines = []
    for shape, methods in found.items():
        line = [shape]
        for column in columns:
            said = [each for name, each in methods.items() if name == column or name.startswith(f"{column}, seed")]
            right, wrong = (np.mean([each[f"{kind}_percent"] for each in said]) if said else np.nan
                            for kind in ("right", "wrong"))  # fmt: skip
            line.append(f"{right:.1f} / {wrong:.1f}" if said else "")
        lines.append(line)
    return markdown(["right % of visible / wrong % of claimed", *columns], lines)


def main(
    runs: Path,
    steps: tuple[str, ...] = ("prepare", "train", "measure", "page"),
    cores: int = 1,
    markers: tuple[str, ...] = MARKERS,
) -> None:
    """Harvest, adapt, measure, and write the JSON and the table.

    Args:
        runs: folder of data sets and training runs.
        steps: prepare, train, measure, page.
        cores: processes at once.
        markers: kinds of markers; the JSON keeps the rows of the others.
    """
    if "prepare" in steps:
        prepare(runs, markers)
    if "train" in steps:
        for arguments in trainings(runs, markers):
            if not (Path(arguments[4]) / MODEL).is_file():
                subprocess.run([sys.executable, "-m", "imgcal", "train", *arguments], check=True, env={**os.environ})
    if "measure" in steps:
        todo = [(shape, name) for shape in markers for name in methods(shape, runs)]
        with ProcessPoolExecutor(cores) as pool:
            results = list(pool.map(measured, *zip(*todo, strict=True), [runs] * len(todo)))
        found = {shape: {name: each for (of, name), each in zip(todo, results, strict=True) if of == shape}
                 for shape in markers}  # fmt: skip
        known = read_json(JSON) if JSON.is_file() else {"markers": {}, "measured_on": {}}
        all_rows, machine = known["markers"] | found, surroundings()["machine"]
        rows = {shape: all_rows[shape] for shape in MARKERS if shape in all_rows}
        machines = known["measured_on"] | dict.fromkeys(found, machine)
        write_json(JSON, {"measured_on": machines, "snapshots": SNAPSHOTS, "markers": rows})
    if "page" in steps:
        fill(PAGE, {"unlike markers": tables(read_json(JSON)["markers"])})


if __name__ == "__main__":
    command(lambda: tyro.cli(main, args=sys.argv[1:], description=__doc__))

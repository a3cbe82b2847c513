"""A rig that starts with its factory calibration before the recorded wand: false events, and how wrong it is.

Run as `python -m scripts.benchmarks.factory_starts`: ten minutes on one core. Nothing moved in this recording, so every
event except the loss of the wand is false. Starts are at several frames and steps. The focal lengths are compared with
a calibration from the whole recording. `white` replaces the blobs by the wand's images in that rig, with independent
noise: what is wrong there is due to the estimate alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import imgcal
from imgcal.association import accepted_observations
from imgcal.types import CameraRig, Detections
from scripts.benchmarks.real_stream import QUIET
from scripts.benchmarks.wand_recording import FRAMES, RATE, calibrated, recording
from scripts.output import ROOT, command, markdown, publish, surroundings

RESULT, PAGE = ROOT / "docs" / "benchmarks" / "factory_starts.json", ROOT / "docs" / "benchmarks" / "tables.md"
STARTS = ((0, 1), (600, 1), (1000, 1), (1700, 1), (2000, 1), (2400, 1), (3200, 1), (3600, 1),
          (500, 8), (1000, 4), (1700, 3), (2000, 2))  # fmt: skip
"""First frame and step."""
SHOWN = (100, 300, 600, 1200)
"""Numbers of snapshots after which the rig is judged."""
CALIBRATED_EVERY, TOGETHER = 8, 400
NOISE = 0.1  # px


@dataclass(frozen=True)
class Options:
    """Start with the factory calibration, at several moments of the recording."""

    most: int = 2400  #: snapshots of each run
    white: int = 3  #: runs with white noise, at the first starts with step 1
    out: Path = RESULT


@lru_cache(maxsize=1)
def reference() -> CameraRig:
    """The rig calibrated from the whole recording."""
    given = recording()
    return imgcal.calibrate(
        given.chosen(range(0, FRAMES, CALIBRATED_EVERY)), given.factory, given.obj
    ).rig.as_constant()


@lru_cache(maxsize=1)
def images() -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """By frame: which fiducials (C, N) were seen, and their images (C, N, 2) in the reference rig."""
    given, rig, obj = recording(), reference(), calibrated().calibration.object.as_exact()
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for first in range(0, FRAMES, TOGETHER):
        labelled = imgcal.score(given.chosen(range(first, first + TOGETHER)), rig, obj).labelled
        observations, poses = accepted_observations(labelled, rig, obj)
        if poses is None:
            continue
        points = poses.apply(obj.points)
        uv = rig.expand(len(points)).project_values(points, obj.radius).uv.numpy()
        numbers = [int(labelled.snapshots[row].name) for row in labelled.used]
        found |= {number: (observations.seen[row].numpy(), uv[row]) for row, number in enumerate(numbers)}
    return found


def with_white_noise(seed: int) -> Callable[[int], Detections]:
    """Blobs of a frame as its wand would show them in the reference rig."""
    draw, given = np.random.default_rng(seed), recording()

    def frame(number: int) -> Detections:
        blobs = given.frame(number)
        seen, uv = images().get(number, (np.zeros((0, 0), bool), None))
        camera, fiducial = np.nonzero(seen)
        if uv is None or len(blobs) < len(camera):
            return blobs.select(np.arange(0))
        shown = uv[camera, fiducial] + draw.normal(0, NOISE, (len(camera), 2))
        sigma, nothing = np.full(len(camera), NOISE), np.full(len(camera), -1)
        return replace(blobs.select(np.arange(len(camera))), uv=shown, camera=camera, fiducial=nothing, sigma=sigma)

    return frame


def run(start: int, step: int, most: int, seed: int | None = None) -> dict[str, Any]:
    """Follow the recording from one frame on."""
    given, known = recording(), calibrated()
    frame = given.frame if seed is None else with_white_noise(seed)
    false, shown = [], {}
    with imgcal.RigKeeper(given.factory, given.obj) as keeper:
        for count, number in enumerate(range(start, min(start + step * most, FRAMES), step), 1):
            state = keeper.update(frame(number), time=number / RATE)
            false += [[count, event.message] for event in state.events if event.kind not in QUIET]
            if count in SHOWN:
                wrong = (state.rig.focal_length - reference().focal_length) / keeper.belief.std()[:, 6:8]
                shown[count] = {"rms_px": known.score(state.rig)[0], "nees": float(wrong.square().mean())}
    return {"start": start, "step": step, "noise": "recorded" if seed is None else "white",
            "snapshots": count, "false": false, "after": shown}  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """Make the page's table."""
    rows = [
        [f"{one['noise']}, frame {one['start']}", str(one["step"]), str(len(one["false"])), *map(_cell, _judged(one))]
        for one in result["runs"]
    ]
    return markdown(["noise, start", "every", "false events", *(f"after {count}: px (NEES)" for count in SHOWN)], rows)


def _judged(one: dict[str, Any]) -> list[dict[str, float] | None]:
    return [one["after"].get(count) for count in SHOWN]


def _cell(judged: dict[str, float] | None) -> str:
    return "" if judged is None else f"{judged['rms_px']:.2f} ({judged['nees']:.1f})"


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    runs = []
    cases: list[tuple[int, int, int | None]] = [(*start, None) for start in STARTS]
    cases += [(*start, seed) for seed, start in enumerate(STARTS[: options.white])]
    for start, step, seed in cases:
        runs.append(run(start, step, options.most, seed))
        print(table({"runs": runs[-1:]}).splitlines()[-1], flush=True)
    publish({**surroundings(), "runs": runs}, options.out, RESULT, PAGE, "factory starts", table({"runs": runs}))


if __name__ == "__main__":
    command(main)

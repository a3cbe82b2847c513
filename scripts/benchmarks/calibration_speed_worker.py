"""Run the cases of `calibration_speed` with the first imgcal on the path, perhaps that of another checkout.

Needs only the names in `imgcal.__all__`. Reads lines `CASE SECONDS` from standard input, runs the case for about that
time, and writes a line with the CPU time (ms) of each call, as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from itertools import count, cycle
from pathlib import Path

import numpy as np
import torch

import imgcal
from imgcal import Detections, PipelineOptions, calibrate, load_object, load_rig


class Case:
    """Calibrations of several captures in turn, or a live stream that is played forwards and backwards."""

    def __init__(self, folder: Path, name: str) -> None:
        """Read `NAME.json`, rig, object and window (0 = a calibration of all snapshots), and `NAME.npz`, the blobs."""
        given = json.loads((folder / f"{name}.json").read_text())
        rig, obj = load_rig(given["rig"]), load_object(given["object"])
        with np.load(folder / f"{name}.npz") as columns:
            values = dict(columns)
        capture = values.pop("capture", np.zeros(len(values["uv"]), dtype=int))
        snapshots = int(values["snapshot"].max()) + 1
        names = tuple(f"{s:05d}" for s in range(snapshots))
        blobs = Detections(**values, camera_names=rig.camera_names, snapshot_names=names)
        self._call: Callable[[], object]
        if given["window"]:
            stream = _there_and_back([blobs.of_snapshots(s, s + 1) for s in range(snapshots)])
            self._call = _follow(rig, obj, given["window"], stream)
        else:
            captures = cycle([blobs.select(capture == number) for number in np.unique(capture)])
            self._call = lambda: calibrate(next(captures), rig, obj)
        for _ in range(3 + 2 * given["window"]):  # compile, and fill the window
            self._call()

    def run(self, seconds: float) -> list[float]:
        """Repeat calls for about this time, at least once; return the CPU time of each call, ms."""
        taken: list[float] = []
        while not taken or sum(taken) < 1e3 * seconds:
            began = time.process_time()
            self._call()
            taken.append(1e3 * (time.process_time() - began))
        return taken


def _follow(
    rig: imgcal.CameraRig, obj: imgcal.CalibrationObject, window: int, stream: Iterator[Detections]
) -> Callable[[], object]:
    """Make an update of a running rig from its last snapshots; other checkouts may not have a horizon."""
    if hasattr(imgcal, "Recalibrator"):
        live = imgcal.Recalibrator(rig, obj, PipelineOptions(blind_cameras=True), window=window)
        return lambda: live.update(next(stream))
    keeper, moments = imgcal.RigKeeper(rig, obj, horizon=window), count()
    return lambda: keeper.update(next(stream), next(moments) / 60)


def _there_and_back(parts: list[Detections]) -> Iterator[Detections]:
    while True:
        yield from parts
        yield from parts[-2:0:-1]


def main() -> None:
    """Answer requests until standard input ends."""
    torch.set_num_threads(int(sys.argv[2]))
    folder, cases = Path(sys.argv[1]), dict[str, Case]()
    for line in sys.stdin:
        name, seconds = line.split()
        if name not in cases:
            cases[name] = Case(folder, name)
        print(json.dumps(cases[name].run(float(seconds))), flush=True)


if __name__ == "__main__":
    main()

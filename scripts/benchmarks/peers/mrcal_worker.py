"""Run mrcal with Debian's Python, without imgcal: reads tasks from an npz, then an index per line; writes seconds.

    /usr/bin/python3 mrcal_worker.py TASKS.npz ANSWERS.npz

The answers go into another npz. Convention: millimetres become metres, the unit that mrcal's scales assume.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import mrcal  # type: ignore[import-not-found]
import numpy as np


def stated(tasks: dict[str, Any], index: int) -> dict[str, Any]:
    """Arguments of mrcal.optimize: the object is the world, and each camera in each snapshot has a separate pose."""
    uv = tasks["uv"][index]
    snapshots, cameras, fiducials, _ = uv.shape
    place, camera, fiducial = (
        axis.ravel() for axis in np.meshgrid(*map(np.arange, (snapshots, cameras, fiducials)), indexing="ij")
    )
    seen = np.column_stack((uv.reshape(-1, 2), np.ones(uv.size // 2)))
    indices = np.column_stack((fiducial, camera, place * cameras + camera)).astype(np.int32)
    return {
        "intrinsics": tasks["intrinsics"][index].copy(),
        "extrinsics_rt_fromref": tasks["extrinsics"][index].reshape(-1, 6).copy(),
        "frames_rt_toref": None,
        "points": tasks["points"] / 1000,
        "observations_board": None,
        "indices_frame_camintrinsics_camextrinsics": None,
        "observations_point": seen,
        "indices_point_camintrinsics_camextrinsics": indices,
        "lensmodel": "LENSMODEL_OPENCV5",
        "imagersizes": np.tile(tasks["image_size"], (cameras, 1)).astype(np.int32),
        "Npoints_fixed": fiducials,
        "point_min_range": 0.01,
        "point_max_range": 100.0,
        "do_optimize_intrinsics_distortions": bool(tasks["distortion"]),
        "do_optimize_calobject_warp": False,
        "do_apply_outlier_rejection": False,
        "verbose": False,
    }


def main(given: str, answers: str) -> None:
    """Solve requested tasks, and write the last answer of each."""
    tasks = dict(np.load(given))
    intrinsics, extrinsics = tasks["intrinsics"].copy(), tasks["extrinsics"].copy()
    for line in sys.stdin:
        index = int(line)
        arguments = stated(tasks, index)
        begin = time.perf_counter()
        try:
            mrcal.optimize(**arguments)
            seconds = time.perf_counter() - begin
        except RuntimeError:
            print("nan", flush=True)
            continue
        intrinsics[index] = arguments["intrinsics"]
        extrinsics[index] = arguments["extrinsics_rt_fromref"].reshape(extrinsics.shape[1:])
        print(seconds, flush=True)
    np.savez(answers, intrinsics=intrinsics, extrinsics=extrinsics)


if __name__ == "__main__":
    main(*sys.argv[1:])

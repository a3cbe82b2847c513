"""Measure identity: right, wrong and refused snapshots, and the time of a cold start and of tracking.

    python scripts/benchmarks/bench_identity.py [--snapshots 500] [--out scripts/benchmarks/results/identity.json]

O10, factory values off by 5 % in every parameter, poses over the whole hemisphere, centres with 0.1 px noise.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.formats import load_object, load_rig
from imgcal.identity import Identity, bootstrap, track
from imgcal.objects import CalibrationObject
from imgcal.observations import Detections
from imgcal.rig import CameraRig
from imgcal.synthesis import RelativeDrift, synthesize
from imgcal.transforms import RigidTransform

DATA = Path(__file__).parents[2] / "data"
DRIFT = RelativeDrift(0.05, 0.05)
NOISE = 0.1  # px
CASES = (  # object, visible fiducials and false blobs a camera, where the false ones are
    ("asymmetric8", 8, 0, "image"),
    ("asymmetric8", 6, 2, "image"),
    ("asymmetric8", 5, 3, "image"),
    ("asymmetric8", 6, 2, "pattern"),
    ("asymmetric8", 5, 3, "pattern"),
    ("cube8", 6, 2, "image"),
)


def blobs_of(
    uv: NDArray[np.float64], rig: CameraRig, visible: int, false: int, where: str, generator: np.random.Generator
) -> tuple[Detections, NDArray[np.int64]]:
    """Make the blobs of one snapshot from projections (C, N, 2): a random choice of fiducials, and false ones.

    Args:
        uv: projections.
        rig: for names and image sizes.
        visible: fiducials seen in each camera.
        false: false blobs in each camera.
        where: they lie anywhere in the image, or near the pattern: in its bounding box enlarged by 1.5.
        generator: source of randomness.

    Returns:
        The blobs in random order, and the fiducial of each, -1 = false.
    """
    places, labels = [], []
    for projected, size in zip(uv, rig.image_size.numpy(), strict=True):
        seen = generator.permutation(len(projected))[:visible]
        low, high = np.zeros(2), size - 1.0
        if where == "pattern":
            middle, half = (projected.min(0) + projected.max(0)) / 2, 0.75 * np.ptp(projected, axis=0)
            low, high = np.maximum(low, middle - half), np.minimum(high, middle + half)
        blobs = projected[seen] + NOISE * generator.standard_normal((visible, 2))
        order = generator.permutation(visible + false)
        places.append(np.concatenate((blobs, generator.uniform(low, high, (false, 2))))[order])
        labels.append(np.concatenate((seen, np.full(false, -1)))[order])
    count = rig.cameras * (visible + false)
    detections = Detections(
        uv=np.concatenate(places),
        sigma=np.full(count, NOISE),
        camera=np.repeat(np.arange(rig.cameras), visible + false),
        snapshot=np.zeros(count, dtype=np.int64),
        fiducial=np.full(count, -1),
        radius=np.full(count, np.nan),
        flags=np.zeros(count, dtype=np.uint8),
        camera_names=rig.camera_names,
        snapshot_names=("0",),
    )
    return detections, np.concatenate(labels)


def wrong_labels(found: Identity, truth: NDArray[np.int64], obj: CalibrationObject) -> tuple[int, int]:
    """Count wrong and right labels, under the symmetry element that fits best: one for all cameras."""
    named = found.labels >= 0
    moved = [np.append(motion.permutation, -1)[truth] for motion in obj.symmetries]
    right = max(int((named & (labels == found.labels)).sum()) for labels in moved)
    return int(named.sum()) - right, right


def measure(
    snapshots: list[tuple[Detections, NDArray[np.int64]]],
    obj: CalibrationObject,
    decide: Callable[[int, Detections], Identity],
) -> dict[str, float]:
    """Run one decision a snapshot and count."""
    seconds, accepted, wrong, right, possible, margins = [], 0, 0, 0, 0, []
    for number, (detections, truth) in enumerate(snapshots):
        begin = time.perf_counter()
        found = decide(number, detections)
        seconds.append(time.perf_counter() - begin)
        if found.accepted:
            bad, good = wrong_labels(found, truth, obj)
            accepted, wrong, right = accepted + 1, wrong + (bad > 0), right + good
            possible += int((truth >= 0).sum())
            margins.append(found.margin)
    low, middle, high = np.percentile(np.array(seconds) * 1e3, (0, 50, 95))
    return {
        "snapshots": len(snapshots),
        "accepted_percent": 100 * accepted / len(snapshots),
        "accepted_with_a_wrong_label": wrong,
        "labelled_percent_of_visible": 100 * right / max(possible, 1),
        "smallest_margin": float(min(margins, default=0.0)),
        "ms_min": float(low),
        "ms_median": float(middle),
        "ms_p95": float(high),
    }


def main() -> None:
    """Measure all cases, print them and write them down."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--snapshots", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "identity.json")
    arguments = parser.parse_args()
    rig = load_rig(DATA / "rigs" / "O10.yaml")
    std = DRIFT.std(rig)
    results: dict[str, dict[str, float]] = {}
    for name, visible, false, where in CASES:
        obj = load_object(DATA / "objects" / f"{name}.csv")
        generator = np.random.default_rng(arguments.seed)
        truth = synthesize(rig, obj, arguments.snapshots, torch.Generator().manual_seed(arguments.seed), drift=DRIFT)
        snapshots = [blobs_of(uv, rig, visible, false, where, generator) for uv in truth.projection.uv.numpy()]
        bootstrap(snapshots[0][0], rig, obj, std)  # compile
        title = f"{name}, {visible} visible + {false} false in the {where}"
        results[f"cold start: {title}"] = measure(snapshots, obj, lambda _, d, obj=obj: bootstrap(d, rig, obj, std))  # type: ignore[misc]

        def follow(number: int, detections: Detections, obj: CalibrationObject = obj, truth=truth) -> Identity:  # type: ignore[no-untyped-def]
            pose: RigidTransform = truth.rig_from_object[number]
            return track(detections, rig, obj, std, pose)

        follow(0, snapshots[0][0])
        results[f"tracking: {title}"] = measure(snapshots, obj, follow)
        for key in (f"cold start: {title}", f"tracking: {title}"):
            print(key, json.dumps({k: round(v, 2) for k, v in results[key].items()}), flush=True)
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    content = {"machine": machine, "seed": arguments.seed, "results": results}
    arguments.out.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()

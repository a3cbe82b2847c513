"""End to end: `python scripts/benchmarks/bench_pipeline.py` times frames in memory to a rig, stage by stage.

Writes results/pipeline.json. Running state: the object moves smoothly, the pose of the last snapshot is known.
"""

import json
import os
import platform
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import imgcal
from imgcal.detection import detect_snapshot
from imgcal.identity import bootstrap, track
from imgcal.labelling import Labelled, SnapshotIdentity
from imgcal.live import Recalibrator
from imgcal.pipeline import fit_labelled
from imgcal.rotations import rotation_from_vector
from imgcal.simulation import FrameModel, Truth, simulate_frames, simulate_truth
from imgcal.synthesis import PhysicalDrift
from imgcal.transforms import RigidTransform
from renderers import ClutterModel

SNAPSHOTS, ROUNDS = 20, 4


def moving_object(rig, obj, generator):
    """One drifted rig, the object on a smooth path."""
    start = simulate_truth(rig, obj, 1, generator, PhysicalDrift())
    pose, times = start.rig_from_object[0], torch.arange(SNAPSHOTS, dtype=torch.float64)[:, None]
    turn = rotation_from_vector(times * torch.tensor([0.004, 0.006, -0.003], dtype=torch.float64))
    shift = times * torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64)
    poses = RigidTransform(turn @ pose.rotation, pose.translation + shift)
    uv = start.rig.expand(SNAPSHOTS).project(poses.apply(obj.points)).uv
    return Truth(start.rig, poses, uv)


def percentiles(seconds):
    ms = 1e3 * np.array(seconds)
    return {
        name: round(float(np.percentile(ms, q)), 3) for name, q in (("min", 0), ("p50", 50), ("p90", 90), ("p99", 99))
    }


def timed(function, times=40):
    function()
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return percentiles(seconds)


def main():
    rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
    generator = torch.Generator().manual_seed(2)
    truth = moving_object(rig, obj, generator)
    no_occlusion = replace(ClutterModel(), occluded=0.0)
    snapshots = list(simulate_frames(truth, obj, FrameModel(clutter=no_occlusion), generator))
    refused, running = 0, []
    with Recalibrator(rig, obj) as recalibrator:
        for snapshot in snapshots:  # warm-up: compiles, finds the pose
            recalibrator.update(snapshot)
        for _ in range(ROUNDS):
            for snapshot in snapshots:
                start = time.perf_counter()
                try:
                    result = recalibrator.update(snapshot)
                except imgcal.RefusedError:
                    refused += 1
                running.append(time.perf_counter() - start)

    found = imgcal.detect(snapshots[0])
    blobs = replace(found, sigma=np.hypot(found.sigma, imgcal.PipelineOptions().identity_error))
    std = rig.prior.std(rig)
    pose = truth.rig_from_object[0]
    identity = track(blobs, rig, obj, std, pose)
    table = replace(found, fiducial=identity.labels)
    labelled = Labelled(table, (SnapshotIdentity("0", "by_tracking", "", 1, identity.rig_from_object),))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        stages = {
            "detection, 10 frames 2048x1088": timed(
                lambda: detect_snapshot(snapshots[0], imgcal.DetectionOptions(), pool=pool)
            ),
            "identity, pose known": timed(lambda: track(blobs, rig, obj, std, pose)),
            "identity, cold start": timed(lambda: bootstrap(blobs, rig, obj, std)),
            "estimation with outlier and noise checks": timed(lambda: fit_labelled(labelled, rig, obj)),
        }
    report = {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}",
        "load_average": round(os.getloadavg()[0], 2),
        "running state, frames in memory to calibrated rig (ms)": percentiles(running),
        "target p50 (ms)": 15,
        "refused": refused,
        "snapshots": len(running),
        "rms_px_after": round(float(result.rms), 5),
        "stages (ms)": stages,
    }
    path = Path(__file__).parent / "results" / "pipeline.json"
    path.write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()

"""Sticks and several objects among false blobs: captures for tests."""

from dataclasses import replace

import numpy as np
import torch

from imgcal.io import read_rig
from imgcal.synthesis import PhysicalDrift, simulate_volume, true_detections
from imgcal.types import CalibrationObject

PAIR = ((-250.0, 0.0, 0.0), (250.0, 0.0, 0.0))
TRIPLE = ((-250.0, 0.0, 0.0), (-80.0, 0.0, 0.0), (250.0, 0.0, 0.0))
BODY = ((0.0, 0.0, 0.0), (120.0, 0.0, 10.0), (0.0, 170.0, 0.0), (60.0, 90.0, -80.0), (-70.0, 40.0, 50.0))


def several(parts, snapshots, seed=1, false=3):
    """Blobs in random order of objects that move in a drifted room10, each by itself: see `capture`.

    Lights are no part of the object that is given back where there is anything else.
    """
    rig, rng = read_rig("room10"), np.random.default_rng(seed)
    objects = [
        CalibrationObject(torch.tensor(points, dtype=torch.float64), torch.ones(len(points), 3), name=f"object{k}")
        for k, points in enumerate(parts)
    ]
    generator, truth, tables, first = torch.Generator().manual_seed(seed), None, [], 0
    for obj in objects:
        found = simulate_volume(
            rig if truth is None else truth.rig, obj, snapshots, generator, PhysicalDrift() if truth is None else None
        )
        truth = truth or found
        table = true_detections(found)
        tables.append(replace(table, fiducial=table.fiducial + first))
        first += obj.num_fiducials
    columns = ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")
    table = replace(tables[0], **{n: np.concatenate([getattr(t, n) for t in tables]) for n in columns})
    table = table.select(rng.random(len(table)) > 0.25)
    table.uv[:] += 0.1 * rng.standard_normal(table.uv.shape)
    camera = np.tile(np.repeat(np.arange(rig.num_cameras), false), snapshots)
    count = len(camera)
    added = {
        "uv": rng.random((count, 2)) * rig.image_size.numpy()[camera],
        "sigma": np.full(count, 0.1),
        "camera": camera,
        "snapshot": np.repeat(np.arange(snapshots), false * rig.num_cameras),
        "fiducial": np.full(count, -1),
        "radius": np.full(count, np.nan),
        "flags": np.zeros(count, dtype=table.flags.dtype),
    }
    table = replace(table, **{name: np.concatenate((getattr(table, name), value)) for name, value in added.items()})
    table = table.select(np.lexsort((rng.random(len(table)), table.camera, table.snapshot)))
    known = [obj for obj in objects if obj.num_fiducials > 1] or objects
    return rig, CalibrationObject.of_several(known), replace(table, fiducial=np.full(len(table), -1)), table.fiducial


def capture(points, snapshots, seed=1, false=3):
    """One object: a quarter of the markers hidden, false blobs in every camera; the true labels come last."""
    return several([points], snapshots, seed, false)


def one_snapshot(blobs, number):
    """Blobs of one snapshot, as a capture of its own."""
    part = blobs.select(blobs.snapshot == number)
    return replace(part, snapshot=np.zeros(len(part), dtype=np.int64), snapshot_names=("0",))

"""Captures with known truth, and what can go wrong with one camera of them."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import torch

from imgcal.formats import load_object, load_rig
from imgcal.observations import Detections
from imgcal.rig import RigPrior
from imgcal.simulation import Truth, simulate_truth, simulate_volume, true_detections
from imgcal.synthesis import PhysicalDrift

NOISE = 0.1  # px


def wand_in_a_room(snapshots, seed=0):
    """Factory rig, object, truth."""
    rig, wand = load_rig("room10"), load_object("wand4")
    return rig, wand, simulate_volume(rig, wand, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())


def object_before_a_ring(snapshots, seed=0, rig="O10"):
    """Factory rig, object, truth."""
    rig, obj = load_rig(rig), load_object("asymmetric8")
    return rig, obj, simulate_truth(rig, obj, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())


def blobs(truth, seed=0, clutter=0.3, missed=0.02, crowded=None, labelled=False):
    """What the cameras find: noise, a few false blobs a frame (many in camera `crowded[0]`), some fiducials missed."""
    draw = np.random.default_rng(seed)
    found = true_detections(truth)
    found = found.select(draw.random(len(found)) >= missed)
    found = replace(found, uv=found.uv + NOISE * draw.standard_normal(found.uv.shape))
    rate = np.full(truth.rig.cameras, clutter)
    if crowded is not None:
        rate[crowded[0]] = crowded[1]
    number = draw.poisson(np.broadcast_to(rate, (len(found.snapshot_names), len(rate)))).ravel()
    snapshot, camera = np.divmod(np.repeat(np.arange(len(number)), number), len(rate))
    size = truth.rig.image_size.numpy()
    false = replace(
        found,
        uv=draw.random((len(camera), 2)) * (size[camera] - 1),
        sigma=np.full(len(camera), 0.1),
        camera=camera,
        snapshot=snapshot,
        fiducial=np.full(len(camera), -1),
        radius=np.full(len(camera), np.nan),
        flags=np.zeros(len(camera), dtype=np.uint8),
    )
    both = joined(found, false)
    both = both.select(((both.uv >= -0.5) & (both.uv <= size[both.camera] - 0.5)).all(1))
    both = both.select(np.lexsort((draw.random(len(both)), both.snapshot)))
    return both if labelled else replace(both, fiducial=np.full(len(both), -1))


def joined(*tables: Detections) -> Detections:
    columns = [f.name for f in fields(Detections) if not f.name.endswith("_names")]
    return replace(tables[0], **{name: np.concatenate([getattr(t, name) for t in tables]) for name in columns})


def mirrored(table, rig, camera, how):
    """Flip (u, v, both) or turn the image of one camera; what leaves it is lost."""
    width, height = rig.image_size[camera].tolist()
    flips = {
        "u": lambda u, v: (width - 1 - u, v),
        "v": lambda u, v: (u, height - 1 - v),
        "both": lambda u, v: (width - 1 - u, height - 1 - v),
        "turned": lambda u, v: (height - 1 - v, u),
    }
    uv, own = table.uv.copy(), table.camera == camera
    uv[own] = np.stack(flips[how](*uv[own].T), axis=1)
    return replace(table, uv=uv).select(~own | ((uv >= -0.5) & (uv <= np.array([width, height]) - 0.5)).all(1))


def swapped(table, first, second):
    camera = table.camera
    return replace(table, camera=np.where(camera == first, second, np.where(camera == second, first, camera)))


def late(table, camera):
    """One camera is one snapshot behind."""
    count = len(table.snapshot_names)
    snapshot = np.where(table.camera == camera, (table.snapshot + 1) % count, table.snapshot)
    return replace(table, snapshot=snapshot)


def with_camera(truth, obj, camera, change):
    """The truth with one camera changed: `change` maps a rig to another."""
    rig = replace(change(truth.rig), camera_names=truth.rig.camera_names)
    seen = rig.expand(len(truth.uv)).project(truth.rig_from_object.apply(obj.points), obj.radius)
    uv, visible = truth.uv.clone(), torch.ones_like(seen.visible) if truth.visible is None else truth.visible.clone()
    uv[:, camera], visible[:, camera] = seen.uv[:, camera], seen.visible[:, camera]
    return Truth(rig, truth.rig_from_object, uv, visible)


def longer_lens(rig, camera, factor=2.0):
    focal = rig.focal_length.clone()
    focal[camera] *= factor
    return replace(rig, focal_length=focal)


def turned(rig, camera, degrees, axis=0):
    """The rig with one camera turned about one of its axes."""
    step = torch.zeros_like(RigPrior().std(rig))
    step[camera, axis] = np.radians(degrees)
    return rig.moved(step)


def shifted(rig, camera, millimetres, axis=0):
    """The rig with one camera moved along an axis of the rig."""
    step = torch.zeros_like(RigPrior().std(rig))
    step[camera, 3 + axis] = millimetres
    return rig.moved(step)


def changed_from(truth, obj, camera, first, change):
    """The truth with one camera changed from a snapshot on; the rig is that before."""
    after = with_camera(truth, obj, camera, change)
    later = torch.arange(len(truth.uv)) >= first
    uv = torch.where(later[:, None, None, None], after.uv, truth.uv)
    before = torch.ones_like(after.visible) if truth.visible is None else truth.visible
    return Truth(truth.rig, truth.rig_from_object, uv, torch.where(later[:, None, None], after.visible, before))


def with_lens_errors(truth, seed=0, size=0.15):
    """The truth seen through lenses that the camera model does not know: smooth errors over each image, px."""
    draw, where = np.random.default_rng(seed), truth.uv / truth.rig.image_size.double()[:, None]
    shape = (truth.uv.shape[1], 1, 2)
    slope, phase = (torch.from_numpy(draw.uniform(low, high, shape)) for low, high in ((2, 5), (0, 6)))
    return replace(truth, uv=truth.uv + size * (slope * where.flip(-1) + phase).sin())


def from_one_end_to_the_other(truth):
    """The same snapshots with the object carried along one axis: place and time go together."""
    order = truth.rig_from_object.translation[:, 0].argsort()
    visible = None if truth.visible is None else truth.visible[order]
    return replace(truth, uv=truth.uv[order], visible=visible, rig_from_object=truth.rig_from_object[order])

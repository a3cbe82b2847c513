"""Compile every function that the first calibration needs, ahead of time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from imgcal.association import align_camera, associate_lights
from imgcal.detection import detect
from imgcal.errors import RefusedError
from imgcal.geometry import lens_width
from imgcal.io import load_object, read_rig
from imgcal.monitoring import RecentSnapshots, RigFilter
from imgcal.online.keeper import RigKeeper
from imgcal.pipeline import calibrate, score
from imgcal.synthesis import (
    FrameModel,
    ImageOptions,
    PoseRange,
    RelativeDrift,
    Truth,
    render_views,
    simulate_frames,
    simulate_truth,
    true_detections,
)
from imgcal.types import CalibrationObject, CameraRig, Observations, RigPrior
from renderers import SensorModel, palette

RIG, OBJECT, SIZE = "T4", "asymmetric8", (512, 272)
SNAPSHOTS = 3
DRIFT = RelativeDrift(0.01, 0.01)
POSES = PoseRange(phi_deg=(0.0, 28.6), alpha_deg=(0.0, 0.0))
A_SECOND = 66  # snapshots: more than a filter keeps
RATIONAL = "rational"
MANY = 12  # enough for the test of moves, for blocks, and for the estimates of long captures


def warm_up(all_lenses: bool = False) -> None:
    """Recalibrate a small simulated rig in every way there is, so that all compiled functions are in the cache.

    Takes seconds if the cache is complete. The compiled functions serve rigs, objects and frames of any size.

    Args:
        all_lenses: also compile what rigs need with a camera of any lens but the usual one.
    """
    usual = read_rig(RIG).resized(torch.tensor(SIZE))
    # The others first: a process beside this one may be compiling for the usual one.
    for rig in (replace_lenses(usual), usual) if all_lenses else (usual,):
        _warm_up(rig)


def replace_lenses(rig: CameraRig) -> CameraRig:
    """The same cameras with the widest of the other lenses: functions compiled for one of them serve all."""
    wide = lens_width(RATIONAL) - rig.distortion.shape[-1]
    return replace(rig, distortion=torch.nn.functional.pad(rig.distortion, (0, wide)), lens_model=RATIONAL)


def _warm_up(rig: CameraRig) -> None:
    obj, generator = load_object(OBJECT), _make_generator()
    truth = simulate_truth(rig, obj, SNAPSHOTS, generator, DRIFT, POSES)
    for depth in (8, 16):
        _compile_detection(truth, rig, obj, SensorModel(bit_depth=depth), generator)
    exact = true_detections(truth)
    with _ignore_refusals():
        calibrate(exact, rig, obj)
        score(exact, rig, obj)
    with _ignore_refusals():
        calibrate(true_detections(simulate_truth(rig, obj, MANY, generator, DRIFT, POSES)), rig, obj)
    _compile_planar(rig, generator)
    _compile_bloom()
    _compile_unknown_markers(rig, generator)
    _compile_folding(truth, rig, obj)
    seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
    for uv in (truth.uv, truth.uv.float()):  # for `imgcal render` and for the networks
        render_views(uv, seen, rig.image_size, obj, ImageOptions(32, 1.5))
        rig.to(uv.dtype).project_values(obj.points.to(uv.dtype))


def _make_generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _compile_detection(
    truth: Truth, rig: CameraRig, obj: CalibrationObject, sensor: SensorModel, generator: torch.Generator
) -> None:
    """Compile the detection, separation and tracking of blobs."""
    shots = list(simulate_frames(truth, obj, FrameModel(sensor), generator))
    stacks = {name: [shot[name] for shot in shots] for name in rig.camera_names}
    for detector in ("classical", "matched"):
        with _ignore_refusals():
            calibrate(stacks, rig, obj, detector=detector)
    with RigKeeper(rig, obj) as keeper:
        for number, shot in enumerate((shots[0], *shots)):
            with _ignore_refusals():
                keeper.update(shot, float(number))


def _compile_planar(rig: CameraRig, generator: torch.Generator) -> None:
    """Compile the identification of a flat object."""
    points = torch.tensor([(x, y, 0.0) for x in (0, 40, 90) for y in (0, 30, 75)], dtype=torch.float64)
    plane = CalibrationObject(points, palette(len(points)).double())
    truth = simulate_truth(rig, plane, 2, generator, None)
    unlabelled = true_detections(truth)
    with _ignore_refusals():
        calibrate(unlabelled, rig, plane)


def _compile_folding(truth: Truth, rig: CameraRig, obj: CalibrationObject) -> None:
    """Compile the step that folds snapshots older than a second into the earlier belief."""
    seen = torch.ones(1, *truth.uv.shape[1:-1], dtype=torch.bool)
    there = Observations(truth.uv[:1], torch.full(seen.shape, 0.1, dtype=torch.float64), seen)
    follows = RigFilter(rig, obj)
    recent = RecentSnapshots(follows.belief, follows.walk)
    with _ignore_refusals():
        for _ in range(A_SECOND):
            recent.append(follows.follow(there, truth.rig_from_object[:1]), there, 0.0)


def _compile_unknown_markers(rig: CameraRig, generator: torch.Generator) -> None:
    """Compile the search for markers of unknown arrangement, by rays, in a capture and in a running rig."""
    markers = load_object("lights")
    labelled = true_detections(simulate_truth(rig, load_object(OBJECT), MANY, generator, DRIFT, POSES))
    seen = replace(labelled, fiducial=np.full(len(labelled), -1))
    with _ignore_refusals():
        calibrate(seen, rig, markers)
    with _ignore_refusals():
        score(seen, rig, markers)
    found = associate_lights(seen, rig, np.ones(rig.num_cameras))
    align_camera(seen, rig, RigPrior().std(rig), rig, 0, found)  # a capture in which one camera sees few of them
    with RigKeeper(rig, markers) as keeper:
        for number in range(MANY):
            with _ignore_refusals():
                keeper.update(seen.of_snapshots(number, number + 1), number / 60)


def _compile_bloom() -> None:
    """Compile the separation of saturated blobs that have merged."""
    v, u = np.mgrid[:64, :96]
    light = sum(400 * np.exp(-((u - at) ** 2 + (v - 32) ** 2) / 72) for at in (38, 58))
    detect({"lamps": (5 + np.minimum(light, 250)).astype(np.uint8)})


@contextlib.contextmanager
def _ignore_refusals() -> Iterator[None]:
    """Ignore refusals and warnings about such a small rig."""
    with contextlib.suppress(RefusedError):
        yield

"""Detectors on simulated captures whose truth is known: calibrated, refused, or wrong.

Every detector gets the same frames, the whole pipeline behind it, and no knowledge of the truth.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
import torch

from imgcal.association import PipelineOptions
from imgcal.detection import DetectionOptions, Frame
from imgcal.errors import RefusedError
from imgcal.estimation import predicted_error
from imgcal.evaluation.true_error import true_error
from imgcal.pipeline import Calibration, calibrate
from imgcal.synthesis import Drift, FrameModel, PhysicalDrift, PoseRange, Truth, simulate_frames, simulate_truth
from imgcal.types import CalibrationObject, CameraRig

WRONG_RATIO = 5.0
"""Times the error that a calibration claims."""
WRONG_PX = 1.0
"""Pixels. What is wrong is both: more than this, and more than `WRONG_RATIO` times what it claims."""
RIGHT_LABEL_PX = 5.0
"""Distance within which a labelled centre must lie of the true image of its fiducial."""
JUDGED = 100
"""Points of the working volume at which a calibration is compared with the truth."""

Status = Literal["calibrated", "refused", "wrong"]


@dataclass(frozen=True)
class Scene:
    """What captures are drawn from; the seed of a capture determines the rest."""

    rig: CameraRig  # factory, float64, without batch axes
    obj: CalibrationObject
    models: Mapping[str, FrameModel]  # by the name of the difficulty
    snapshots: int = 4
    drift: Drift = PhysicalDrift()
    pose_range: PoseRange = PoseRange()


@dataclass(frozen=True)
class Contender:
    """A detector with its settings: one for all difficulties, or tuned to each."""

    name: str  # of its line in tables; training seeds of one experiment share it
    detector: Any = "classical"  # what `imgcal.calibrate` takes
    seed: int | None = None  # of its training; None = nothing is trained
    detection: Mapping[str, DetectionOptions] = field(default_factory=dict)  # by difficulty; others: the default
    pipeline: PipelineOptions = PipelineOptions()
    only: tuple[str, ...] = ()  # difficulties in which it takes part; empty = all


@dataclass(frozen=True)
class Outcome:
    """What one detector made of one capture."""

    contender: str
    training_seed: int | None
    difficulty: str
    capture: int  # seed of the capture
    status: Status
    reason: str  # why it was refused
    seconds: float  # of the whole calibration
    frames: int
    held_out_px: float | None = None  # RMS over cameras and points of the working volume, against the truth
    worst_px: float | None = None  # exceeded at 5 % of them
    claimed_px: float | None = None  # the same as the calibration itself predicts it
    labels: int = 0  # blobs with a label, of snapshots that count
    right_labels: int = 0
    visible: int = 0  # fiducials that cameras see


def compare_detectors(
    contenders: Sequence[Contender],
    scene: Scene,
    count: int,
    seed: int = 0,
    progress: Callable[[int], None] = lambda captures: None,
    mapped: Callable[..., Iterable[list[dict[str, Any]]]] = map,
) -> tuple[Outcome, ...]:
    """Calibrate simulated captures with every detector.

    Args:
        contenders: who takes part.
        scene: what captures are drawn from; all its difficulties are tried.
        count: captures a difficulty.
        seed: the same seed gives the same captures, whichever detectors take part.
        progress: called with the number of captures that have been done.
        mapped: called like `map`; gives results in the order of captures. They do not depend on who measures
            (`imgcal.fleet.workers`).
    """
    cases = [(difficulty, seed * 100_000 + number) for difficulty in scene.models for number in range(count)]
    found: list[Outcome] = []
    for outcomes in mapped(partial(_capture_values, tuple(contenders), scene), cases):
        found += [Outcome(**one) for one in outcomes]
        progress(1)
    return tuple(found)


def judge(result: Calibration, truth: CameraRig, seed: int = 0) -> tuple[bool, float, float, float]:
    """Compare a calibration with the true rig at random points of its working volume.

    Both rigs are aligned by the rigid motion that makes their difference smallest, as for
    `predicted_error`. A calibration is wrong where the error that 5 % of the points exceed is larger than `WRONG_PX`
    and than `WRONG_RATIO` times the one that it claims.

    Returns:
        Whether it is wrong; the RMS error (px), the error that 5 % exceed, and what the calibration claims of that one.
    """
    claimed = predicted_error(result.estimate)
    generator = torch.Generator().manual_seed(seed)
    shares = torch.rand(JUDGED, 3, generator=generator, dtype=torch.float64)
    points = torch.lerp(claimed.volume.low, claimed.volume.high, shares)
    pixels, _ = true_error(claimed.uncertainty, truth, points)
    there = pixels[pixels.isfinite()]
    rms, worst = float(there.square().mean().sqrt()), float(there.quantile(0.95))
    return worst > max(WRONG_PX, WRONG_RATIO * claimed.p95_px), rms, worst, claimed.p95_px


def draw_capture(scene: Scene, difficulty: str, seed: int) -> tuple[Truth, dict[str, list[Frame]]]:
    """Draw a rig and S poses, and the frames by camera name: S of (H, W) each."""
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_truth(scene.rig, scene.obj, scene.snapshots, generator, scene.drift, scene.pose_range)
    snapshots = list(simulate_frames(truth, scene.obj, scene.models[difficulty], generator))
    return truth, {name: [frames[name] for frames in snapshots] for name in scene.rig.camera_names}


def _capture_values(contenders: Sequence[Contender], scene: Scene, case: tuple[str, int]) -> list[dict[str, Any]]:
    """Plain values of outcomes, which can be kept in a file."""
    difficulty, seed = case
    truth, frames = draw_capture(scene, difficulty, seed)
    ours = [contender for contender in contenders if not contender.only or difficulty in contender.only]
    return [asdict(_contender_values(contender, scene, truth, frames, case)) for contender in ours]


def _contender_values(
    contender: Contender, scene: Scene, truth: Truth, frames: dict[str, list[Frame]], case: tuple[str, int]
) -> Outcome:
    difficulty, seed = case
    detection = contender.detection.get(difficulty, DetectionOptions())
    said = partial(
        Outcome,
        contender.name,
        contender.seed,
        difficulty,
        seed,
        frames=len(truth.uv) * scene.rig.num_cameras,
        visible=truth.uv[..., 0].numel() if truth.visible is None else int(truth.visible.sum()),
    )
    started = time.perf_counter()
    try:
        result = calibrate(
            frames, scene.rig, scene.obj, contender.pipeline, detection=detection, detector=contender.detector
        )
    except RefusedError as error:
        return said(status="refused", reason=str(error), seconds=time.perf_counter() - started)
    seconds = time.perf_counter() - started
    wrong, rms, worst, claimed = judge(result, truth.rig, seed)
    labels, right = _labels(result, truth)
    return said(
        status="wrong" if wrong else "calibrated",
        reason="",
        seconds=seconds,
        held_out_px=rms,
        worst_px=worst,
        claimed_px=claimed,
        labels=labels,
        right_labels=right,
    )


def _labels(result: Calibration, truth: Truth) -> tuple[int, int]:
    """Count labels that the calibration rests on, and the right ones among them."""
    observations = result.observations
    seen = observations.seen.numpy()  # (S, C, N), of the snapshots that are used
    numbers = [int(name) for name in np.asarray(result.labelled.detections.snapshot_names)[list(result.labelled.used)]]
    off = (observations.uv - truth.uv[numbers].to(observations.uv)).norm(dim=-1).numpy()
    return int(seen.sum()), int((seen & (off < RIGHT_LABEL_PX)).sum())

"""States of a known rig for tests of the watching code, and their tests after a restart."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import TypeVar

import numpy as np
import torch

import imgcal
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.monitoring import RigBelief
from imgcal.online import RigState, SequentialTest
from imgcal.online.state_document import StateReader, StateWriter
from imgcal.types import Detections

NOISE = 0.1
RIG, OBJECT = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
BELIEF = RigBelief.of_prior(RIG, OBJECT)
Test = TypeVar("Test", bound=SequentialTest)


def restart(test: Test, fresh: Test) -> Test:
    """Give a new test the state of another, as a keeper does."""
    writer = StateWriter()
    plain = json.loads(json.dumps(writer.write(type(test), test), allow_nan=False))
    restored: Test = StateReader(writer.tables()).read_object(type(test), plain, "test", fresh)
    return restored


def expose_together(camera: int) -> float:
    return 0.0


@cache  # many tests look at the same states
def state_at(
    number: int, seconds: float, late: Callable[[int], float] = expose_together, bump: float = 0.0
) -> RigState:
    """What a rig of four cameras sees of an object that is waved about.

    Args:
        number: of the snapshot.
        seconds: its time.
        late: seconds by which each camera exposes later.
        bump: pixels by which the image of camera 1 is shifted.
    """
    noise = np.random.default_rng(number)

    def pose_at(t: float) -> RigidTransform:
        turn = rotation_from_vector(
            torch.tensor([0.3 * np.sin(2.1 * t), 0.2 * np.sin(2.9 * t), 0.1], dtype=torch.float64)
        )
        away = torch.tensor([60 * np.sin(3.0 * t), 50 * np.cos(2.3 * t), 40 * np.sin(1.7 * t)], dtype=torch.float64)
        return RigidTransform(turn, away + torch.tensor([0.0, 0.0, RIG.working_distance or 1000.0]))

    def seen(t: float) -> np.ndarray:
        return RIG.expand(1).project_values(pose_at(t).apply(OBJECT.points)[None], None).uv[0].numpy()

    there = np.stack([seen(seconds + late(camera))[camera] for camera in range(4)])
    there = there + NOISE * noise.standard_normal(there.shape)
    there[1, :, 0] += bump
    camera, fiducial = np.divmod(np.arange(32), 8)
    blobs = Detections(
        there.reshape(-1, 2), np.full(32, NOISE), camera, np.zeros(32, dtype=np.int64), fiducial, np.full(32, 5.0),
        np.zeros(32, dtype=np.uint8), RIG.camera_names, (str(number),),
    )  # fmt: skip
    depth = RIG.expand(1).project_values(pose_at(seconds).apply(OBJECT.points)[None], None).depth[0].numpy()
    radius = 6.0 * 1500.0 / depth.reshape(-1) * np.exp(0.02 * noise.standard_normal(32))
    blobs = Detections(**{**vars(blobs), "radius": radius})
    return RigState(
        time=seconds, snapshot=number, belief=BELIEF, factory=RIG, cameras={}, sentence="",
        refused=None, detections=blobs, lag=np.zeros((32, 2)), predicted=seen(seconds), residual=np.zeros(4),
        rig_from_object=pose_at(seconds),
        events=(), clock_offset=np.full(4, np.nan), clock_offset_sigma=np.full(4, np.nan),
        noise=np.zeros(4), shake=np.zeros(4), persistent=np.zeros(4),
    )  # fmt: skip

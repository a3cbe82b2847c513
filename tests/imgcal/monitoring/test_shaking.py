"""Shaking cameras: the model, and the estimated amplitude."""

import math
from dataclasses import replace

import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.monitoring import RigBelief, absorb
from imgcal.monitoring.case import Case, Snapshot
from imgcal.monitoring.explanations import Steady, weigh
from imgcal.monitoring.measurement_update import stack_snapshots
from imgcal.monitoring.shaking import SHAKE_SNAPSHOTS, ShakeLevel, Shaking
from imgcal.types import Observations
from tests.imgcal.monitoring.followed import followed

BEFORE, COUNT = 40, 6


def shifted(observations: Observations, cameras: list[int], size: float, seed: int) -> Observations:
    shift = torch.zeros(1, observations.seen.shape[1], 1, 2, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    shift[:, cameras] = size * torch.randn(1, len(cameras), 1, 2, generator=generator, dtype=torch.float64)
    return replace(observations, uv=observations.uv + shift)


def case_of(before: RigBelief, snapshots: list[Snapshot]) -> Case:
    """Camera 2 is suspected."""
    return Case(before, snapshots, [1 / 60] * len(snapshots), len(snapshots), cameras=(2,))


@pytest.mark.parametrize("cameras", [[0, 1, 2, 3], [2]])
def test_it_is_found_which_cameras_shake_and_that_it_is_more_probable_than_that_nothing_does(cameras) -> None:
    made = followed(BEFORE + COUNT)
    snapshots = [(shifted(one, cameras, 0.5, s), pose) for s, (one, pose) in enumerate(made.snapshots[BEFORE:])]
    verdict = weigh(case_of(made.beliefs[BEFORE], snapshots), (Steady(), Shaking()))
    found, shake = verdict.best, verdict.best.finding.shake
    assert found.name == "shaking" and verdict.lead > 50
    assert (shake > 0).nonzero()[:, 0].tolist() == cameras
    still = absorb(made.beliefs[BEFORE], *stack_snapshots(snapshots))
    assert found.evidence > still.evidence + 50
    assert all(torch.equal(one.shake[0], shake) for one, _ in found.snapshots)
    quiet = weigh(case_of(made.beliefs[BEFORE], made.snapshots[BEFORE:]), (Steady(), Shaking()))
    assert list(quiet.explained) == ["steady", "shaking"] and not quiet.reasons


def test_shifts_that_follow_each_other_smoothly_are_no_shaking() -> None:
    """A clock that is off makes such ones, of an object that moves."""
    made, snapshots = followed(BEFORE + COUNT), []
    for s, (one, pose) in enumerate(made.snapshots[BEFORE:]):
        uv = one.uv.clone()
        uv[:, 2, :, 0] += 0.5 * (s - 2.5)
        snapshots.append((replace(one, uv=uv), pose))
    with pytest.raises(RefusedError, match="shaking: the shifts are smooth"):
        weigh(case_of(made.beliefs[BEFORE], snapshots), (Shaking(),))


def test_how_much_each_camera_shakes_is_followed() -> None:
    made, level = followed(1), ShakeLevel(4)
    observations = made.snapshots[0][0]
    generator = torch.Generator().manual_seed(1)
    size = torch.tensor([0.4, 0.0, 0.2, 0.4], dtype=torch.float64)

    def take(times: int, size: torch.Tensor) -> None:
        for _ in range(times):
            noise = observations.sigma[..., None] * torch.randn(1, 4, 8, 2, generator=generator, dtype=torch.float64)
            shift = size[:, None, None] * torch.randn(4, 1, 2, generator=generator, dtype=torch.float64)
            level.observe(observations, math.sqrt(1 - 1.5 / 4) * (noise + shift))

    take(SHAKE_SNAPSHOTS - 1, size)
    assert not level.shake.any() and level.apply_to(observations) is observations
    take(1, size)
    assert level.shake.tolist() == pytest.approx(size.tolist(), rel=0.35)
    assert torch.equal(level.apply_to(observations).shake, level.shake[None])
    take(SHAKE_SNAPSHOTS, torch.zeros(4))
    assert not level.shake.any()
    level.believe(size)
    level.observe(replace(observations, seen=torch.zeros_like(observations.seen)), torch.zeros(1, 4, 8, 2))
    assert torch.equal(level.shake, size)

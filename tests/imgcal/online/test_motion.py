"""How far a camera has moved, against the move that was made."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.online.motion import measured_move
from imgcal.pipeline import calibrate
from tests.imgcal.streams import Stream

CAMERA = 6
WELL = 1e12 * np.eye(6)
WIDE = torch.tensor([0.05] * 3 + [50.0] * 3, dtype=torch.float64)


def moved(turn_deg, shift_mm, seed=0, snapshots=3):
    """The move that is found after some labelled snapshots of a rig with one camera moved, and the true rig."""
    stream = Stream("O10", "asymmetric8", snapshots, seed)
    bumped = stream.bumped([CAMERA], turn_deg, shift_mm)
    tables = [stream.blobs(s, bumped) for s in range(snapshots)]
    names = ("uv", "sigma", "camera", "radius", "flags")
    columns = {name: np.concatenate([getattr(table, name) for table, _ in tables]) for name in names}
    table = replace(
        tables[0][0],
        **columns,
        fiducial=np.concatenate([truth for _, truth in tables]),
        snapshot=np.repeat(np.arange(snapshots), [len(table) for table, _ in tables]),
        snapshot_names=tuple(map(str, range(snapshots))),
    )
    after = calibrate(table, replace(stream.true, prior=stream.rig.prior), stream.obj)
    return measured_move(stream.true, WELL, after, CAMERA, "0", WIDE)


@pytest.mark.parametrize("seed", range(3))
def test_a_turn_is_measured_as_exactly_as_it_says(seed) -> None:
    move, statistic = moved(0.5, 0.0, seed)
    assert (move.camera, move.snapshot, move.kind) == ("cam07", "0", "rotation")
    assert abs(move.size - 0.5) < 4 * move.sigma and move.sigma < 0.02
    assert statistic > 1000


@pytest.mark.parametrize("seed", range(2))
def test_a_shift_is_measured_as_exactly_as_it_says(seed) -> None:
    move, statistic = moved(0.0, 15.0, seed)
    assert abs(move.size - 15.0) < 4 * move.sigma or move.kind == "rotation"  # along the view they are told apart
    assert statistic > 1000


def test_standing_still_is_no_move() -> None:
    statistics = [moved(0.0, 0.0, seed)[1] for seed in range(4)]
    assert np.mean(statistics) < 12 and max(statistics) < 40  # six degrees of freedom

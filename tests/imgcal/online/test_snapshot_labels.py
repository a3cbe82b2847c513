"""Snapshots are labelled by the last pose, else from scratch; misfits are refused, until the rig is given up."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.online import RigKeeper
from imgcal.online.snapshot_labels import MOST_VAIN
from imgcal.online.snapshot_update import learn_snapshot
from imgcal.synthesis import simulate_board, true_detections
from imgcal.types import Board, CalibrationObject
from scripts.benchmarks.rig_streams import Conditions
from tests.imgcal.online.memories import Remembered


def test_a_snapshot_is_labelled_by_the_last_pose_and_else_by_itself() -> None:
    made = Remembered()
    made.learn(5)
    blobs = made.blobs()
    followed = made.labelled(blobs)
    assert made.labelling.follows  # a snapshot that is labelled by itself ends that
    made.labelling.follows = False
    decided = made.labelled(blobs)
    assert not made.labelling.follows
    np.testing.assert_array_equal(followed.checked.blobs.fiducial, decided.checked.blobs.fiducial)


def test_an_object_that_is_not_where_the_last_pose_predicts_is_found_again() -> None:
    made = Remembered(conditions=Conditions(clutter=0.0, hidden=0.0))
    made.learn(5)
    made.memory.count += 120
    blobs = made.blobs()  # two seconds later
    found = made.labelled(blobs)
    assert not made.labelling.follows and found.checked.labels == len(blobs)


def test_labels_are_the_true_ones() -> None:
    made = Remembered()
    made.learn(4)
    given = replace(made.stream.conditions, labelled=True)
    twin = Remembered(conditions=given)
    for _ in range(4):
        twin.blobs()
    found, true = made.labelled(made.blobs()).checked.blobs, twin.blobs()
    np.testing.assert_array_equal(found.uv, true.uv)
    named = found.fiducial >= 0
    assert named.sum() >= 20
    np.testing.assert_array_equal(found.fiducial[named], true.fiducial[named])


def test_labels_that_fit_nowhere_are_refused_until_the_rig_is_given_up() -> None:
    made = Remembered(conditions=Conditions(labelled=True, clutter=0.0, hidden=0.0))
    memory = made.learn(10)
    wrong = replace(made.blobs())
    wrong.fiducial[:] = np.roll(np.arange(8), 3)[wrong.fiducial]
    memory.in_vain = MOST_VAIN - 2
    with pytest.raises(RefusedError, match="off in most cameras"):
        made.labelled(wrong)
    assert memory.monitor.filter.count == 10 and not memory.pending
    with pytest.raises(RefusedError, match="off in most cameras"):
        made.labelled(wrong)
    assert memory.monitor.filter.count == 0
    assert [event.kind for event in memory.pending] == ["restart"]


@pytest.mark.parametrize("of_each", ["snapshot", "camera"])
def test_labels_that_are_wrong_are_no_move_of_all_cameras(of_each: str) -> None:
    made = Remembered(conditions=Conditions(labelled=True, clutter=0.0, hidden=0.0))
    memory = made.learn(10)
    for number in range(8):
        wrong = replace(made.blobs())
        by = wrong.camera + 1 if of_each == "camera" else number % 7 + 1
        wrong.fiducial[:] = (wrong.fiducial + by) % 8
        with pytest.raises(RefusedError, match="off in most cameras"):
            made.labelled(wrong)
    doubted = memory.doubts.refused
    snapshots = [(memory.observed(one.blobs), one.rig_from_object) for one in doubted]
    assert memory.doubts.due and not memory.monitor.have_all_moved(snapshots, [one.seconds for one in doubted])


@pytest.mark.parametrize("board", [Board("circles", 7, 6, 20.0), Board("circles", 7, 7, 20.0, bend=(1.0, -0.5))])
def test_images_that_do_not_say_the_turn_of_a_board_are_learnt_from(board: Board) -> None:
    rig, obj, random = imgcal.load_rig("T4"), CalibrationObject.of_board(board), np.random.default_rng(0)
    seen = true_detections(simulate_board(rig, obj, 5, torch.Generator().manual_seed(5), None))
    seen = replace(seen, uv=seen.uv + 0.1 * random.standard_normal(seen.uv.shape), sigma=np.full(len(seen), 0.1))
    place = np.stack([place for _, place in board.turns])
    turn = random.integers(len(place), size=(5, rig.num_cameras))
    turned = replace(seen, fiducial=place[turn[seen.snapshot, seen.camera], seen.fiducial])
    keeper = RigKeeper(rig, obj)
    for s in range(5):
        assert keeper.update(turned.of_snapshots(s, s + 1), time=float(s)).refused is None
    assert keeper.noise < 0.05
    assert float((keeper.belief.rig.positions - rig.positions).norm(dim=-1).max()) < 0.5


@pytest.mark.parametrize("first", [[0], [0, 1]])
def test_cameras_that_see_the_object_for_the_first_time_may_be_as_far_off_as_the_factory_says(first: list[int]) -> None:
    made = Remembered(conditions=Conditions(labelled=True, clutter=0.0, hidden=0.0))
    usual = []
    for _ in range(12):
        blobs = made.blobs()
        some = made.labelled(blobs.select(np.flatnonzero(np.isin(blobs.camera, first))))
        learn_snapshot(made.memory, some.checked)
    for _ in range(4):
        every = made.labelled(made.blobs())
        usual.append(every.checked.usual)
        learn_snapshot(made.memory, every.checked)
    assert usual[0] > made.memory.most_usual > usual[-1]
    wrong = replace(made.blobs())
    wrong.fiducial[:] = np.roll(np.arange(8), 3)[wrong.fiducial]
    with pytest.raises(RefusedError, match="off in most cameras"):
        made.labelled(wrong)

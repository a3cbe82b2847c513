"""A labelled snapshot is learned; labels that are off wait for a second one, and then are a move."""

import math

from imgcal.online.snapshot_update import LEAST_LOOKS, learn_snapshot
from scripts.benchmarks.rig_streams import Bump
from tests.imgcal.online.memories import Remembered


def test_what_was_learnt_is_noted() -> None:
    made = Remembered()
    memory = made.learn(6)
    assert memory.monitor.filter.count == 6 and memory.learnt == memory.time
    assert list(memory.looks) == [6] * 4
    assert len(memory.times) == len(memory.poses) == len(memory.usual) == 6
    assert not memory.off and memory.in_vain == 0


def test_a_camera_that_sees_the_object_elsewhere_waits_for_the_next_snapshot_and_has_moved_then() -> None:
    made = Remembered(bumps=[Bump(20, 2, "rotation", math.radians(2.0))])
    memory = made.learn(20)
    assert memory.looks[2] >= LEAST_LOOKS
    labelled = made.labelled(made.blobs())
    assert labelled.checked.off[2]
    found = learn_snapshot(memory, labelled.checked)
    assert not found.changes and list(memory.off) == [2]
    assert not found.update.residual[0, 2].any()  # nothing was learnt of it
    known = memory.before
    found = learn_snapshot(memory, made.labelled(made.blobs()).checked)
    assert not found.changes and memory.monitor.quarantine.cameras == {2}  # one snapshot more rules out the clock
    found = learn_snapshot(memory, made.labelled(made.blobs()).checked)
    assert [change.camera for change in found.changes] == [2]
    assert memory.looks[2] == 0 and memory.before is known

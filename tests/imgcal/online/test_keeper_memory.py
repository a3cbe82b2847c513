"""The memory of a keeper: start, forgetting, and transfer of values."""

import json

import numpy as np
import pytest
import torch

import imgcal
from imgcal.online.keeper_memory import USUAL_SNAPSHOTS, KeeperMemory
from imgcal.online.state_document import StateReader, StateWriter
from tests.imgcal.online.memories import OPTIONS, Remembered


def test_nothing_is_known_at_the_beginning_but_what_the_factory_says() -> None:
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    memory = KeeperMemory.from_factory(rig, obj, None, OPTIONS)
    assert memory.surroundings is None and memory.most_usual == np.inf
    assert memory.obj_now is obj
    assert np.isnan(memory.predicted(None)).all() and memory.predicted(None).shape == (4, 8, 2)


def test_what_has_been_learnt_is_forgotten_but_for_the_factory() -> None:
    made = Remembered()
    memory = made.learn(USUAL_SNAPSHOTS)
    assert memory.most_usual < 2.0
    known = memory.surroundings
    prior = (memory.prior.prior or imgcal.types.RigPrior()).std(memory.prior)
    assert known is not None and bool((known.std[:, 6] < prior[:, 6]).all())
    factory = memory.factory
    memory.reset()
    assert memory.factory is factory and memory.surroundings is None and memory.most_usual == np.inf
    assert not memory.looks.any() and not memory.times
    assert [event.kind for event in memory.pending] == ["restart"]


def test_moments_are_those_of_the_snapshots_or_since_when_it_was_in_doubt() -> None:
    memory = Remembered().learn(3)
    assert memory.change_time(1) == memory.change_time(1, 2) == pytest.approx(1 / 60)
    assert memory.change_time(99) == memory.time
    memory.off[2] = 0.001
    assert memory.change_time(1, 2) == 0.001


def test_a_state_is_resumed_and_parts_of_another_rig_are_refused() -> None:
    memory, writer = Remembered().learn(2), StateWriter()
    plain = writer.write(KeeperMemory, memory)
    other = writer.write(KeeperMemory, KeeperMemory.from_factory(imgcal.load_rig("U7"), memory.obj, None, OPTIONS))
    plain, other, tables = json.loads(json.dumps([plain, other, writer.tables()]))
    again = KeeperMemory.restored(StateReader(tables), plain, OPTIONS)
    assert torch.equal(again.belief.factor, memory.belief.factor) and again.count == 2
    assert again.monitor.filter.options is OPTIONS.estimation
    for change in ("looks", "monitor", "before", "usual", "more"):
        changed = {**plain, change: [] if change in ("usual", "more") else other[change]}
        with pytest.raises(ValueError, match="found"):
            KeeperMemory.restored(StateReader(tables), changed, OPTIONS)

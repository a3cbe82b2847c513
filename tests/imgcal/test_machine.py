import gc
import os

import pytest

from imgcal import machine
from imgcal.machine import usable_cores, without_garbage_collection


def test_a_system_that_does_not_say_lets_all_cores_be_used(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5}, raising=False)
    assert usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert usable_cores() == 7
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_cores() == 1


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_is_collected_again_after_a_pause(enabled):
    before = gc.isenabled()
    gc.unfreeze()
    machine._exempt_once.cache_clear()
    (gc.enable if enabled else gc.disable)()
    try:
        with pytest.raises(ImportError), without_garbage_collection():
            assert not gc.isenabled()
            raise ImportError
        frozen = gc.get_freeze_count()
        assert gc.isenabled() == enabled and frozen > 0
        garbage = [[]]
        garbage[0].append(garbage)
        with without_garbage_collection():
            pass
        assert gc.get_freeze_count() <= frozen  # what has come since can still be collected
    finally:
        gc.freeze()  # as the suite has it: conftest.py
        (gc.enable if before else gc.disable)()

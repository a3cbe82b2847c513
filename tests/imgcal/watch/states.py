"""States of a running rig, without one."""

import json
from dataclasses import replace

import numpy as np
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, read_rig, write_text
from imgcal.online import Event, RigKeeper
from imgcal.synthesis import simulate_truth, true_detections

RIG, OBJECT = read_rig("T4"), load_object("asymmetric8")


def some_state(events=(), time=1.0):
    """What is known after one snapshot."""
    blobs = true_detections(simulate_truth(RIG, OBJECT, 1, torch.Generator().manual_seed(0), None))
    with RigKeeper(RIG, OBJECT) as keeper:
        return replace(keeper.update(blobs, time), events=tuple(events))


class Saved:
    def __init__(self, number, progress, fails):
        self.number, self.progress, self.fails = number, progress, fails

    def write(self, path):
        if self.fails:
            raise OSError("no space left")
        write_text(path, json.dumps({"number": self.number, "progress": self.progress}))


class KeeperOfStates:
    """Gives one state again and again, with the events that it is told to give."""

    def __init__(self, fails=()):
        self.factory, self.obj = RIG, OBJECT
        self.sources, self.saves, self.fails, self.disk_full = [], [], set(fails), False
        self.events = {}  # number of the update -> events
        self._state = replace(some_state(), clock_offset=np.zeros(4), clock_offset_sigma=np.ones(4))

    def update(self, source, time, silent=()):
        number = len(self.sources)
        self.sources.append(source)
        if number in self.fails:
            raise InputError("frames of two rigs")
        return replace(self._state, time=time, snapshot=number, events=tuple(self.events.get(number, ())))

    def saved(self, progress):
        self.saves.append(len(self.sources))
        return Saved(len(self.sources), progress, self.disk_full)

    def accept_as_factory(self):
        return event(0, "factory", None, "the factory")


def event(number=0, kind="moved", camera="cam02", message="cam02 moved"):
    return Event(1.7e9 + number, number, kind, camera, message=message)
